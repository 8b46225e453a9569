"""The calls of `.ci/gpu`, small and on the CPU: an accelerator is rarely at hand, and they must not rot meanwhile."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

SCRIPT = Path(__file__).resolve().parents[1] / ".ci" / "gpu"


@pytest.fixture
def script(monkeypatch) -> Any:
    """The script as a module, which calls everything twice."""
    loader = importlib.machinery.SourceFileLoader("gpu_script", str(SCRIPT))
    spec = importlib.util.spec_from_loader("gpu_script", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "gpu_script", module)
    loader.exec_module(module)
    monkeypatch.setattr(module, "CALLS", 1)
    return module


def traced(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function followed through its operations on shapes, without compiling any: zeros of its results."""

    def zeros(*arguments: Any) -> Any:
        return jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), jax.eval_shape(function, *arguments))

    return zeros


def results(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    held = dict(np.load(folder / "0.npz"))
    return held, json.loads(str(held["about"]))["times"]


def test_the_calls_of_the_script_are_there(script: Any, tmp_path: Path):
    script.measure(tmp_path, script.Sizes(table=3, few=3, large=3, frames=8, instruments=2), traced)
    held, times = results(tmp_path)
    assert list(times) == [
        "fit of a table", "residuals", "posterior density", "its gradient", "Jacobian of the residuals",
        "gradient, 34 points", "density of 2 instruments", "Mueller matrices of 2 instruments",
        "chi2, gradient, matrix of cells of 8 x 8 pixels",
    ]  # fmt: skip
    assert held["Mueller matrices of 2 instruments"].shape == (2, 4, 4, 4)


def test_the_script_tells_platforms_apart(script: Any, tmp_path: Path, capsys):
    """All calls compiled and run; a result that is off by more than the tolerance is told."""
    script.measure(tmp_path, script.Sizes(table=3, few=3, large=3, frames=8, instruments=2))
    held, times = results(tmp_path)
    assert all(np.isfinite(held[name]).all() and held[name].any() for name in times)
    first, second = tmp_path / "0.npz", tmp_path / "1.npz"
    shutil.copy(first, second)
    assert script.compare(first, second)
    np.savez(second, **held | {"residuals": held["residuals"] * (1.0 + 1e-8)})
    assert not script.compare(first, second)
    assert "| its gradient |" in capsys.readouterr().out

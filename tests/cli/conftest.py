"""A small calibration set on disk and what the commands make of it; no cache of compiled code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_run import SEED, SMALL
from typer.testing import CliRunner

from walop_jax.cli import app
from walop_jax.data import write_calibration_set
from walop_jax.model.effects import effect_by_name
from walop_jax.simulation.simulate import simulate

Call = Callable[..., Any]  # a `Result`: typer brings its own click, or uses an installed one


@pytest.fixture(autouse=True, scope="session")
def _no_cache():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WALOP_JAX_CACHE", "off")
        patch.setenv("COLUMNS", "200")
        yield


@pytest.fixture(scope="session")
def call() -> Call:
    """Run a command in this process; exceptions that are no exit code count as test failures."""

    def run(*args: object) -> Any:
        result = CliRunner().invoke(app, [str(arg) for arg in args])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run


@pytest.fixture(scope="session")
def calset_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("sets") / "small.fits"
    write_calibration_set(path, simulate(SMALL, seed=SEED).calset)
    return path


@pytest.fixture(scope="session")
def spoilt_file(tmp_path_factory) -> Path:
    """A set with an effect that the base model does not have."""
    path = tmp_path_factory.mktemp("sets") / "spoilt.fits"
    effect = effect_by_name("clp_wobble").of(SMALL.context(), amplitude=0.3, phase=1.0)
    write_calibration_set(path, simulate(SMALL, seed=SEED, effects=(effect,)).calset)
    return path


@pytest.fixture(scope="session")
def run(call, calset_file, tmp_path_factory) -> Path:
    """A finished `refit`."""
    path = tmp_path_factory.mktemp("runs") / "run"
    result = call("refit", calset_file, "-o", path, "--quiet")
    assert result.exit_code == 0, result.output
    return path

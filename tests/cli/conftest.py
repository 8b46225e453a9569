"""A small calibration set on disk and what the commands make of it; no cache of compiled code."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import call, no_cache
from small_run import SEED, SMALL

from walop_jax.data import write_calibration_set
from walop_jax.model.effects import effect_by_name
from walop_jax.simulation.simulate import simulate

__all__ = ["call", "no_cache"]


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

"""The small simulated run and its calibration (`small_run.py`) for the tests of this room."""

from __future__ import annotations

import pytest
from small_run import WITH_PLATE, fitted_run

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet


@pytest.fixture(scope="session")
def calset() -> CalibrationSet:
    return fitted_run(WITH_PLATE).calset


@pytest.fixture(scope="session")
def calibration() -> Calibration:
    return Calibration.from_fit(fitted_run(WITH_PLATE))

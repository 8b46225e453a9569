"""The small simulated run and its calibration (`small_run.py`) for the tests of this room."""

from __future__ import annotations

import pytest
from small_run import small_fit_with_plate

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet


@pytest.fixture(scope="session")
def calset() -> CalibrationSet:
    return small_fit_with_plate().calset


@pytest.fixture(scope="session")
def calibration() -> Calibration:
    return Calibration.from_fit(small_fit_with_plate())

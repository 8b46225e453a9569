"""The small simulated run and its calibration (`small_run.py`) for the tests of this room."""

from __future__ import annotations

import pytest
from small_run import small_fit_with_plate

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.science import apply as application


@pytest.fixture(scope="session")
def calset() -> CalibrationSet:
    return small_fit_with_plate().calset


@pytest.fixture(scope="session")
def calibration() -> Calibration:
    return Calibration.from_fit(small_fit_with_plate())


@pytest.fixture(scope="session")
def vectors(calibration) -> AnalysisVectors:
    return AnalysisVectors(calibration)


@pytest.fixture
def tabulated_once(vectors, monkeypatch):
    """`apply` takes the tables of `vectors` for the calibration that they belong to, instead of making them anew."""

    def tables(calibration):
        return vectors if calibration is vectors.calibration else AnalysisVectors(calibration)

    monkeypatch.setattr(application, "AnalysisVectors", tables)

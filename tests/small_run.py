"""A calibration of a small simulated run, shared by the tests of this room."""

from __future__ import annotations

import pytest

from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.model_builder import base_model
from walop_jax.fit.refit import refit
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

PLAN = ObservingPlan(
    grid=5,
    standard_grid=2,
    polariser_angles=polariser_turn(8),
    moon_patches=3,
    standards=3,
    plate=(None, 0.0, 22.5),
)


@pytest.fixture(scope="session")
def calset():
    return simulate(PLAN, seed=4).calset


@pytest.fixture(scope="session")
def calibration(calset) -> Calibration:
    model = base_model(calset)
    return Calibration.from_fit(refit(calset, model))

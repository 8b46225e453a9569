"""Small simulated runs that tests share, because what is compiled for one layout of exposures and points serves all."""

from __future__ import annotations

import dataclasses
import functools

from walop_jax.data.records import StatedErrors
from walop_jax.fit.refit import FitResult, refit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

SMALL = ObservingPlan(
    grid=5, standard_grid=2, polariser_angles=polariser_turn(8), moon_patches=3, standards=3
)
WITH_PLATE = dataclasses.replace(SMALL, plate=(None, 0.0, 22.5))
SEED = 4


@functools.cache
def small_fit() -> FitResult:
    """The fit of a small run, made once, with the verdict on χ² and priors alone."""
    return refit(simulate(SMALL, seed=SEED).calset).with_verdict()


@functools.cache
def small_fit_stating(**errors: float) -> FitResult:
    """The fit of the small run, whose set states other errors of its numbers (`StatedErrors`)."""
    fit = small_fit()
    calset = dataclasses.replace(fit.calset, stated_errors=StatedErrors(**errors))
    return dataclasses.replace(fit, likelihood=Likelihood.of(calset, fit.model))


@functools.cache
def small_fit_with_plate() -> FitResult:
    """The same of a run with the calibration plate."""
    return refit(simulate(WITH_PLATE, seed=SEED).calset).with_verdict()

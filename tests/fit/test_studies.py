"""Studies over simulated sets: are errors what they are said to be, is the calibration as good as can be?

The full study, 20 sets as large as a real run (12 × 12 points):

    python -m pytest tests/fit/test_studies.py --long -s

It prints what it found; what was measured stands in the test.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest

from walop_jax.calibration.matrix import matrices
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.fit.minimise import minimise
from walop_jax.fit.refit import FitResult, fit, refit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import values_of
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

SMALL = ObservingPlan(
    grid=6, standard_grid=3, polariser_angles=polariser_turn(8, full_turn=True), moon_patches=4, standards=4
)


class Study(NamedTuple):
    """Pulls (set, parameter), squared errors of the matrix and predicted variances (set, point, 6)."""

    names: tuple[str, ...]
    pulls: np.ndarray
    squared: np.ndarray
    predicted: np.ndarray
    excess: np.ndarray

    def report(self) -> str:
        by_name = dict(zip(self.names, np.abs(self.pulls.mean(axis=0)), strict=True))
        worst = sorted(by_name, key=by_name.__getitem__)[-3:]
        return (
            f"{len(self.pulls)} sets, {len(self.names)} parameters: pulls mean {self.pulls.mean():+.3f}, "
            f"rms {np.sqrt((self.pulls**2).mean()):.3f}; (χ² − dof)/√(2 dof) mean {self.excess.mean():+.2f}, "
            f"rms {self.excess.std():.2f}\n"
            f"matrix between grid points: rms error {100 * np.sqrt(self.squared.mean((0, 1)))} %\n"
            f"                            bound     {100 * np.sqrt(self.predicted.mean((0, 1)))} %\n"
            f"                            ratio     {self.ratio}, mean {self.ratio.mean():.3f}\n"
            f"largest mean pulls: " + ", ".join(f"{n} {by_name[n]:.2f}" for n in worst)
        )

    @property
    def ratio(self) -> np.ndarray:
        """Error of each matrix element over its Cramér–Rao bound, rms over sets and points."""
        return np.sqrt(self.squared.mean((0, 1)) / self.predicted.mean((0, 1)))


def between(plan: ObservingPlan) -> tuple[np.ndarray, np.ndarray]:
    """The centres of the boxes that the grid points span."""
    edge = np.linspace(-plan.field, plan.field, plan.grid)
    centre = 0.5 * (edge[1:] + edge[:-1])
    x, y = np.meshgrid(centre, centre)
    return x.ravel(), y.ravel()


def matrix_at(
    instrument: Instrument, calset: CalibrationSet, plan: ObservingPlan, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    x, y = between(plan)
    settings = dataclasses.replace(Settings.default(len(x)), teff=np.full(len(x), plan.teff))
    value, error = matrices(instrument, settings, calset.filters, x, y, covariance)
    return value, np.diagonal(error, axis1=1, axis2=2)


def study(plan: ObservingPlan, seeds: Sequence[int]) -> Study:
    pulls, squared, predicted, excess = [], [], [], []
    names: tuple[str, ...] = ()
    for seed in seeds:
        calset, truth = simulate(plan, seed)
        result = refit(calset)
        assert result.with_verdict().trusted, result.warnings
        free = result.model.free
        names = tuple(result.model.names[i] for i in free)
        pulls.append((result.values - np.asarray(values_of(truth)))[free] / result.sigma[free])
        fitted, variance = matrix_at(result.model.instrument(result.values), calset, plan, result.covariance)
        true, _ = matrix_at(truth, calset, plan, result.covariance)
        squared.append((fitted - true) ** 2)
        predicted.append(variance)
        excess.append(result.excess)
    return Study(names, *(np.array(part) for part in (pulls, squared, predicted, excess)))


@pytest.mark.long
def test_twenty_runs_as_large_as_a_real_one():
    # Measured with version 0.1.0: mean −0.011, rms 0.990, ratio 0.941; over 60 further runs −0.006, 0.982, 1.032.
    # In those half1.efficiency was off by +0.5 of its error of 4e-6: N_ERR comes from the measured counts, so
    # near-dark cameras weigh more when they came out low. With errors from the expected counts: +0.2 ± 0.13.
    found = study(ObservingPlan(), range(20))
    print("\n" + found.report())
    assert abs(found.pulls.mean()) < 0.2
    assert 0.9 < np.sqrt((found.pulls**2).mean()) < 1.1
    assert found.ratio.mean() < 1.1
    assert abs(found.excess.mean()) < 1.0


# ----------------------------------------------------------------------------------------- exact properties


def at_truth(calset: CalibrationSet, truth: Instrument) -> Likelihood:
    """A likelihood whose priors are centred on the truth, so that the truth is its exact minimum."""
    model = base_model(calset)
    values = np.asarray(values_of(truth))
    for name, value in zip(model.names, values, strict=True):
        prior = model[name].prior
        if prior is not None:
            model = model.change(name, prior=(float(value), prior[1]))
        model = model.change(name, loose=None)
    return Likelihood.of(calset, model)


def test_noiseless_data_return_the_truth():
    calset, truth = simulate(SMALL, 4, noiseless=True)
    likelihood = at_truth(calset, truth)
    model, true = likelihood.model, np.asarray(values_of(truth))
    scale = np.array([p.scale for p in model.parameters])
    # A fit stops when what is left is far below the errors; followed to the end, nothing is left.
    result = fit(likelihood)
    assert result.converged
    np.testing.assert_allclose((result.values - true) / scale, 0.0, atol=1e-5)
    free = model.free
    to_the_end = minimise(
        lambda x: likelihood.expand(model.full(x)), result.values[free], scale[free], tolerance=1e-10
    )
    np.testing.assert_allclose((model.full(to_the_end.x) - true) / scale, 0.0, atol=1e-8)


def twice(calset: CalibrationSet) -> CalibrationSet:
    """Every exposure twice."""
    exposures = calset.exposures[np.tile(np.arange(len(calset.exposures)), 2)]
    block = calset.intensities.block(0, len(calset.points))
    again = {
        name: np.concatenate([getattr(block, name)] * 2, axis=1)
        for name in ("counts", "sigma", "used", "source")
    }
    return dataclasses.replace(
        calset,
        exposures=dataclasses.replace(exposures, exposure=np.arange(len(exposures))),
        intensities=TableIntensities.dense(calset.points, dataclasses.replace(block, **again)),
    )


def test_twice_the_data_halve_the_covariance():
    calset, truth = simulate(SMALL, 5)
    information = []
    for data in (calset, twice(calset)):
        model = base_model(data)
        for name in model.names:
            model = model.change(name, prior=None, loose=None)
        information.append(Likelihood.of(data, model).expand(np.asarray(values_of(truth))).matrix)
    np.testing.assert_allclose(
        information[1], 2.0 * information[0], rtol=1e-9, atol=1e-9 * information[0].max()
    )


def test_a_study_can_fail():
    # A model that cannot follow the optics is not trusted, so the study would stop.
    calset, _ = simulate(SMALL, 6)
    result: FitResult = refit(calset, base_model(calset, plates="fixed_axis"))
    assert not result.with_verdict().trusted

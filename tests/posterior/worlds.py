"""Small calibration runs, everything drawn from the priors that a fit uses: for proofs of calibration.

Unlike `simulate`, the throughputs and the depolarisation of the sky have proper priors here, and errors are stated from
expected counts, so that the posterior is exactly calibrated if the sampler is.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy import stats

from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import engine
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.specification import Model
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import PhotonNoise, simulate

PLAN = ObservingPlan(
    grid=4,
    standard_grid=2,
    polariser_angles=polariser_turn(6, full_turn=True),
    moon_patches=3,
    standards=2,
    unpolarised=1,
    electrons=2e5,
    throughput_degree=2,
)
NOISE = PhotonNoise()


class World(NamedTuple):
    """A likelihood and the full vector of true values behind its data."""

    likelihood: Likelihood
    truth: np.ndarray


def prior_model(calset: CalibrationSet) -> Model:
    """The base model with a proper prior for every free parameter."""
    model = base_model(calset, throughput_degree=PLAN.throughput_degree)
    for p in model.parameters:
        if p.name.startswith("throughput.") and p.free:
            model = model.change(p.name, prior=(p.start, 0.02 if p.name.endswith("p00") else 0.005))
    return model.change("sky.depolarisation", prior=(0.8, 0.02))


class Worlds:
    """Draws worlds from the prior; all share their layout, so that nothing is compiled twice."""

    def __init__(self) -> None:
        self.blank = simulate(PLAN, seed=5).calset
        self.model = prior_model(self.blank)
        points = self.blank.points
        self.likelihood = self._likelihood(self.blank)
        self.block = self.blank.intensities.block(0, len(points))

    def draw(self, rng: np.random.Generator) -> World:
        truth = self.model.start
        for i in self.model.free:
            prior = self.model.parameters[i].prior
            assert prior is not None
            truth[i] = rng.normal(*prior)
        flux = 4.0 * PLAN.electrons * rng.uniform(0.7, 1.0, self.block.used.shape)
        batch = next(iter(self.likelihood.points))
        unit = np.asarray(engine.prediction(self.model.instrument(truth), self.likelihood.plan, batch))
        expected = flux[:, :, None] * unit
        sigma = NOISE.sigma(expected)
        counts = expected + sigma * rng.standard_normal(expected.shape)
        block = dataclasses.replace(self.block, counts=counts, sigma=sigma)
        calset = dataclasses.replace(self.blank, intensities=TableIntensities.dense(self.blank.points, block))
        return World(self._likelihood(calset), truth)

    def _likelihood(self, calset: CalibrationSet) -> Likelihood:
        """Of all points at once: a sampler asks for it thousands of times."""
        return Likelihood.of(calset, self.model, batch=len(calset.points))


def ecdf_band(count: int, level: float = 0.95, grid: int = 100, draws: int = 4000, seed: int = 1) -> float:
    """γ of the simultaneous band of the ECDF of `count` uniform numbers (Säilynoja et al. 2022, Stat. Comput. 32, 32).

    At every z of the grid the band holds the central 1 − γ of Binomial(count, z); γ is such that a uniform sample stays
    inside everywhere with probability `level`.
    """
    z = np.arange(1, grid) / grid
    u = np.random.default_rng(seed).uniform(size=(draws, count))
    below = (u[:, :, None] <= z).sum(axis=1)
    return float(np.quantile(_smallest_tail(below, count, z), 1.0 - level))


def _smallest_tail(below: np.ndarray, count: int, z: np.ndarray) -> np.ndarray:
    lower, upper = stats.binom.cdf(below, count, z), stats.binom.sf(below - 1, count, z)
    return 2.0 * np.minimum(lower, upper).min(axis=-1)


def band_statistic(u: np.ndarray, grid: int = 100) -> np.ndarray:
    """The statistic that `ecdf_band` is a quantile of, per column of `u`: inside the band where it is larger."""
    z = np.arange(1, grid) / grid
    below = (u[:, :, None] <= z).sum(axis=0)
    return _smallest_tail(below, len(u), z)

"""Arms whose share of the light is unknown: what a fit then sees, what it does not, and its gradient."""

from __future__ import annotations

import dataclasses

import builders
import numpy as np
import pytest

from walop_jax.data.records import CalibrationSet, Points, Site, Sources
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import engine
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.instrument import Instrument, nominal_instrument

POINTS = 3
RNG = np.random.default_rng(8)
X, Y = builders.field(RNG, POINTS)
# The polariser in front of light of known flux, at two settings of the plate, and of unknown flux.
ROWS = [
    *({"kind": "flux", "clp_angle": angle} for angle in (0.0, 40.0, 80.0, 130.0)),
    *({"kind": "flux", "clp_angle": angle, "chwp_angle": 45.0} for angle in (10.0, 70.0, 120.0)),
    *({"clp_angle": angle} for angle in (0.0, 60.0, 120.0)),
]
GROUP = np.repeat([0, 1], [4, 3])
COUNT = len(ROWS)


def likelihood_of(
    counts: np.ndarray, *, split: bool = True, floor: float = 0.0, sigma: float = 1e-3
) -> Likelihood:
    points, none = Points(np.arange(POINTS), X, Y), np.zeros(0)
    point, exposure = (v.ravel() for v in np.meshgrid(np.arange(POINTS), np.arange(COUNT), indexing="ij"))
    calset = CalibrationSet(
        instrument="WALOP-SOUTH",
        site=Site("", np.nan, np.nan, np.nan),
        origin="made here",
        exposures=builders.exposures(*ROWS),
        points=points,
        sources=Sources(np.zeros(0, int), np.zeros(0, str), none, none, none, none, none),
        filters={"band": builders.monochromatic(0.62)},
        intensities=TableIntensities(
            COUNT, points, exposure=exposure, point=point, source=np.full(len(point), -1),
            counts=counts.reshape(-1, 4), sigma=np.full((len(point), 4), sigma), flag=np.zeros(len(point), int),
            used=np.ones(len(point), bool),
        ),
    )  # fmt: skip
    south = nominal_instrument("WALOP-SOUTH")
    south = dataclasses.replace(
        south, cameras=dataclasses.replace(south.cameras, split=split, noise_floor=floor)
    )
    return Likelihood.of(calset, base_model(calset, south, throughput_degree=1))


@pytest.fixture(scope="module")
def made():
    """Counts of an instrument that is not the nominal one, and a likelihood to predict with."""
    blank = likelihood_of(np.ones((POINTS, COUNT, 4)))
    return predicted(blank, builders.as_built(blank.model.instrument(), RNG))


def predicted(likelihood: Likelihood, instrument: Instrument | None = None) -> np.ndarray:
    """Counts of an instrument, by default that of the start values."""
    instrument = instrument or likelihood.model.instrument()
    return np.array(engine.prediction(instrument, likelihood.plan, next(iter(likelihood.points))))[:POINTS]


def shares() -> np.ndarray:
    """A factor for each arm at each point: one for each setting of known flux, one for each other exposure."""
    groups = RNG.uniform(0.5, 2.0, (POINTS, 2, 2))[:, GROUP]
    each = RNG.uniform(0.5, 2.0, (POINTS, COUNT - len(GROUP), 2))
    return np.repeat(np.concatenate([groups, each], axis=1), 2, axis=2)


def test_an_exact_model_leaves_nothing_whatever_the_shares(made):
    likelihood = likelihood_of(made * shares())
    values = np.asarray(likelihood.model.start)
    assert likelihood.expand(values).data > 1.0  # the nominal instrument is another one
    assert likelihood_of(predicted(likelihood) * shares()).expand(values).data < 1e-18


def test_shares_that_differ_between_exposures_of_known_flux_are_seen(made):
    likelihood = likelihood_of(made)
    values = np.asarray(likelihood.model.start)
    brighter = predicted(likelihood)
    brighter[:, 1, :2] *= 1.1
    assert likelihood_of(brighter).expand(values).data > 1.0


def test_gradient_is_that_of_chi_square(made):
    likelihood = likelihood_of(made)
    values = np.asarray(likelihood.model.start).copy()
    here, free = likelihood.expand(values), likelihood.model.free
    step = (
        RNG.standard_normal(len(free)) * np.array([likelihood.model.parameters[i].scale for i in free]) * 1e-5
    )
    up, down = (
        likelihood.expand(likelihood.model.full(values[free] + sign * step)).objective for sign in (1, -1)
    )
    assert 0.5 * (up - down) == pytest.approx(2.0 * here.gradient @ step, rel=1e-4)


def test_independent_data_lack_a_flux_for_each_arm(made):
    """4 cameras × 10 exposures; 2 arms × (2 groups + 3 exposures) fluxes at each point."""
    likelihood = likelihood_of(made)
    assert likelihood.independent == POINTS * (40 - 10) + likelihood.priors.known.sum()
    known = likelihood_of(made, split=False)
    assert known.independent == POINTS * (28 + 9) + known.priors.known.sum()


def test_what_cameras_of_an_arm_have_in_common_is_held():
    model = likelihood_of(np.ones((POINTS, COUNT, 4))).model
    series = [name for name in model.names if name.startswith("throughput.")]
    assert {name for name in series if not model[name].free} == {
        f"throughput.n{camera}.{term}" for camera in (0, 2) for term in ("p00", "p10", "p01")
    }


def test_no_error_is_below_the_floor():
    """Mean counts 5: a floor of 0.01 is 0.05; stated errors of 0.001 and of 0.2."""
    counts = np.broadcast_to([2.0, 8.0, 1.0, 9.0], (POINTS, COUNT, 4))
    for sigma, expected in ((0.001, 0.05), (0.2, 0.2)):
        weight = likelihood_of(counts, floor=0.01, sigma=sigma).points.gathered("weight")
        np.testing.assert_allclose(weight, 1.0 / expected, rtol=1e-12)

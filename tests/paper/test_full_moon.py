"""Full Moon: boxes, patches that are not what they should be, and what down-weighting them does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.io.errors import DataError
from walop_jax.model.effects import effect_by_name
from walop_jax.paper import polynomial as moon
from walop_jax.paper import polynomial as paper
from walop_jax.science import star_errors as accuracy
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import simulate

PLAN = ObservingPlan(grid=6, moon_patches=5, standards=6)
SPOILT = 2


def calibrate(calset):
    model = base_model(calset)
    return Calibration.from_fit(refit(calset, model).with_verdict())


@pytest.fixture(scope="module")
def clean():
    run = simulate(PLAN, seed=11)
    return run.calset, calibrate(run.calset)


@pytest.fixture(scope="module")
def spoilt():
    """One patch of five has 0.8 % of polarisation that single scattering does not know."""
    q = np.zeros(5)
    q[SPOILT] = 0.008
    effect = effect_by_name("moon_patch").of(PLAN.context(), q=q)
    run = simulate(PLAN, seed=11, effects=(effect,))
    return run, calibrate(run.calset)


def test_boxes_by_hand():
    x = np.array([-0.29, 0.0, 0.057, 0.059, 0.29, 0.29])
    y = np.array([-0.29, 0.0, 0.0, 0.0, -0.29, 0.29])
    assert moon.box_number(x, y).tolist() == [0, 12, 12, 13, 4, 24]
    centres = moon.box_centres()
    np.testing.assert_allclose([centres[0][7], centres[1][7]], [0.0, -0.116], atol=1e-12)
    assert moon.box_number(*centres).tolist() == list(range(25))


def test_good_patches_are_trusted(clean):
    calset, calibration = clean
    found = moon.judge_patches(calset, calibration)
    assert not found.doubted.any()
    # δ = 0.8 by the simulator's truth; 41 points × 2 numbers for each patch.
    assert found.depolarisation == pytest.approx(0.8, abs=0.01)
    dof = 2 * 36 - 3
    assert np.all(np.abs(found.flatness - 1) < 5 * np.sqrt(2 / dof))


@pytest.mark.long
def test_a_patch_that_is_not_rayleigh_is_found_and_does_no_harm(spoilt):
    """It has the least weight, and departs by what was put in."""
    run, believing = spoilt
    found = moon.judge_patches(run.calset, believing)
    assert int(np.argmin(found.weight)) == SPOILT
    assert found.departure[SPOILT] == pytest.approx(0.008, rel=0.1)


def test_a_patch_that_is_not_flat_is_found(clean):
    """Structure from point to point of 0.5 %, as a thin cloud might have it."""
    calset, calibration = clean
    patch = moon.judge_patches(calset, calibration).exposure[1]
    block = calset.intensities.block(0, len(calset.points))
    counts = block.counts.copy()
    counts[:, patch, 0] *= 1 + 0.005 * np.random.default_rng(0).standard_normal(len(counts))
    changed = dataclasses.replace(block, counts=counts)
    bad = dataclasses.replace(calset, intensities=type(calset.intensities).dense(calset.points, changed))
    found = moon.judge_patches(bad, calibration)
    assert np.flatnonzero(found.doubted).tolist() == [1]
    assert found.flatness[1] > 3


def test_scheme_takes_offsets_from_the_sky(clean):
    """Δ of the scheme against Δ of the test stars: the same to what its interpolations and flat boxes allow."""
    _, calibration = clean
    calset = simulate(dataclasses.replace(PLAN, grid=12), seed=11).calset  # the same instrument, more points
    made = paper.fit_paper(calset)
    scheme = moon.full_moon_scheme(calset, made)
    from walop_jax.calibration.analysis_vectors import AnalysisVectors
    from walop_jax.data.settings import Settings

    vectors = AnalysisVectors(calibration).coloured(
        Settings.default(1), made.x, made.y, np.full(len(made.x), PLAN.teff)
    )
    outside = np.abs(accuracy.determinant(vectors)) > 0.3
    stars = paper.sample_stars()
    seen = paper.measured_qu(paper.transmitted(vectors, stars))
    plain = dataclasses.replace(made, delta=np.zeros_like(made.delta))
    errors = {
        name: np.sqrt(np.mean(accuracy.star_errors(c.recover(seen), stars)[outside, 0] ** 2))
        for name, c in (("scheme", scheme), ("none", plain))
    }
    assert errors["scheme"] < 0.5 * errors["none"]


def test_scheme_wants_standards_and_moon(clean):
    calset = simulate(ObservingPlan(grid=5, moon_patches=0, standards=3), seed=1).calset
    with pytest.raises(DataError, match="needs Moon exposures"):
        moon.full_moon_scheme(calset, paper.fit_paper(calset))
    with pytest.raises(DataError, match="no full-Moon exposure"):
        moon.judge_patches(calset, clean[1])

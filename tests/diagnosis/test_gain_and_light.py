"""Patterns of a gain and of light that is added: each column is the change of the residuals that it stands for."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SMALL, small_fit, small_fit_with_plate

from walop_jax.diagnosis.design import Design, pattern_in_words, pattern_scores, strata
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import FreeForm
from walop_jax.simulation.simulate import simulate

STEP = 2e-5  # of the counts: the cube of it is lost in the tolerance
CAMERAS = ("O1", "E1", "O2", "E2")


def stratum_of(design: Design, name: str):
    return next(one for one in strata(design.measured) if one.name == name)


def residuals_with(result: FitResult, design: Design, name: str, sort: str, size: float) -> np.ndarray:
    """Residuals, written out row by row, if the last pattern of a stratum were in the instrument with that size.

    The data are the expected counts: columns leave out what is of the size of residual times change.
    """
    likelihood = result.likelihood
    stratum = stratum_of(design, name)
    weight, used = likelihood.points.gathered("weight"), likelihood.used
    counts = likelihood.points.gathered("counts")
    flux, residual = likelihood.residuals(result.values)
    expected = counts - np.divide(residual, weight, out=np.zeros_like(residual), where=weight > 0)
    k, pattern = stratum.camera[-1], np.broadcast_to(stratum.patterns[-1], used.shape)
    unit = expected / np.where(flux == 0, 1.0, flux)[..., None]
    mean = np.array([rows[mask].mean(axis=0) for rows, mask in zip(unit, used, strict=True)])
    added = expected[..., k] if sort == "gain" else flux * mean[:, None, k]
    changed = expected.copy()
    changed[..., k] += size * pattern * added
    n, model = (counts[used] * weight[used] for counts in (expected, changed))
    best = np.sum(n * model, axis=-1) / np.sum(model * model, axis=-1)
    return (n - best[:, None] * model).reshape(-1)


@pytest.mark.parametrize("made", [small_fit, small_fit_with_plate])
def test_columns_are_finite_differences_of_the_residuals(made):
    """Every sort of pattern, in the last camera, by changing the expected counts and fitting the flux of every row."""
    result = made()
    design = Design.of(result)
    one_of_each = {stratum.name.split(" of ")[0]: stratum for stratum in strata(design.measured)}
    one_of_each |= {f"{s.name.split(' of ')[0]}, {s.sort}": s for s in strata(design.measured)}
    assert {s.sort for s in one_of_each.values()} == {"gain", "light"}
    for stratum in one_of_each.values():
        column = design.measured.candidate(stratum).columns[:, -1]
        up, down = (
            residuals_with(result, design, stratum.name, stratum.sort, sign * STEP) for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(
            column, (up - down) / (2.0 * STEP), rtol=0, atol=1e-6 * np.abs(column).max(), err_msg=stratum.name
        )


@pytest.mark.parametrize(
    ("block", "name"), [("fine_gains", "fine structure of O2"), ("exposure_gains", "single exposures")]
)
def test_the_free_form_term_has_the_gains_of_the_patterns(block, name):
    """The instrument with one number of a block, by finite differences, against the same column."""
    result = small_fit()
    design, k = Design.of(result), CAMERAS.index("O2")
    stratum, neutral = stratum_of(design, name), FreeForm.of(SMALL.context(), blocks=(block,))
    one = np.zeros(getattr(neutral, block).shape)
    one[(k, 3) if block == "fine_gains" else (3, k)] = 1.0
    weight = result.likelihood.points.gathered("weight")
    left = result.likelihood.residuals(result.values)[1]
    noise = np.divide(left, weight, out=np.zeros_like(left), where=weight > 0)
    quiet = with_block(result.calset, counts=block_of(result.calset).counts - noise)

    def residuals(size: float) -> np.ndarray:
        """Of data without noise: it would add its product with the change."""
        term = dataclasses.replace(neutral, **{block: jnp.asarray(size * one)})
        model = dataclasses.replace(result.model, template=term.patch(result.model.template))
        likelihood = Likelihood.of(quiet, model)
        return likelihood.residuals(result.values)[1][likelihood.used].reshape(-1)

    difference = (residuals(STEP) - residuals(-STEP)) / (2.0 * STEP)
    fourth_of_camera = [i for i, camera in enumerate(stratum.camera) if camera == k][3]
    column = design.measured.candidate(stratum).columns[:, fourth_of_camera]
    np.testing.assert_allclose(column, difference, rtol=0, atol=1e-6 * np.abs(column).max())


def with_weaker_quadrant(camera: str, share: float):
    """A simulated run in which a quadrant of a camera gives a smaller share of its counts."""
    plan = dataclasses.replace(SMALL, grid=7)
    calset = simulate(plan, seed=13).calset
    inside = (calset.points.x > 0) & (calset.points.y > 0)
    counts = block_of(calset).counts.copy()
    counts[inside, :, CAMERAS.index(camera)] *= 1.0 - share
    return with_block(calset, counts=counts)


@pytest.mark.parametrize("camera", ["E1", "O2"])
def test_a_camera_that_is_weaker_in_a_quadrant_is_the_one_that_is_told(camera):
    """A gain multiplies the counts of each exposure; light of the same pattern lies mostly elsewhere."""
    calset = with_weaker_quadrant(camera, 0.01)
    scores = pattern_scores(Design.of(fit(Likelihood.of(calset, base_model(calset)))))
    fine = {one: scores[f"fine structure of {one}"].statistic for one in CAMERAS}
    others = max(value for one, value in fine.items() if one != camera)
    assert scores.p_global < 1e-15
    assert fine[camera] > 2.0 * others
    assert fine[camera] > 2.0 * scores[f"fine structure of light on {camera}"].statistic


def test_a_sound_run_is_quiet():
    assert pattern_scores(Design.of(small_fit())).p_global > 0.01


def test_words_say_which_patterns_are_gains():
    assert pattern_in_words("fine structure of E1", CAMERAS) == "fine structure of the gain of E1"
    assert pattern_in_words("4θ of light on E1", CAMERAS) == "4θ of light on E1"
    assert pattern_in_words("vector q of E1", CAMERAS) == "vector q of E1"
    assert pattern_in_words("gain by kind", CAMERAS) == "gain by kind"

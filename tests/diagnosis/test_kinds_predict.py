"""Polariser, Moon and standards predict each other: ln p of each given the others, by hand."""

import dataclasses

import numpy as np
import pytest
from scipy import stats
from small_run import SMALL

from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.refits import before_and_after, gains_of_units
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects.in_models import with_effects
from walop_jax.simulation.simulate import effect_from_text, simulate

UNIT = np.repeat(["clp", "moon", "standard"], 100)


def laid(columns, data, prior_of=()):
    """A model with a row for each datum: data − columns · best values; priors of unit width come last."""
    priors = np.eye(columns.shape[1])[list(prior_of)]
    rows, values = np.vstack([-columns, -priors]), np.concatenate([data, np.zeros(len(priors))])
    best = np.linalg.lstsq(-rows, values, rcond=None)[0]
    return rows, values + rows @ best, len(data) - columns.shape[1] + len(priors), 1.0


def by_hand(columns, data, kind, prior_of):
    """ln p of the rows of a kind given all others, from the joint normal density."""
    own = kind == UNIT
    information = columns[~own].T @ columns[~own]
    information[prior_of, prior_of] += 1.0
    mean = np.linalg.solve(information, columns[~own].T @ data[~own])
    spread = np.eye(own.sum()) + columns[own] @ np.linalg.solve(information, columns[own].T)
    return stats.multivariate_normal(columns[own] @ mean, spread).logpdf(data[own])


def test_gains_are_those_of_normal_densities():
    """One number that all see, and one more that Moon and standards see."""
    rng = np.random.default_rng(5)
    common, more = np.ones((300, 1)), (UNIT != "clp")[:, None] * 1.0
    both = np.hstack([common, more])
    data = 0.2 + 0.2 * more[:, 0] + 0.5 * rng.standard_normal(300)  # quiet: χ² below its expectation
    found, _ = gains_of_units(UNIT, laid(common, data), laid(both, data, [1]))
    for gain, kind in zip(found, np.unique(UNIT), strict=True):
        by_densities = by_hand(both, data, kind, [1]) - by_hand(common, data, kind, [])
        assert gain == pytest.approx(by_densities, rel=1e-6, abs=1e-6)


def test_what_stands_in_for_something_else_is_contradicted():
    """The standards alone are off. One number that Moon and standards would have in common takes the Moon along."""
    rng = np.random.default_rng(6)
    common, data = np.ones((300, 1)), rng.standard_normal(300) + 0.8 * (UNIT == "standard")
    right, wrong = (np.isin(UNIT, some)[:, None] * 1.0 for some in (["standard"], ["moon", "standard"]))
    base = laid(common, data)
    true, _ = gains_of_units(UNIT, base, laid(np.hstack([common, right]), data, [1]))
    assert true.min() > -0.5
    assert true[2] > 3.0
    off, misfit = gains_of_units(UNIT, base, laid(np.hstack([common, wrong]), data, [1]))
    assert off[1] < -3.0
    assert misfit[1] < -3.0


def test_a_prediction_that_has_only_become_broader_is_no_misfit():
    """A number that only standards see, of no consequence there: ½ ln(1 + 100 w²) less probable, no farther off."""
    data = np.random.default_rng(8).standard_normal(300)
    data[UNIT == "standard"] -= data[UNIT == "standard"].mean()
    common, more = np.ones((300, 1)), (UNIT == "standard")[:, None] * 100.0
    gain, misfit = gains_of_units(UNIT, laid(common, data), laid(np.hstack([common, more]), data, [1]))
    assert gain[2] == pytest.approx(-0.5 * np.log(1.0 + 100 * 100.0**2), abs=0.3)
    assert abs(misfit[2]) < 0.3


def test_errors_that_a_fit_has_scaled_make_its_densities_as_broad():
    """The same residuals in units of five times the errors: as probable, where χ² is what those errors say."""
    rng = np.random.default_rng(7)
    columns, data = np.ones((300, 1)), rng.standard_normal(300)
    rows, residual, free, _ = laid(columns, data)
    scaled = rows / 5.0, residual / 5.0, free, 5.0
    loss, _ = gains_of_units(UNIT, (rows, residual, free, 1.0), scaled)
    # ½ Σ r² − n ln 5 − ½ Σ r²/25, nearly: a unit of 100 rows is predicted by 200.
    squares = np.array([np.sum(residual[kind == UNIT] ** 2) for kind in np.unique(UNIT)])
    np.testing.assert_allclose(loss, 0.5 * squares * (1 - 1 / 25) - 100 * np.log(5.0), rtol=0.02)


def test_an_effect_of_single_exposures_is_held_against_places_in_the_field():
    """Three patches of the Moon, each in one exposure: the others say nothing of it, other field points do."""
    patches = effect_from_text("moon_patch=q:0.004/0.006/0.009,u:0.003/0.005/0.007", SMALL.context())
    calset = simulate(SMALL, seed=3, effects=[patches]).calset
    before = fit(Likelihood.of(calset, base_model(calset)))
    model = with_effects(before.model, [patches], SMALL.context())
    found = before_and_after("moon_patch", Design.of(before), Design.of(fit(Likelihood.of(calset, model))))
    assert found.heldout_scheme == "field blocks"
    assert found.confirmed
    model = with_effects(
        before.model, ["moon_multiple_scattering"], SMALL.context()
    )  # one number of all patches
    other = fit(Likelihood.of(calset, model))
    found = before_and_after("moon_multiple_scattering", Design.of(before), Design.of(other))
    assert found.heldout_scheme == "exposures"


def test_patches_of_the_moon_are_named_though_no_exposure_predicts_another():
    """Moonlight that is more polarised from patch to patch: every step of the search asks other field points."""
    plan = dataclasses.replace(SMALL, moon_patches=6)
    text = "moon_patch=q:0.004/0.005/0.006/0.007/0.008/0.009,u:0.003/0.004/0.005/0.006/0.007/0.008"
    found = diagnose(simulate(plan, seed=3, effects=[effect_from_text(text, plan.context())]).calset)
    assert found.verdict == "effect_found"
    assert [step.effect for step in found.steps] == ["moon_patch"]

"""Names that are not needed in the end: nothing of what is told refers to them, and strong effects are explained."""

import dataclasses
import itertools
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from scenes import PLAN

from walop_jax.diagnosis import remainder, thresholds
from walop_jax.diagnosis.exact import Trial
from walop_jax.diagnosis.figure_data import figure_data
from walop_jax.diagnosis.findings import FitComparison
from walop_jax.diagnosis.hypotheses import Hypotheses
from walop_jax.diagnosis.refits import Refits
from walop_jax.diagnosis.search import State
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import FreeForm, effect_by_name
from walop_jax.model.effects.in_models import model_without
from walop_jax.simulation.simulate import simulate

ZERO, WOBBLE, LEAKAGE, DRIFT = map(
    effect_by_name, ("clp_zero", "clp_wobble", "camera_leakage", "camera_gain_drift")
)


def diagnosed(effects, catalogue, seed=1):
    """A diagnosis of a simulated set, and what it told on the way."""
    calset, _ = simulate(PLAN, seed=seed, effects=effects)
    told = []
    found = diagnose(calset, catalogue=catalogue, progress=told.append)
    return found, told


def lead_from_the_first_fit_to_the_last(found):
    ends = [found.before.chi2, *(step.chi2_after for step in found.steps)]
    assert [step.chi2_before for step in found.steps] == ends[:-1]
    assert ends[-1] == found.after.chi2
    for one, next_one in itertools.pairwise(found.steps):
        assert one.heldout_after == next_one.heldout_before
        np.testing.assert_array_equal(one.residual_after, next_one.residual_before)
    ladder = figure_data(found).ladder
    assert list(ladder["MODEL"]) == ["starting model", *(step.effect for step in found.steps)]
    assert (ladder["DOF"][0], ladder["DOF"][-1]) == (found.before.dof, found.after.dof)
    return True


@pytest.fixture(scope="module")
def strong():
    """An encoder error of 3°, thirty times the usual: something else comes first, and is dropped."""
    found, told = diagnosed([WOBBLE.of(PLAN.context(), amplitude=3.0)], (ZERO, WOBBLE))
    assert any(text.endswith("is no longer needed") for text in told)
    return found


@pytest.mark.long
def test_a_strong_effect_is_explained_to_within_the_noise(strong):
    """The prior of an amplitude that lies thirty widths away neither counts as a misfit nor pulls at the value."""
    assert strong.verdict == "effect_found"
    assert strong.after.trusted
    assert strong.after.chi2 / strong.after.dof == pytest.approx(1.0, abs=0.12)
    value, sigma, _ = strong.steps[0].parameters["amplitude"]
    assert abs(value - 3.0) < 3 * sigma
    assert strong.steps[0].far == {"amplitude": pytest.approx(10 * value)}
    assert "clp_wobble.amplitude (30 widths)" in strong.caution


@pytest.mark.long
def test_after_a_drop_the_steps_tell_of_models_without_the_dropped_name(strong):
    assert [step.effect for step in strong.steps] == ["clp_wobble"]
    assert lead_from_the_first_fit_to_the_last(strong)


@pytest.mark.long
def test_a_dropped_effect_is_one_of_those_not_found(strong):
    assert "clp_zero" in {limit["effect"] for limit in strong.limits}
    assert "clp_zero" in strong.steps[0].separation


def test_what_has_no_name_is_asked_of_the_model_without_needless_names(monkeypatch):
    """Something is missing as long as a name stands that is not needed."""
    result = SimpleNamespace(explains_data=True, chi2=1.0, dof=1, noise_scale=1.0)

    def state(*steps):
        evidence = SimpleNamespace(alarm=bool(steps), result=result)
        return State(evidence, steps)

    monkeypatch.setattr(remainder, "prune", lambda first, last, judge: state())
    last, rest = remainder.concluded(state(), state(Trial(ZERO, 1.0, 1.0, leaves_noise=False)), Mock(Refits))
    assert (last.steps, rest) == ((), None)


def test_when_time_or_fits_are_over_nothing_further_is_tried():
    how = (Hypotheses(), np.random.default_rng(0), lambda text: None)
    assert Refits(*how, minutes=0.0).over(0) == "0 minutes"
    assert Refits(*how).over(thresholds.MOST_FITS) == f"{thresholds.MOST_FITS} fits"
    assert Refits(*how).over(0) == ""


@pytest.mark.long
def test_after_a_drop_several_steps_follow_one_another():
    effects = [WOBBLE.of(PLAN.context(), amplitude=3.0), LEAKAGE.of(PLAN.context(), share=1e-3)]
    found, told = diagnosed(effects, (ZERO, WOBBLE, LEAKAGE))
    assert "clp_zero is no longer needed" in told
    assert [step.effect for step in found.steps] == ["clp_wobble", "camera_leakage"]
    assert lead_from_the_first_fit_to_the_last(found)
    model = model_without(found.after.model, "camera_leakage")
    alone = fit(Likelihood.of(found.after.calset, model))
    assert found.steps[0].chi2_after == pytest.approx(alone.chi2, rel=1e-6)
    assert [list(step.far) for step in found.steps] == [["amplitude"], []]


@pytest.mark.long
def test_what_has_no_name_is_told_without_a_name_that_could_stand_in_for_it():
    """Gains that differ from exposure to exposure: by chance they look like a drift, or like a plate that warms up.

    Descriptions of the instrument that leave out that plate are no rivals then.
    """
    pattern = FreeForm.of(PLAN.context(), blocks=("exposures",))
    gains = np.abs(1e-3 * np.random.default_rng(3).standard_normal(pattern.exposures.shape))
    found, told = diagnosed([dataclasses.replace(pattern, exposures=gains)], (DRIFT,), seed=3)
    assert any(text.startswith("comparing ") for text in told)
    assert found.verdict == "unexplained"
    assert not found.steps
    assert found.unexplained.free_form == ("exposures",)
    assert found.unexplained.chi2_before == pytest.approx(found.before.chi2, rel=1e-9)
    assert found.unexplained.chi2_after == found.after.chi2
    assert found.unexplained.p_value == pytest.approx(found.p_value, rel=0.5)
    assert list(figure_data(found).ladder["MODEL"]) == ["starting model", "free_form"]


@pytest.mark.parametrize(("left", "part"), [(24.0, True), (1.4, False)])
def test_a_name_that_leaves_the_data_as_unexplained_is_told_as_a_part_and_taken_out(left, part):
    """χ²/dof 69 → 24 with the name is a part of what is missing; 69 → 1.4 is the cause of most of it."""
    compared = FitComparison(chi2_before=6900.0, chi2_after=100.0 * left)
    step = Trial(effect_by_name("flexure"), 1.0, 1.0, leaves_noise=False, compared=compared)

    def state(chi2, *steps):
        return State(SimpleNamespace(dof=100, result=SimpleNamespace(chi2=chi2, dof=100)), steps)

    told = remainder._parts(state(6900.0), state(100.0 * left, step))
    assert told == ({"flexure": "flexure (χ²/dof 69 → 24)"} if part else {})

"""Names that are not needed in the end: nothing of what is told refers to them, and strong effects are explained."""

import dataclasses

import pytest

from walop_jax.diagnose.workflow import diagnose
from walop_jax.likelihood.observing import ObservingPlan, polariser_turn
from walop_jax.likelihood.simulate import simulate
from walop_jax.model.effects import effect_by_name

# That of test_judging.py: the two share compiled code.
PLAN = ObservingPlan(
    grid=6, standard_grid=2, polariser_angles=polariser_turn(12), moon_patches=4, standards=4
)
ZERO, WOBBLE = map(effect_by_name, ("clp_zero", "clp_wobble"))


def diagnosed(effects, catalogue, seed=1):
    """A diagnosis of a simulated set, and what it told on the way."""
    calset, _ = simulate(PLAN, seed=seed, effects=effects)
    told = []
    found = diagnose(calset, catalogue=catalogue, progress=told.append)
    return found, told


@pytest.fixture(scope="module")
def strong():
    """An encoder error of 3°, thirty times the usual: a zero point is named first."""
    found, told = diagnosed([dataclasses.replace(WOBBLE(), amplitude=3.0)], (ZERO, WOBBLE))
    assert "added clp_zero; scoring what is left" in told
    assert "clp_zero is no longer needed" in told
    return found


def test_a_strong_effect_is_explained_to_within_the_noise(strong):
    """The prior of an amplitude that lies thirty widths away neither counts as a misfit nor pulls at the value."""
    assert strong.verdict == "effect_found"
    assert strong.after.trusted
    assert strong.after.chi2 / strong.after.dof == pytest.approx(1.0, abs=0.12)
    value, sigma, _ = strong.steps[0].parameters["amplitude"]
    assert abs(value - 3.0) < 3 * sigma
    assert strong.steps[0].far == {"amplitude": pytest.approx(10 * value)}
    assert "clp_wobble.amplitude (30 widths)" in strong.caution

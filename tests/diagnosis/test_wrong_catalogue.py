"""Catalogue values of standards that are wrong: of one star, and of all of them, each by its own amount."""

import dataclasses

import numpy as np
from scenes import PLAN

from walop_jax.diagnosis.workflow import diagnose
from walop_jax.model.effects import effect_by_name
from walop_jax.simulation.simulate import simulate

STARS = dataclasses.replace(PLAN, standards=5)


def diagnosed(name: str, **values):
    effect = effect_by_name(name).of(STARS.context(), **values)
    return diagnose(simulate(STARS, seed=8, effects=[effect]).calset)


def test_values_of_all_standards_are_one_cause():
    """What is found is what was hidden, to the errors of the fit and the 2e-4 of the catalogue."""
    rng = np.random.default_rng(2)
    q, u = 0.004 * rng.standard_normal((2, 5))
    found = diagnosed("standard_values", q=q, u=u)
    (step,) = found.steps
    assert (found.verdict, step.effect) == ("effect_found", "standard_values")
    names = STARS.context().sources
    for values, axis in ((q, "q"), (u, "u")):
        at = np.array([step.parameters[f"{axis}.{name}"][:2] for name in names])
        assert np.all(np.abs(at[:, 0] - values) < 4.0 * np.hypot(at[:, 1], 2e-4))


def test_one_star_is_still_one_star():
    found = diagnosed("standard_outlier", source="STD01", q=0.004, u=-0.003)
    (step,) = found.steps
    assert (step.effect, step.choices["source"]) == ("standard_outlier", "STD01")

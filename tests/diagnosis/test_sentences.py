"""What nobody has a name for is told in a sentence: kind, place and dependence, with its size."""

import itertools
import json
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import pytest
import scenes
from fits_with import fit_with, set_with

from walop_jax.diagnosis.exact import try_effect
from walop_jax.diagnosis.findings import document
from walop_jax.diagnosis.refits import settled
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.model.cameras import Transmission
from walop_jax.model.effects import Described, Effect
from walop_jax.simulation.simulate import simulate


class _Edge(Transmission):
    """Light that is lost beyond some radius, in the cameras of one half alone."""

    def factors(self, x, y):
        lost = 0.04 * jnp.maximum(jnp.hypot(x, y) - 0.22, 0.0) / 0.2
        return 1.0 - lost * jnp.array([1.0, 1.0, 0.0, 0.0])


class Vignetting(Effect):
    """One half sees less of the corners: no smooth function of the field, no sentence."""

    strength: float = eqx.field(static=True, default=1.0)
    name: ClassVar[str] = "hidden_vignetting"

    def patch(self, instrument):
        return instrument.with_part("transmission", _Edge())


def found(hidden, seed=3):
    calset = simulate(scenes.PLAN, seed=seed, effects=hidden).calset
    result = diagnose(calset, seed=1)
    print(
        json.dumps(
            [
                document(result)[k]
                for k in ("verdict", "steps", "unexplained", "remaining_p_value", "seconds")
            ],
            indent=1,
            ensure_ascii=False,
        )
    )
    return result


@pytest.mark.long
def test_a_film_whose_axis_turns_over_the_field():
    result = found([Described.saying(["turn of polariser * x"], [0.05])])
    assert result.verdict == "effect_found"
    assert [step.effect for step in result.steps] == ["described"]
    ((change, value, sigma),) = result.steps[0].descriptions
    assert (change.kind, change.relation, change.place) == ("turn", "of", "polariser")
    assert change.text == "turn of polariser * x"
    assert value == pytest.approx(0.05, abs=4 * sigma)
    assert change.tested_by


@pytest.mark.long
def test_an_encoder_error_twice_per_turn():
    """Its mimic to first order is polarisation of the telescope: told apart, or told as a class."""
    result = found([Described.saying(["turn of polariser * sin 2 CLP"], [0.08])])
    step = result.steps[0]
    said = {change.text for change, _, _ in step.descriptions} | {
        t for text in itertools.chain(step.nameless, *step.also_called.values()) for t in text.split("; ")
    }
    assert "turn of polariser * sin 2 CLP" in said
    assert result.verdict == "effect_found"


@pytest.mark.long
def test_halves_that_are_vignetted_differently():
    result = found([Vignetting()])
    names = {step.effect for step in result.steps}
    assert names <= {"described"}
    places = {
        f"{change.relation} {change.place}" for step in result.steps for change, _, _ in step.descriptions
    }
    assert result.verdict == "unexplained" or places == {"of half1"} or places == {"of half2"}


def test_a_further_sentence_leaves_the_priors_of_those_before():
    """The first is eight prior widths large, and has a wider prior since: beside a second it keeps that."""
    first, second = "gain of O1 * kind moon", "gain of O2 * hours"
    calset = set_with(3, {first: 2.4e-2, second: 2e-3})
    alone = settled(fit_with(calset, first), [Described.name])
    label = f"described.{first.replace(' ', '_')}"
    mean, width = alone.model[label].prior
    assert width > 2e-2
    trial = try_effect(alone, Described.saying([second], [0.0]))
    assert trial.fit.model[label].prior == (mean, width)
    # A prior of 0.3 % would pull at 2.4 %: by (8² − 1)/2 in ln B.
    assert trial.fit.chi2 / trial.fit.dof < 1.15
    assert trial.evidence > 30.0

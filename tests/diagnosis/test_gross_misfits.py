"""Effects that misfit by hundreds of errors, for which linear steps are wrong by parts of the misfit."""

import pytest
from small_run import SMALL

from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.model.effects.in_models import effect_context
from walop_jax.simulation.simulate import effect_from_text, simulate


@pytest.mark.parametrize(("seed", "effect"), [(6000, "lens_birefringence=0.02"), (6004, "hwp1_crossing=2.0")])
def test_a_gross_effect_is_told_by_its_name(seed, effect):
    """By linear steps a smooth field of all optics, or another retarder, explains more than the effect."""
    sound = simulate(SMALL, seed=seed).calset
    hidden = effect_from_text(effect, effect_context(base_model(sound).template, sound.exposures))
    diagnosis = diagnose(simulate(SMALL, seed=seed, effects=[hidden]).calset)
    assert [step.effect for step in diagnosis.steps] == [effect.partition("=")[0]]
    assert diagnosis.verdict == "effect_found"

"""Effects written as text: what they stand for, and what is wrong with those that stand for nothing."""

from __future__ import annotations

import pytest

from walop_jax.model.effects import EFFECTS
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import effect_from_text

CONTEXT = ObservingPlan().context()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clp_wobbel=1", "clp_wobble"),
        ("clp_wobble=1", "2 parameters"),
        ("clp_wobble=amplitud:1,phase:0", "did you mean 'amplitude'"),
        ("clp_zero", "needs a value of angle, e.g. clp_zero=angle:"),
        ("clp_zero=fast", "does not fit"),
        ("clp_zero=1%", "not a number"),
        ("clp_zero=angle:1,angle:2", "each once"),
        ("chwp_in_beam=1", "give chwp_in_beam alone"),
        ("pedestal=0.1/0.2/0.3", "does not fit"),
        ("blemish=camera:7,depth:0.1", "does not fit|camera"),
    ],
)
def test_effects_that_make_no_sense(text: str, message: str):
    with pytest.raises(ValueError, match=message):
        effect_from_text(text, CONTEXT)


def test_every_effect_can_be_asked_for():
    for kind in EFFECTS:
        names = kind.amplitudes()
        text = f"{kind.name}={','.join(f'{name}:0.01' for name in names)}" if names else kind.name
        assert effect_from_text(text, CONTEXT).name == kind.name
        if len(names) == 1 and not kind.shape:
            assert effect_from_text(f"{kind.name}=0.01", CONTEXT).name == kind.name


def test_values_are_those_of_the_text():
    effect = effect_from_text("clp_wobble = amplitude: 0.06, phase:-1.1", CONTEXT)
    assert (float(effect.amplitude), float(effect.phase)) == (0.06, -1.1)
    assert effect_from_text("pedestal=1/2/3/4", CONTEXT).level.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert effect_from_text("blemish=camera:2,depth:0.1", CONTEXT).choices() == {"camera": 2}

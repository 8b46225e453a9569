"""Physical effects beyond the base model: changes of an instrument, and the catalogue of the named ones."""

from collections.abc import Iterable, Sequence

from walop_jax.model.effects import cameras, numbers, optics
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.effects.catalogue import EFFECTS, EffectKind
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.described import Described, OtherDescription
from walop_jax.model.effects.deviations import Deviations
from walop_jax.model.effects.free_form import FreeForm
from walop_jax.model.parameters import unknown_name


def effect_by_name(name: str, catalogue: Sequence[EffectKind] = EFFECTS) -> EffectKind:
    """The effect of a catalogue by its name; ValueError with the nearest names when there is none.

    >>> walop.effect_by_name("hwp1_axis").__doc__
    'Fast axis of HWP1 turned.'
    """
    for effect in (*catalogue, Described, Deviations, FreeForm, OtherDescription):
        if effect.name == name:
            return effect
    error = unknown_name("effect", name, {effect.name: effect.__doc__ or "" for effect in catalogue})
    raise ValueError(
        f"{error} (walop-jax docs effects lists all; --effects FILE, in Python effects=, adds your own)"
    )


_PROPER = ("Wollaston", "Moon", "Stokes")
"""Names with which the words of an effect may begin, and which keep their capital letter."""


def in_a_sentence(effect: EffectKind) -> str:
    """What an effect is, as it may stand inside a sentence.

    >>> in_a_sentence(effect_by_name("hwp1_axis"))
    'fast axis of HWP1 turned'
    """
    text = (effect.__doc__ or effect.name).strip().splitlines()[0].rstrip(".")
    return text if text.startswith(_PROPER) else text[:1].lower() + text[1:]


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects in the order of the light path; those outside the catalogue come last.

    Other descriptions of the instrument come first: the others act on these.
    """
    order = {effect.name: place for place, effect in enumerate((OtherDescription, *EFFECTS))}
    return tuple(sorted(effects, key=lambda effect: order.get(effect.name, len(order))))

"""Names are sentences with a history: which groups of a grammar an effect of the catalogue already is, or holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from walop_jax.diagnosis.effect_columns import Probe
from walop_jax.diagnosis.grammar import said_by
from walop_jax.model.effects import Context, Effect
from walop_jax.model.instrument import Instrument


def uncovered(
    probes: Sequence[Probe], catalogue: Sequence[type[Effect]], context: Context, instrument: Instrument
) -> tuple[Probe, ...]:
    """The groups that are no effect of a catalogue by another name: those that none holds as a part."""
    known = [texts for texts, _ in _known(catalogue, context, instrument)]
    return tuple(probe for probe in probes if not any(texts.issuperset(said_by(probe)) for texts in known))


def parts(
    probes: Sequence[Probe], catalogue: Sequence[type[Effect]], context: Context, instrument: Instrument
) -> tuple[tuple[Probe, frozenset[type[Effect]]], ...]:
    """The groups that are a part of effects, and none of them as a whole: one patch of all, the light in one camera."""
    known = _known(catalogue, context, instrument)
    found = []
    for probe in probes:
        said = frozenset(said_by(probe))
        holders = frozenset(effect for texts, effect in known if texts > said)
        if holders and not any(texts == said for texts, _ in known):
            found.append((probe, holders))
    return tuple(found)


def _known(
    catalogue: Sequence[type[Effect]], context: Context, instrument: Instrument
) -> list[tuple[frozenset[str], type[Effect]]]:
    """What the effects are in sentences, shape by shape, each with an amplitude of its own."""
    found = []
    for effect in catalogue:
        for group in effect.probes(context):
            texts = frozenset(group[0].in_sentences(instrument))
            if len(texts) <= sum(
                np.size(getattr(one, name)) for one in group for name in effect.amplitudes()
            ):
                found.append((texts, effect))
    return found

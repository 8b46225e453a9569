"""Sentences on all that an instrument may lack: kind × place × dependence, from its own train and its exposures.

A *group* of sentences is one candidate of the score test: a linear retarder has two axes, a harmonic a cosine and a
sine, a gradient two directions. Groups are short: at most two things are free beside the kind.

    kinds         diattenuation, retardance (linear: q and u; circular: v), depolarisation; turn of the polariser; gain
                  of a camera or of an arm; light of one camera in another, of the opposite field point, scattered
                  light, afterglow; numbers of wave plates (axis, cut, thickness, thermal); fringes of the air ahead of
                  them; displacement of the field; shift of the band; polarisation of the Moon sky or of a star
    places        ahead of and behind every element that acts on polarisation, in the common train and in the arms; of
                  the polariser; of a moving element; of a source
    dependence    none; gradient, r², radial, diagonal, astigmatic over the field; wavelength; time, temperature, hour
                  angle; harmonics of the angles; one night; from a time on; a spell; one exposure; a kind of
                  exposures; the counts; the exposure before

Each sentence pays the logarithm of their number; longer ones pay by their evidence. `beside_names` tells which
groups an effect of the catalogue already is, or holds.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from walop_jax.data.records import Exposures
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.dependences import STEPS, Asked, between, starts_of_steps
from walop_jax.diagnosis.hypotheses import Probe, applicable, probes, said_by
from walop_jax.likelihood import limits
from walop_jax.model.conventions import Units
from walop_jax.model.effects import Context, Described, EffectKind
from walop_jax.model.effects.change import BAND, OPPOSITE, SKY
from walop_jax.model.effects.change import Change as Sentence
from walop_jax.model.effects.etalon import probed_gaps
from walop_jax.model.effects.numbers import OF_SOURCES
from walop_jax.model.effects.optics import DISPLACEMENTS, GENERATORS
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.geometry import PupilMapping
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.slots import acts
from walop_jax.model.specification import effect_context

# -------------------------------------------------------------------------------------------------------- all sentences

LINEAR = ("diattenuation", "retardance")
ALONE = ("diattenuation v", "retardance v", "depolarisation")
ROUNDED = 1e-4  # hours, of times that are written into a description
HARMONICS = (1, 2)
HARMONICS_OF_ENCODER = (1, 2, 3, 4, 5, 6)


def sentences(instrument: Instrument, exposures: Exposures, points: int) -> tuple[Probe, ...]:
    """All groups that an instrument and its exposures allow, short ones first; `points` counts the field points."""
    found = dict.fromkeys(_groups(dataclasses.replace(instrument, effects=()), exposures, points))
    return tuple(_probe(group) for group in sorted(found, key=len))


def _probe(group: tuple[Sentence, ...]) -> Probe:
    members = tuple(Described.of(Context(), sentences=(sentence.text,)) for sentence in group)
    return Probe("; ".join(sentence.text for sentence in group), Described, members)


# ----------------------------------------------------------------------------------------- all that may be missing


class Hypotheses(NamedTuple):
    """All that a model may lack: effects that fit the instrument, their probes, and sentences.

    `sentences` are those that no effect holds, `parts` those that effects hold in part, with the holders, `every` are
    all of them, those that are an effect by another name as well.
    """

    effects: tuple[EffectKind, ...]
    names: tuple[Probe, ...]
    sentences: list[Probe]
    parts: list[tuple[Probe, frozenset[EffectKind]]]
    every: tuple[Probe, ...]

    @property
    def amplitudes(self) -> int:
        """Number of all amplitudes."""
        return sum(len(probe.widths) for probe in (*self.names, *self.every))


def hypotheses(
    catalogue: Sequence[EffectKind], instrument: Instrument, exposures: Exposures, points: int
) -> Hypotheses:
    """The one list of what a diagnosis looks for, the verdict of a fit is held against, and limits are given beside."""
    context, every = effect_context(instrument, exposures), sentences(instrument, exposures, points)
    effects = applicable(catalogue, context, instrument)
    alone, parts = beside_names(every, effects, context, instrument)
    return Hypotheses(effects, tuple(probes(effects, context)), alone, parts, every)


# ------------------------------------------------------------------------------------- names that are sentences


def beside_names(
    every: Sequence[Probe], catalogue: Sequence[EffectKind], context: Context, instrument: Instrument
) -> tuple[list[Probe], list[tuple[Probe, frozenset[EffectKind]]]]:
    """The groups that are no effect of a catalogue by another name: those that none holds, and parts, with the holders.

    A part is a group that effects hold, none of them as a whole: one patch of all, the light in one camera.
    """
    known = []  # what the effects are in sentences, shape by shape, each with an amplitude of its own
    for effect in catalogue:
        for group in effect.probes(context):
            texts = frozenset(group[0].in_sentences(instrument))
            if len(texts) <= sum(
                np.size(getattr(one, name)) for one in group for name in effect.amplitudes()
            ):
                known.append((texts, effect))
    alone, parts = [], []
    for probe in every:
        said = frozenset(said_by(probe))
        holders = frozenset(effect for texts, effect in known if texts > said)
        if any(texts == said for texts, _ in known):
            continue
        if holders:
            parts.append((probe, holders))
        else:
            alone.append(probe)
    return alone, parts


def retimed(sentence: Sentence, exposures: Exposures, end: int) -> list[Sentence]:
    """The same with another start (`end` 0) or stop (1), at every time as near as others that are looked at first.

    None for what does not start or stop between two exposures.
    """
    times = starts_of_steps(exposures)
    if [factor.form for factor in sentence.grows_with] != ["hours"]:
        return []
    given = [float(text) for text in sentence.grows_with[0].given]
    at = int(np.argmin(np.abs(times - given[end])))
    if abs(times[at] - given[end]) > ROUNDED:
        return []
    reach = -(-len(times) // STEPS)
    near = times[max(at - reach, 0) : at + reach + 1]
    spans = [(time, given[1]) if end == 0 else (given[0], time) for time in near]
    return [dataclasses.replace(sentence, factors=(between(*span),)) for span in spans if span[0] < span[1]]


# -------------------------------------------------------------------------------------------------- the grammar


def _groups(instrument: Instrument, exposures: Exposures, points: int) -> Iterator[tuple[Sentence, ...]]:
    asked = Asked.of(exposures, points)
    yield from _of_polariser(instrument, asked)
    for where, place, fixed in places(instrument, exposures):
        for factor in (None, *(asked.slow() if fixed else ())):
            base = _anything(where, place) if factor is None else _times(_anything(where, place), factor)
            yield base
            if asked.over_field:
                yield _times(base, "x", "y")
                yield _times(base, "r2")
        for base in _families(where, place):
            yield from _over_field(base, asked)
            if not fixed:
                continue
            for factor in (*(("colour",) if asked.colours else ()), *asked.slow()):
                yield _times(base, factor)
                yield from (_times(one, factor) for one in _grown(base, asked))
    for prefix, element in _turning(instrument, exposures).items():
        if element is instrument.polariser:
            continue
        for base in _families("of", element.name):
            for pair in asked.harmonics(prefix, HARMONICS):
                yield _times(base, *pair)
        inside = exposures.position(prefix).inside
        for span in (*asked.steps(inside), *asked.spells(inside)):
            yield (Sentence("turn", "of", element.name, (span,)),)
    yield from _ahead(instrument, asked)
    yield from _of_plates(instrument, exposures, asked)
    yield from _of_cameras(instrument, asked)
    yield from _of_field_and_band(instrument, asked)
    yield from _of_sources(instrument, asked)
    yield from _together(instrument, asked)


def _turning(instrument: Instrument, exposures: Exposures) -> dict[str, Element]:
    """Elements of the common train that move and are in the beam in some exposure, by the prefix of their columns."""
    moving = {element.moves: element for element in instrument.train() if element.moves}
    return {prefix: element for prefix, element in moving.items() if exposures.position(prefix).inside.any()}


def _times(base: tuple[Sentence, ...], *factors: str) -> tuple[Sentence, ...]:
    return tuple(sentence.times(factor) for sentence in base for factor in factors)


def _families(where: str, place: str) -> Iterator[tuple[Sentence, ...]]:
    for kind in LINEAR:
        yield tuple(Sentence(f"{kind} {axis}", where, place) for axis in "qu")
    for kind in ALONE:
        yield (Sentence(kind, where, place),)


def _anything(where: str, place: str) -> tuple[Sentence, ...]:
    """All that an element can do to polarisation to first order, where it is coated, tilted and stressed at once."""
    return tuple(Sentence(kind, where, place) for kind in GENERATORS)


def _over_field(base: tuple[Sentence, ...], asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    yield base
    if not asked.over_field:
        return
    yield _times(base, "x", "y")
    yield _times(base, "r2")
    if len(base) == 1:
        yield _times(base, "x2-y2", "xy")
        return
    kind = base[0].kind.split()[0]
    for axis in ("radial", "diagonal"):
        yield (dataclasses.replace(base[0], kind=f"{kind} {axis}"),)


def _grown(base: tuple[Sentence, ...], asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    """The patterns of the field that stress and temperature make: with the radius, radial, diagonal."""
    if asked.over_field:
        yield from itertools.islice(_over_field(base, asked), 2, None)


def _ahead(instrument: Instrument, asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    """Changes of light from the sky that differ between exposures: telescopes turn, warm up and gather dust."""
    polariser, exposures = instrument.polariser, asked.exposures
    if polariser is None or exposures.clp_in.all():
        return
    added = tuple(Sentence(f"added polarisation {axis}", "ahead of", polariser.name) for axis in "qu")
    if asked.over_field:
        yield _times(added, "x", "y")
        yield _times(added, "r2")
    for factor in (*asked.slow(), *asked.hour_angle(), *asked.single()):
        yield _times(added, factor)
        for base in _families("ahead of", polariser.name):
            yield _times(base, factor)


def _of_polariser(instrument: Instrument, asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    polariser = instrument.polariser
    if polariser is None or polariser.moves is None or not asked.exposures.clp_in.any():
        return
    turn = (Sentence("turn", "of", polariser.name),)
    for base in (turn, *(f for f in _families("of", polariser.name) if f[0].kind != "retardance v")):
        yield from _over_field(base, asked)
        orders = HARMONICS_OF_ENCODER if base is turn else HARMONICS
        for pair in asked.harmonics(polariser.moves, orders):
            yield _times(base, *pair)
        for factor in (*asked.slow(), *asked.single(), *asked.sides(polariser.moves)):
            yield _times(base, factor)
    for pair in asked.harmonics(polariser.moves, (1,)) if asked.over_field else ():
        yield _times(_times(turn, *pair), "x", "y")  # a beam that wanders over a film that is not uniform
    inside = asked.exposures.clp_in
    for span in (*asked.nights(), *asked.steps(inside), *asked.spells(inside)):
        yield _times(turn, span)
    if asked.over_field and len(asked.exposures) <= limits.FREE_EXPOSURES:
        for number in np.flatnonzero(asked.exposures.clp_in):
            yield _times(turn, f"exposure {number}")


def places(instrument: Instrument, exposures: Exposures) -> Iterator[tuple[str, str, bool]]:
    """Places of the train that differ in what acts on polarisation: preposition, element, and whether it may depend on
    wavelength, time and temperature there (ahead of the polariser nothing may)."""
    train, polariser = list(instrument.train()), instrument.polariser
    if polariser is not None:
        if not exposures.clp_in.all():
            yield "ahead of", polariser.name, False
        yield "behind", polariser.name, True
    behind = train[len(instrument.telescope()) + (polariser is not None) :]
    if polariser is None and behind:
        yield "ahead of", behind[0].name, True
    for element in behind:
        if acts(element) and (element.moves is None or exposures.position(element.moves).inside.any()):
            yield "behind", element.name, True
    for arm in instrument.arms:
        own = list(arm.train())
        if len(instrument.arms) > 1:
            yield "ahead of", f"{arm.name}.{own[0].name if own else arm.analyser.name}", True
        for element in own:
            if acts(element):
                yield "behind", f"{arm.name}.{element.name}", True


def _of_plates(instrument: Instrument, exposures: Exposures, asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    warm = []
    for place in instrument.places(WavePlate):
        arm, _, name = place.rpartition(".")
        holder = next(a for a in instrument.arms if a.name == arm).elements if arm else instrument.elements
        plate = next(e for e in holder if e.name == name)
        assert isinstance(plate, WavePlate)
        if plate.moves is not None and not exposures.position(plate.moves).inside.any():
            continue
        yield (Sentence("axis", "of", place),)
        for step in asked.steps():
            yield (Sentence("axis", "of", place, (step,)),)
        warm.append(Sentence("thermal", "of", place))
        layers = [f"{place}.{layer.name}" for layer in plate.layers]
        yield tuple(Sentence("thickness", "of", layer) for layer in layers)
        for layer in layers[1:]:
            yield (Sentence("axis", "of", layer),)
        for layer in layers:
            yield (Sentence("cut", "of", layer),)
    if warm and asked.kelvin:
        yield tuple(warm)
    yield from _fringes_ahead([sentence.place for sentence in warm], instrument.units)


def _fringes_ahead(plates: Sequence[str], units: Units) -> Iterator[tuple[Sentence, ...]]:
    """Cosine and sine of the fringes of an air gap ahead of one plate, and of the same gap ahead of all of them."""
    for pair in probed_gaps(units) if plates else ():
        pairs = [tuple(Sentence("fringes", "of", place, (f"gap {g:g}",)) for g in pair) for place in plates]
        yield from pairs
        if len(pairs) > 1:
            yield tuple(itertools.chain(*pairs))


def _of_field_and_band(instrument: Instrument, asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    yield (Sentence("shift", "of", BAND),)
    for element in instrument.train() if asked.over_field else ():
        if isinstance(element, PupilMapping):
            moved = tuple(Sentence(kind, "ahead of", element.name) for kind in DISPLACEMENTS)
            yield moved
            for factor in (*asked.slow(), *asked.hour_angle()):
                yield _times(moved, factor)


def _of_sources(instrument: Instrument, asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    own = tuple(Sentence(kind, "of", SKY) for kind in OF_SOURCES)
    moon = np.flatnonzero(asked.exposures.direct("moon"))
    if moon.size:
        yield own[2:]
    each = [_times(own[:2], f"exposure {number}") for number in moon]
    if 0 < len(each) <= limits.FREE_EXPOSURES:
        yield from each
        if len(each) > 1:
            yield tuple(itertools.chain(*each))
    for name in instrument.standard.names:
        yield tuple(Sentence(kind, "of", name.replace(" ", "_")) for kind in OF_SOURCES[:2])


def _together(instrument: Instrument, asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    """The same kind at the same place of every arm, or in every camera, each with its own amplitude."""
    arms, names = instrument.arms, instrument.cameras.names
    if len(arms) > 1 and len({arm.path for arm in arms}) == 1:
        for element in arms[0].train():
            if acts(element):
                each = [list(_families("behind", f"{arm.name}.{element.name}")) for arm in arms]
                yield from (tuple(itertools.chain(*same)) for same in zip(*each, strict=True))
    plates = [place for place in instrument.places(WavePlate) if "." in place]
    if len(plates) > 1:
        yield tuple(Sentence("axis", "of", place) for place in plates)
    yield tuple(Sentence("gain", "of", name, ("counts",)) for name in names)
    if asked.over_field:
        yield tuple(Sentence("light", "in", name) for name in names)
        every = tuple(Sentence("gain", "of", name) for name in names)
        for prefix in _turning(instrument, asked.exposures):
            for pair in asked.harmonics(prefix, (1,)):
                yield _times(_times(every, *pair), "x", "y")
    if asked.hours:
        yield tuple(Sentence("afterglow", "in", name) for name in names)
    if asked.over_field:
        yield tuple(Sentence("light", "in", name, origin=OPPOSITE) for name in names)
    pairs = zip(names, instrument.cameras.orthogonal, strict=True)
    yield tuple(Sentence("light", "in", name, origin=names[j]) for name, j in pairs if names[j] != name)


def _of_cameras(instrument: Instrument, asked: Asked) -> Iterator[tuple[Sentence, ...]]:
    cameras, e = instrument.cameras.names, asked.exposures
    for camera in cameras:
        gain = (Sentence("gain", "of", camera),)
        yield _times(gain, "counts")
        for prefix in _turning(instrument, e):
            for pair in asked.harmonics(prefix, HARMONICS_OF_ENCODER):
                yield _times(gain, *pair)
            for pair in asked.harmonics(prefix, (1,)) if asked.over_field else ():
                yield _times(_times(gain, *pair), "x", "y")  # an image that goes in a circle
        for factor in (*asked.slow(), *asked.single(), *asked.nights(), *asked.steps()):
            yield _times(gain, factor)
        if asked.over_field and len(e) <= limits.FREE_EXPOSURES:
            for number in range(len(e)):
                yield _times(gain, f"exposure {number}")
        for kind in asked.kinds():
            yield _times(gain, kind)
        if asked.over_field:
            for factor in (*asked.slow(), *asked.single(), *asked.kinds()):
                yield _times(_times(gain, factor), "x", "y")
            for factor in asked.slow():
                yield (*_times(gain, factor), *_times(_times(gain, factor), "r2"))  # a focus that drifts
        light = (Sentence("light", "in", camera),)
        if asked.over_field:
            yield (Sentence("light", "in", camera, origin=OPPOSITE),)
            yield light
            for factor in asked.slow():
                yield _times(light, factor)
        if asked.hours:
            yield (Sentence("afterglow", "in", camera),)
        for other in cameras:
            if other != camera:
                yield (Sentence("light", "in", camera, origin=other),)
    for arm in instrument.arms if len(instrument.arms) > 1 else ():
        gain = (Sentence("gain", "of", arm.name),)
        for factor in (*asked.slow(), *asked.single(), *asked.nights()):
            yield _times(gain, factor)
        if asked.over_field:
            yield _times(gain, *(f"ring {n}" for n in thresholds.RINGS))
            both = tuple(Sentence("gain", "of", name) for name in arm.analyser.cameras)
            for factor in (*asked.kinds(), *asked.single()):
                yield _times(_times(both, factor), "x", "y")
                yield _times(_times((Sentence("gain", "of", arm.name),), factor), "x", "y")

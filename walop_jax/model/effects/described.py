"""What is missing and has no name, but can be said in a sentence: a kind, at a place, growing with something.

Not in the catalogue: `diagnose` tries all sentences that an instrument and its exposures allow (`diagnosis/grammar.py`)
beside the names, and adds one where it explains the data better than any name. Several of them are one effect.

Equation    diattenuation, retardance    M → (1 + a f G) M, G the generator along q, u or v; radial: x² − y² along q,
                                         2xy along u; diagonal: −2xy and x² − y²
            depolarisation               q, u, v → (1 − a f) (q, u, v)
            turn                         of the polariser: its axis at a f more than its reading
            gain                         N → N (1 + a f), of one camera or of all cameras of an arm
            light                        N_k → N_k + a f N_j, of another camera j; of no origin: a f × the median
                                         counts; of opposite: N at (−X, −Y) in the same camera, extended sources only
            fringes                      of a plate: D = a cos(4π gap cos ϑ / λ) along its axis, ahead of it (`etalon`)
            displacement                 of what the optics behind see: X → X + a f, or Y
            shift                        of the band: filters wider than 0.05 µm displaced by a (`filter_shift`)
            polarisation                 of a star: Q + a, or U, in the equatorial frame; of the Moon sky: degree + a,
                                         or, in one exposure, q + a, or u, in the frame of the instrument
            afterglow                    N_ke → N_ke + a f N_k of the exposure before
            axis, cut, thickness, thermal   a number of an element, and a added to it
Symbols     a amplitude, by its unit in `share`, `retardance` (rad), `angle` and `displacement` (deg), `length` and
            `wavelength` (µm) or `number`; f product of the factors of the sentence
Source      Lu & Chipman 1996, JOSA A 13, 1106: every Mueller matrix near the identity is a product of these
Neutral     all zero
Revealed by data that no name explains as well
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.effects.described_parts import (
    CrossTalk,
    DetectorTerm,
    Displaced,
    Gain,
    Shade,
    Terms,
    TermsOfPolariser,
    Weights,
)
from walop_jax.model.effects.etalon import with_air_gap
from walop_jax.model.effects.ghost import PointGhost
from walop_jax.model.effects.sentence import (
    BAND,
    DISPLACEMENTS,
    KINDS,
    NUMBERS,
    OPPOSITE,
    POLARISATION,
    SKY,
    Sentence,
)
from walop_jax.model.elements import Element
from walop_jax.model.parameters import param, unknown_name
from walop_jax.model.sources import Patches

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Lu & Chipman 1996, JOSA A 13, 1106"


def _amplitude(unit: str, about: str, width: float) -> Any:
    return param(unit=unit, about=about, source=f"{SOURCE}; width: expected size", width=width)


@functools.lru_cache(maxsize=64)
def _zeros(count: int) -> Float[Array, " n"]:
    """So many zeros; there are thousands of sentences that say nothing yet."""
    with jax.ensure_compile_time_eval():
        return jnp.zeros(count)


class Described(Effect):
    """Sentences about what is missing, each with an amplitude in the parameter of its unit."""

    share: Float[Array, " a"] = _amplitude("", "share", 0.003)
    retardance: Float[Array, " b"] = _amplitude("rad", "retardance", 0.02)
    angle: Float[Array, " c"] = _amplitude("deg", "angle", 0.1)
    displacement: Float[Array, " f"] = _amplitude("deg", "displacement in the field", 0.005)
    length: Float[Array, " d"] = _amplitude("um", "length", 5.0)
    wavelength: Float[Array, " w"] = _amplitude("um", "displacement of the band", 0.003)
    number: Float[Array, " n"] = _amplitude("", "number", 1.0)
    sentences: tuple[str, ...] = eqx.field(static=True, default=(), converter=tuple)

    name: ClassVar[str] = "described"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "data that no name explains as well"
    separated_by: ClassVar[str] = "exposures in which its dependence differs from that of the others"

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """Nothing said."""
        return cls.of(context)

    @classmethod
    def of(cls, context: Context, **values: Any) -> Self:
        """The sentences that are given, zero but for values given. Raises ValueError for what is no sentence."""
        del context
        sentences = tuple(values.pop("sentences", ()))
        held = [Sentence.parsed(text).parameter for text in sentences]
        known = tuple(dict.fromkeys(KINDS.values()))
        for name in values:
            if name not in known:
                raise unknown_name(f"parameter of {cls.name}", name, (*known, "sentences"))
        arrays = {
            name: jnp.broadcast_to(jnp.asarray(values[name], float), (held.count(name),))
            if name in values
            else _zeros(held.count(name))
            for name in known
        }
        return cls(**arrays, sentences=sentences)

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """None: sentences are found by `diagnosis.grammar`."""
        del context
        return ()

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """One effect of members with a sentence each."""
        return cls.saying([text for member in group for text in member.sentences], amplitudes)

    @classmethod
    def saying(cls, sentences: Sequence[str], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """Sentences with their amplitudes, in the same order."""
        held: dict[str, list[float]] = {}
        for text, amplitude in zip(sentences, amplitudes, strict=True):
            held.setdefault(Sentence.parsed(text).parameter, []).append(float(amplitude))
        return cls.of(Context(), sentences=sentences, **held)

    def joined(self, other: Described) -> Described:
        """These sentences and others that it has not."""
        new = [(s.text, float(a)) for s, a in other.terms() if s.text not in self.sentences]
        terms = [(s.text, float(a)) for s, a in self.terms()] + new
        return Described.saying([text for text, _ in terms], [value for _, value in terms])

    def labels(self, field: str) -> Sequence[str]:
        """The sentences themselves, without blanks."""
        return [s.label for s in map(Sentence.parsed, self.sentences) if s.parameter == field]

    def terms(self) -> Iterator[tuple[Sentence, Scalar]]:
        """Every sentence with its amplitude."""
        count = dict.fromkeys(KINDS.values(), 0)
        for sentence in map(Sentence.parsed, self.sentences):
            yield sentence, getattr(self, sentence.parameter)[count[sentence.parameter]]
            count[sentence.parameter] += 1

    def patch(self, instrument: Instrument) -> Instrument:
        """Insert what stands in the light path, place by place, and add the rest to the cameras."""
        at: dict[tuple[str, str], list[tuple[Sentence, Scalar]]] = {}
        for sentence, amplitude in self.terms():
            if sentence.kind in (*NUMBERS, "shift"):
                instrument = _with_number(instrument, sentence, amplitude)
            elif sentence.kind == "fringes":
                gap = jnp.asarray(sentence.gap)
                instrument = with_air_gap(instrument, sentence.place, amplitude, gap)
            elif sentence.kind in POLARISATION:
                instrument = _with_polarisation(instrument, sentence, amplitude)
            elif sentence.kind in DISPLACEMENTS:
                moved = Displaced(name="described", amplitude=amplitude, sentence=sentence)
                instrument = instrument.inserted(moved, before=sentence.place)
            elif sentence.kind in ("gain", "light", "afterglow"):
                instrument = _with_camera(instrument, sentence, amplitude)
            else:
                at.setdefault((sentence.where, sentence.place), []).append((sentence, amplitude))
        for (where, place), terms in at.items():
            instrument = _with_terms(instrument, where, place, terms)
        return instrument


def _with_number(instrument: Instrument, sentence: Sentence, amplitude: Scalar) -> Instrument:
    def added(value: Scalar | None) -> Scalar:
        return amplitude if value is None else value + amplitude

    if sentence.kind == "shift":
        if sentence.place != BAND:
            raise unknown_name("place of a shift", sentence.place, (BAND,))
        return instrument.changed("", filter_shift=added)
    return instrument.changed(sentence.place, **{sentence.kind: added})


def _with_polarisation(instrument: Instrument, sentence: Sentence, amplitude: Scalar) -> Instrument:
    axis = sentence.kind.removeprefix("polarisation").strip()
    if sentence.place != SKY:
        names = [name.replace(" ", "_") for name in instrument.standard.names]
        if sentence.place not in names or not axis:
            known = [f"polarisation q of {name}" for name in names]
            raise unknown_name("sentence", f"{sentence.kind} of {sentence.place}", known)
        row = names.index(sentence.place)
        return instrument.changed("standard", **{axis: lambda value: value.at[row].add(amplitude)})
    if not axis:
        return instrument.changed("sky", missing=lambda p: -amplitude if p is None else p - amplitude)
    own = {"q": jnp.zeros(1), "u": jnp.zeros(1)} | {axis: jnp.reshape(amplitude, 1)}
    here = Patches(**own, positions=(sentence.number,))
    return instrument.changed("sky", patches=lambda there: here if there is None else there.joined(here))


def _with_terms(
    instrument: Instrument, where: str, place: str, terms: Sequence[tuple[Sentence, Scalar]]
) -> Instrument:
    sentences, amplitudes = (tuple(column) for column in zip(*terms, strict=True))
    polariser = instrument.polariser
    if where == "of" and polariser is not None and place == polariser.name:
        film = TermsOfPolariser(amplitudes, sentences)
        return instrument.changed(place, films=lambda films: (*films, film))
    own = Terms(name="described", amplitudes=amplitudes, sentences=sentences)
    if where != "of":
        return instrument.inserted(own, **({"before": place} if where == "ahead of" else {"after": place}))
    # With the element, where it moves.
    own = dataclasses.replace(own, moves=element_at(instrument, place).moves)
    return instrument.inserted(own, after=place)


def element_at(instrument: Instrument, place: str) -> Element:
    """An element by the name that `inserted` takes. Raises `NoSuchPlaceError` where there is none."""
    from walop_jax.model.instrument import NoSuchPlaceError

    arm, _, name = place.rpartition(".")
    trains = [one.train() for one in instrument.arms if one.name == arm] if arm else [instrument.train()]
    for element in (element for train in trains for element in train):
        if element.name == name:
            return element
    raise NoSuchPlaceError(f"the instrument has no element {place!r}")


def _with_camera(instrument: Instrument, sentence: Sentence, amplitude: Scalar) -> Instrument:
    cameras = cameras_of(instrument, sentence.place)
    if sentence.origin == OPPOSITE:
        return instrument.with_part("ghosts", PointGhost(amplitude * jnp.asarray(cameras)))
    if sentence.kind == "light" and sentence.origin:
        target, origin = cameras.index(1.0), cameras_of(instrument, sentence.origin).index(1.0)
        return instrument.with_part("mixing", CrossTalk(amplitude, target, origin))
    if sentence.kind == "gain" and "counts" not in sentence.factors:
        if sentence.exposure_factors:
            return instrument.with_part("exposures", Gain(amplitude, sentence, cameras))
        return instrument.with_part("transmission", Shade(amplitude, sentence, cameras))
    return instrument.with_part("detectors", DetectorTerm(amplitude, sentence, cameras))


def cameras_of(instrument: Instrument, place: str) -> Weights:
    """1 for the cameras that a place means: one of them, or those of an arm. Raises ValueError for any other name."""
    names = instrument.cameras.names
    for arm in instrument.arms:
        if arm.name == place:
            return tuple(float(name in arm.analyser.cameras) for name in names)
    if place not in names:
        raise unknown_name("camera or arm", place, (*names, *(arm.name for arm in instrument.arms)))
    return tuple(float(name == place) for name in names)

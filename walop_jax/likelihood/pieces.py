"""Places at which the parts of a change act: sentences in terms of the responses (`model.responses`).

A piece is a slot of the responses with a coefficient and factors:

    inserted, numbers, globally, throughput     slots of `Responses`; mixed: light of one camera in another
    fringes                                     plate and thickness of the air ahead of it
    light                                       slot of `LightResponses`, of all or of one star; a generator at the
                                                polariser or ahead of it
    counts, opposite                            counts ahead of the detectors, of a point and of the opposite one
    square, median, reported, afterglow         what is added to the counts that detectors report

Beside the sentences that users type there are kinds for what effects of the catalogue do: zero, extinction and
ellipticity of the polariser and the rotator (`responses.LIGHT`); "added polarisation"; "shade", a gain that no
exposure changes; "reported gain", of the counts that detectors report.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from walop_jax.model import responses
from walop_jax.model.effects.cameras import cameras_of, stage_of
from walop_jax.model.effects.change import BAND, SKY
from walop_jax.model.effects.change import Change as Sentence
from walop_jax.model.effects.numbers import NUMBERS
from walop_jax.model.elements import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.responses import GENERATORS, LIGHT, TrainPlace


class NoColumnError(ValueError):
    """A sentence that the responses do not hold: its own derivative is asked for."""


@functools.cache
def _inside(prefix: str) -> Callable[[Any], np.ndarray]:
    """The factor that is 1 where a moving element is in the beam."""

    def inside(at: Any) -> np.ndarray:
        return 1.0 * at.likelihood.calset.exposures.position(prefix).inside[None]

    return inside


class Piece(NamedTuple):
    """A part of a change: what it acts on (`kind`, with `at` the slot), times a coefficient and factors."""

    kind: str
    at: tuple[Any, ...]
    size: float
    factors: tuple[Any, ...]


def _optical(kind: str) -> Iterator[tuple[str, float, tuple[str, ...]]]:
    """Generators of a kind of the optics, with coefficients and factors."""
    if kind in GENERATORS:
        yield kind, 1.0, ()
    elif kind == "turn":  # of the light
        yield "retardance v", -2.0 * np.pi / 180.0, ()
    else:
        name, _, axis = kind.partition(" ")
        along = {"radial": ((1.0, "x2-y2"), (1.0, "xy")), "diagonal": ((-1.0, "xy"), (1.0, "x2-y2"))}.get(
            axis
        )
        if along is None:
            raise NoColumnError(kind)
        for element, (size, factor) in zip("qu", along, strict=True):
            yield f"{name} {element}", size, (factor,)


class Resolver:
    """Sentences of an instrument (`patched`) as pieces of its responses; `thermal` are factors of thermal changes."""

    def __init__(self, instrument: Instrument, thermal: tuple[str, ...]) -> None:
        self.instrument, self.thermal = instrument, thermal
        common, arms = responses.trains(instrument)
        self._trains, self._places = (common, *arms), responses.places(instrument)
        self._globally, self._numbers = (
            responses.global_slots(instrument),
            responses.plate_numbers(instrument),
        )
        self._polariser = None if instrument.polariser is None else instrument.polariser.name
        self._plates: dict[str, tuple[int, WavePlate]] = {}
        for number, (arm, i) in enumerate(responses.plates(instrument)):
            plate = self._trains[arm + 1][i]
            assert isinstance(plate, WavePlate)
            name = plate.name if arm < 0 else f"{instrument.arms[arm].name}.{plate.name}"
            self._plates[name] = number, plate

    def _place(self, where: str, place: str) -> int:
        arm, _, name = place.rpartition(".")
        names = [one.name for one in self.instrument.arms]
        number = names.index(arm) if arm in names else -1
        elements = [element.name for element in self._trains[number + 1]]
        if number >= 0 and name == self.instrument.arms[number].analyser.name:
            at = len(elements)
            return self._places[TrainPlace(number, at + (where != "ahead of"))]
        if place == self._polariser and where == "behind":
            return self._places[TrainPlace(-1, 0)]
        if name not in elements or (arm and number < 0):
            raise NoColumnError(f"{where} {place}")
        return self._places[TrainPlace(number, elements.index(name) + (where != "ahead of"))]

    def _plate(self, place: str) -> tuple[int, WavePlate, str]:
        """Number of the plate that a place is of or in, the plate, and the name of the layer."""
        for name, (number, plate) in self._plates.items():
            if place == name or place.startswith(f"{name}."):
                return number, plate, place[len(name) + 1 :]
        raise NoColumnError(place)

    def pieces(self, sentence: Sentence) -> Iterator[Piece]:
        """The pieces of a sentence. Raises `NoColumnError` for what the responses do not hold."""
        kind, place = sentence.kind, sentence.place
        factors = tuple(f for f in sentence.factors if not str(f).startswith("gap "))
        if kind in LIGHT:
            yield Piece("light", (LIGHT.index(kind),), 1.0, factors)
        elif kind in NUMBERS:
            yield from self._number(sentence, factors)
        elif kind == "fringes":
            yield Piece("fringes", (self._plate(place)[0], sentence.gap), 1.0, factors)
        elif kind == "shift":
            slot = self._globally.index("wavelength")
            yield Piece("globally", (slot, place == BAND), 1.0, factors)
        elif kind.startswith("displacement"):
            slot = f"{kind[-1]} {place}"
            if slot not in self._globally or sentence.where != "ahead of":
                raise NoColumnError(sentence.text)
            at = self._globally.index(slot)
            yield Piece("globally", (at, False), 1.0, factors)
        elif kind.startswith("polarisation"):
            yield from self._polarisation(sentence, factors)
        elif kind in ("gain", "shade", "light", "afterglow", "reported gain"):
            yield from self._camera(sentence, factors)
        else:
            yield from self._optics(sentence, factors)

    def _number(self, sentence: Sentence, factors: tuple[Any, ...]) -> Iterator[Piece]:
        number, plate, layer = self._plate(sentence.place)
        slot = sentence.kind
        if "colour" in factors:
            raise NoColumnError(sentence.text)
        if layer:
            names = [one.name for one in plate.layers]
            if layer not in names:
                raise NoColumnError(sentence.text)
            slot = f"{names.index(layer)}.{sentence.kind}"
        if slot not in self._numbers:
            raise NoColumnError(sentence.text)
        if slot == "thermal":
            factors = (*factors, *self.thermal)
        yield Piece("numbers", (number, self._numbers.index(slot)), 1.0, factors)

    def _polarisation(self, sentence: Sentence, factors: tuple[Any, ...]) -> Iterator[Piece]:
        axis = sentence.kind.removeprefix("polarisation").strip()
        if sentence.place == SKY:
            yield Piece("light", (LIGHT.index(f"sky {axis}".strip()),), 1.0, factors)
            return
        names = [name.replace(" ", "_") for name in self.instrument.standard.names]
        if sentence.place not in names or not axis:
            raise NoColumnError(sentence.text)
        yield Piece("light", (LIGHT.index(f"star {axis}"), names.index(sentence.place)), 1.0, factors)

    def _camera(self, sentence: Sentence, factors: tuple[Any, ...]) -> Iterator[Piece]:
        stage, cameras = stage_of(sentence), cameras_of(self.instrument, sentence.place)
        if stage == "mixed":
            origin = cameras_of(self.instrument, sentence.origin)
            yield Piece("mixed", (int(np.argmax(cameras)), int(np.argmax(origin))), 1.0, factors)
        elif stage == "throughput":
            for camera in np.flatnonzero(cameras):
                yield Piece("throughput", (int(camera),), 1.0, factors)
        else:
            yield Piece(stage, cameras, 1.0, tuple(f for f in factors if stage != "square" or f != "counts"))

    def _optics(self, sentence: Sentence, factors: tuple[Any, ...]) -> Iterator[Piece]:
        colour = factors.count("colour")
        rest = tuple(f for f in factors if f != "colour")
        names = tuple(GENERATORS)
        if sentence.place == self._polariser and sentence.where != "behind":
            if colour:
                raise NoColumnError(sentence.text)
            film = "film" if sentence.where == "of" else "ahead"
            if sentence.kind.startswith("added polarisation"):
                yield Piece("light", (film, sentence.kind[-1]), 1.0, rest)
                return
            for generator, size, more in _optical(sentence.kind):
                yield Piece("light", (film, generator), size, (*rest, *more))
            return
        if colour > 1:
            raise NoColumnError(sentence.text)
        if sentence.where == "of":
            name = sentence.place.rpartition(".")[2]
            moves = next((e.moves for train in self._trains for e in train if e.name == name), None)
            if moves is not None:
                rest = (*rest, _inside(moves))
        place = self._place(sentence.where, sentence.place)
        for generator, size, more in _optical(sentence.kind):
            yield Piece("inserted", (place, colour, names.index(generator)), size, (*rest, *more))

"""Other descriptions of an instrument: elements in another order or turned, left out, of another published dispersion.

A change is a sentence and a function of the instrument. The sentences name places as `Instrument.changed` does. What is
listed are mistakes that are made when an instrument is described, or built: nothing has a size, everything is so or
otherwise. Changes that make no difference to the light (plates that commute) are listed too: data tell.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator

import jax.numpy as jnp

from walop_jax.model import materials
from walop_jax.model.elements import Analyser, Element, Layer, Polariser, WavePlate, Wedge
from walop_jax.model.instrument import Arm, Instrument
from walop_jax.model.parameters import unknown_name

Rearrangement = Callable[[Instrument], Instrument]
Named = tuple[str, Rearrangement]

TURNS = (90.0, 180.0, 270.0)  # degrees
JOINED = "; "


def alternatives(instrument: Instrument) -> dict[str, Rearrangement]:
    """All changes of a description that an instrument has places for, by what they say."""
    return dict(
        itertools.chain(
            _layers(instrument),
            _turned_plates(instrument),
            _turned_wedges(instrument),
            _beams(instrument),
            _order(instrument),
            _in_or_out(instrument),
            _dispersion(instrument),
        )
    )


def other_curves(instrument: Instrument) -> tuple[str, ...]:
    """Those of the changes that are another dispersion."""
    return tuple(sentence for sentence, _ in _dispersion(instrument))


def changed(instrument: Instrument, sentence: str) -> Instrument:
    """The instrument with the changes that a sentence names, one after the other; as it is for an empty one.

    Raises ValueError, with the nearest sentences, for one that the instrument has no place for.
    """
    for part in sentence.split(JOINED) if sentence else ():
        known = alternatives(instrument)
        if part not in known:
            raise unknown_name(f"change of {instrument.name}", part, known)
        instrument = known[part](instrument)
    return instrument


def _each_and_all(
    places: tuple[str, ...], what: str, change: Callable[[Instrument, str], Instrument]
) -> Iterator[Named]:
    """A change at each of the places, and at all of them together."""
    for place in places:
        yield f"{place} {what}", lambda instrument, place=place: change(instrument, place)
    if len(places) > 1:

        def everywhere(instrument: Instrument) -> Instrument:
            for place in places:
                instrument = change(instrument, place)
            return instrument

        yield f"{_listed(places)} {what}", everywhere


def _listed(places: tuple[str, ...]) -> str:
    return f"{', '.join(places[:-1])} and {places[-1]}"


def _used(instrument: Instrument, kind: type[Element]) -> tuple[str, ...]:
    """Places of the elements of a class that light meets."""
    used = {*instrument.path, *(f"{arm.name}.{name}" for arm in instrument.arms for name in arm.path)}
    return tuple(place for place in instrument.places(kind) if place in used)


def _element(instrument: Instrument, place: str) -> Element:
    arm, _, name = place.rpartition(".")
    holder = next((one for one in instrument.arms if one.name == arm), None)
    elements = instrument.elements if holder is None else holder.elements
    return next(element for element in elements if element.name == name)


def _layers(instrument: Instrument) -> Iterator[Named]:
    places = tuple(
        place
        for place in _used(instrument, WavePlate)
        if isinstance(plate := _element(instrument, place), WavePlate) and len(plate.layers) > 1
    )
    yield from _each_and_all(
        places,
        "with layers in the other order",
        lambda i, place: i.changed(place, layers=lambda own: own[::-1]),
    )


def _turned_plates(instrument: Instrument) -> Iterator[Named]:
    for place in _used(instrument, WavePlate):
        yield (
            f"{place} turned by 90 deg",
            lambda i, place=place: i.changed(place, axis=lambda axis: axis + 90.0),
        )
        yield (
            f"{place} turned the other way",
            lambda i, place=place: i.changed(place, axis=lambda axis: -axis),
        )


def _turned_wedges(instrument: Instrument) -> Iterator[Named]:
    for turn in TURNS:

        def turned(instrument: Instrument, place: str, turn: float = turn) -> Instrument:
            return instrument.changed(
                place, azimuth=lambda azimuth: jnp.asarray(turn) if azimuth is None else azimuth + turn
            )

        yield from _each_and_all(_used(instrument, Wedge), f"turned by {turn:.0f} deg", turned)


def _beams(instrument: Instrument) -> Iterator[Named]:
    arms = instrument.arms
    yield from _each_and_all(
        tuple(f"{arm.name}.{arm.analyser.name}" for arm in arms if len(arm.analyser.cameras) > 1),
        "with exchanged beams",
        lambda i, place: _with_cameras(i, {place.rpartition(".")[0]: _cameras(i, place)[::-1]}),
    )
    for one, other in itertools.combinations(arms, 2):
        yield (
            f"{one.name} and {other.name} with exchanged cameras",
            lambda i, one=one, other=other: _with_cameras(
                i, {one.name: other.analyser.cameras, other.name: one.analyser.cameras}
            ),
        )


def _cameras(instrument: Instrument, place: str) -> tuple[str, ...]:
    analyser = _element(instrument, place)
    assert isinstance(analyser, Analyser)
    return analyser.cameras


def _with_cameras(instrument: Instrument, names: dict[str, tuple[str, ...]]) -> Instrument:
    """The instrument with other cameras behind the analysers of some arms."""
    for arm, cameras in names.items():
        analyser = next(one for one in instrument.arms if one.name == arm).analyser
        instrument = instrument.changed(f"{arm}.{analyser.name}", cameras=cameras)
    known = instrument.cameras.names
    arms = tuple(tuple(map(known.index, arm.analyser.cameras)) for arm in instrument.arms)
    return dataclasses.replace(instrument, cameras=dataclasses.replace(instrument.cameras, arms=arms))


def _order(instrument: Instrument) -> Iterator[Named]:
    """Neighbours exchanged, behind the polariser and ahead of the analysers."""
    front = next((n for n, e in enumerate(instrument.train(), start=1) if isinstance(e, Polariser)), 0)
    parts: list[tuple[str, tuple[str, ...]]] = [("", instrument.path[front:])]
    parts += [(arm.name, arm.path[:-1]) for arm in instrument.arms]
    for holder, path in parts:
        for first, second in itertools.pairwise(path):
            places = tuple(f"{holder}.{name}" if holder else name for name in (first, second))
            yield (
                f"{places[0]} behind {places[1]}",
                lambda i, holder=holder, first=first, second=second: _exchanged(i, holder, first, second),
            )


def _exchanged(instrument: Instrument, holder: str, first: str, second: str) -> Instrument:
    swapped = {first: second, second: first}
    return _with_path(instrument, holder, lambda path: tuple(swapped.get(name, name) for name in path))


def _with_path(
    instrument: Instrument, holder: str, change: Callable[[tuple[str, ...]], tuple[str, ...]]
) -> Instrument:
    if not holder:
        return dataclasses.replace(instrument, path=change(instrument.path))
    arms: list[Arm] = [
        dataclasses.replace(arm, path=change(arm.path)) if arm.name == holder else arm
        for arm in instrument.arms
    ]
    return dataclasses.replace(instrument, arms=tuple(arms))


def _in_or_out(instrument: Instrument) -> Iterator[Named]:
    for place in _used(instrument, WavePlate):
        plate = _element(instrument, place)
        if isinstance(plate, WavePlate) and plate.moves:
            what = (
                "out where the exposures say so"
                if plate.always_in
                else "in the beam where they say that it is out"
            )
            yield (
                f"{place} {what}",
                lambda i, place=place: i.changed(place, always_in=lambda always: not always),
            )
    paths = [("", instrument.path), *((arm.name, arm.path[:-1]) for arm in instrument.arms)]
    for holder, path in paths:
        for name in path:
            place = f"{holder}.{name}" if holder else name
            element = _element(instrument, place)
            bends = type(element).ray is not Element.ray  # without it everything behind would be elsewhere
            if not isinstance(element, Polariser | Analyser) and not element.moves and not bends:
                yield f"{place} left out", lambda i, holder=holder, name=name: _without(i, holder, name)


def _without(instrument: Instrument, holder: str, left_out: str) -> Instrument:
    return _with_path(instrument, holder, lambda path: tuple(name for name in path if name != left_out))


def _dispersion(instrument: Instrument) -> Iterator[Named]:
    """Every plate of a crystal with another published curve of it."""
    places = _used(instrument, WavePlate)
    for crystal, others in materials.OTHER_CURVES.items():
        family = (crystal, *others)
        for material in family:
            used = {layer.material for place in places for layer in _layers_of(instrument, place)}
            if material in used or not used & set(family):
                continue
            source = others.get(material) or materials.CRYSTALS[material].source.split(",")[0]

            def changed_curve(
                instrument: Instrument, material: str = material, family: tuple[str, ...] = family
            ) -> Instrument:
                for place in places:
                    layers = tuple(
                        dataclasses.replace(layer, material=material) if layer.material in family else layer
                        for layer in _layers_of(instrument, place)
                    )
                    instrument = instrument.changed(place, layers=layers)
                return instrument

            yield f"{crystal} with the dispersion of {source}", changed_curve


def _layers_of(instrument: Instrument, place: str) -> tuple[Layer, ...]:
    plate = _element(instrument, place)
    return plate.layers if isinstance(plate, WavePlate) else ()

"""Other descriptions of an instrument: elements in another order or turned, left out, of another published dispersion.

A change is a sentence and a function of the instrument. The sentences name places as `Instrument.changed` does. The
list holds errors in the description, or in the assembly, of an instrument: none of them has a size. Changes without
effect on the light (of plates that commute) are listed too: the data decide.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp

from walop_jax.model import materials
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.geometry import Wedge
from walop_jax.model.elements.simple import Analyser, Polariser
from walop_jax.model.elements.wave_plate import Layer, WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import check_names

Rearrangement = Callable[[Instrument], Instrument]
NamedChange = tuple[str, Rearrangement]

TURNS = (90.0, 180.0, 270.0)  # degrees
JOINED = "; "


def alternatives(instrument: Instrument) -> dict[str, Rearrangement]:
    """All changes of a description that an instrument has places for, by their sentences."""
    families = (
        _layers,
        _turned_plates,
        _exchanged_plates,
        _turned_wedges,
        _beams,
        _order,
        _in_or_out,
        _dispersion,
    )
    return dict(itertools.chain(*(family(instrument) for family in families)))


def other_curves(instrument: Instrument) -> tuple[str, ...]:
    """Sentences of the changes to another dispersion."""
    return tuple(sentence for sentence, _ in _dispersion(instrument))


def changed(instrument: Instrument, sentence: str) -> Instrument:
    """The instrument with the changes of a sentence, one after the other; unchanged for an empty sentence.

    Raises ValueError, with the nearest sentences, for a change that the instrument has no place for.
    """
    for name in sentence.split(JOINED) if sentence else ():
        available = alternatives(instrument)
        check_names(f"change of {instrument.name}", [name], available)
        instrument = available[name](instrument)
    return instrument


def _each_and_all(
    places: Sequence[str], what: str, change: Callable[[Instrument, str], Instrument]
) -> Iterator[NamedChange]:
    """A change at each of the places, and at all of them together."""
    for place in places:
        yield f"{place} {what}", lambda instrument, place=place: change(instrument, place)
    if len(places) > 1:
        everywhere = f"{', '.join(places[:-1])} and {places[-1]} {what}"
        yield everywhere, lambda instrument: functools.reduce(change, places, instrument)


def _used(instrument: Instrument, kind: type[Element]) -> dict[str, Any]:
    """Elements of a class in the light path, by place."""
    used = {*instrument.path, *(f"{arm.name}.{name}" for arm in instrument.arms for name in arm.path)}
    return {place: instrument.element(place) for place in instrument.places(kind) if place in used}


def _paths(instrument: Instrument) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Name, prefix of places and elements ahead of the analyser, of the common train and of every arm."""
    yield "", "", instrument.path
    yield from ((arm.name, f"{arm.name}.", arm.path[:-1]) for arm in instrument.arms)


def _layers(instrument: Instrument) -> Iterator[NamedChange]:
    yield from _each_and_all(
        [place for place, plate in _used(instrument, WavePlate).items() if len(plate.layers) > 1],
        "with layers in the other order",
        lambda i, place: i.changed(place, layers=lambda layers: layers[::-1]),
    )


def _turned_plates(instrument: Instrument) -> Iterator[NamedChange]:
    turns: tuple[tuple[str, Callable[[Any], Any]], ...] = (
        ("turned by 90 deg", lambda axis: axis + 90.0),
        ("turned the other way", lambda axis: -axis),
    )
    for place, (what, turn) in itertools.product(_used(instrument, WavePlate), turns):
        yield f"{place} {what}", lambda i, place=place, turn=turn: i.changed(place, axis=turn)


def _exchanged_plates(instrument: Instrument) -> Iterator[NamedChange]:
    """The plates of two arms, each in the place of the other: their axes are exchanged, all else is alike by design."""
    used = _used(instrument, WavePlate)
    of_arms = [place for place in used if "." in place]
    for first, second in itertools.combinations(of_arms, 2):
        if first.partition(".")[0] == second.partition(".")[0]:
            continue

        def exchange(i: Instrument, first: str = first, second: str = second) -> Instrument:
            axes = i.element(first).axis, i.element(second).axis  # type: ignore[attr-defined]
            return i.changed(first, axis=axes[1]).changed(second, axis=axes[0])

        yield f"{first} and {second} exchanged", exchange


def _turned_wedges(instrument: Instrument) -> Iterator[NamedChange]:
    for turn in TURNS:
        yield from _each_and_all(
            [*_used(instrument, Wedge)],
            f"turned by {turn:.0f} deg",
            lambda i, place, turn=turn: i.changed(
                place, azimuth=lambda old: jnp.asarray(turn) if old is None else old + turn
            ),
        )


def _beams(instrument: Instrument) -> Iterator[NamedChange]:
    arms = instrument.arms
    yield from _each_and_all(
        [f"{arm.name}.{arm.analyser.name}" for arm in arms if len(arm.analyser.cameras) > 1],
        "with exchanged beams",
        lambda i, place: _with_cameras(i, {place: _used(i, Analyser)[place].cameras[::-1]}),
    )
    for first, second in itertools.combinations(arms, 2):
        places = [f"{arm.name}.{arm.analyser.name}" for arm in (first, second)]
        cameras = dict(zip(places, (second.analyser.cameras, first.analyser.cameras), strict=True))
        what = f"{first.name} and {second.name} with exchanged cameras"
        yield what, lambda i, cameras=cameras: _with_cameras(i, cameras)


def _with_cameras(instrument: Instrument, names: dict[str, tuple[str, ...]]) -> Instrument:
    """The instrument with other cameras behind the analysers at some places."""
    for place, cameras in names.items():
        instrument = instrument.changed(place, cameras=cameras)
    order = instrument.cameras.names
    arms = tuple(tuple(map(order.index, arm.analyser.cameras)) for arm in instrument.arms)
    return dataclasses.replace(instrument, cameras=dataclasses.replace(instrument.cameras, arms=arms))


def _order(instrument: Instrument) -> Iterator[NamedChange]:
    """Neighbours exchanged, behind the polariser and ahead of the analysers."""
    front = next((n for n, e in enumerate(instrument.train(), start=1) if isinstance(e, Polariser)), 0)
    for holder, prefix, path in _paths(instrument):
        for first, second in itertools.pairwise(path if holder else path[front:]):
            swapped = {first: second, second: first}
            yield (
                f"{prefix}{first} behind {prefix}{second}",
                _with_path(holder, lambda way, swapped=swapped: tuple(swapped.get(n, n) for n in way)),
            )


def _with_path(holder: str, path: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Rearrangement:
    return lambda instrument: instrument.changed(holder, path=path)


def _without(holder: str, name: str) -> Rearrangement:
    """Take an element out of an arm, or of the common train: effects that act on it do not apply any longer."""
    return lambda instrument: instrument.changed(
        holder,
        path=lambda way: tuple(n for n in way if n != name),
        elements=lambda elements: tuple(element for element in elements if element.name != name),
    )


def _in_or_out(instrument: Instrument) -> Iterator[NamedChange]:
    for place, plate in _used(instrument, WavePlate).items():
        if plate.moves:
            what = (
                "out where the exposures say so"
                if plate.always_in
                else "in the beam where they say that it is out"
            )
            yield (
                f"{place} {what}",
                lambda i, place=place: i.changed(place, always_in=lambda always: not always),
            )
    for holder, prefix, path in _paths(instrument):
        for name in path:
            element = instrument.element(prefix + name)
            bends = type(element).ray is not Element.ray  # without it all elements behind would be displaced
            if isinstance(element, Polariser | Analyser) or element.moves or bends:
                continue
            yield f"{prefix}{name} left out", _without(holder, name)


def _dispersion(instrument: Instrument) -> Iterator[NamedChange]:
    """All plates of a crystal with another published dispersion."""
    plates = _used(instrument, WavePlate)
    used = {layer.material for plate in plates.values() for layer in plate.layers}
    for crystal, curves in materials.OTHER_CURVES.items():
        family = (crystal, *curves)
        for material in family:
            if material in used or not used & set(family):
                continue
            source = curves.get(material) or materials.CRYSTALS[material].source.split(",")[0]

            def layers(old: tuple[Layer, ...], to: str = material, of: tuple[str, ...] = family) -> Any:
                return tuple(dataclasses.replace(v, material=to) if v.material in of else v for v in old)

            def changed_curve(instrument: Instrument, layers: Callable[[Any], Any] = layers) -> Instrument:
                return functools.reduce(lambda i, place: i.changed(place, layers=layers), plates, instrument)

            yield f"{crystal} with the dispersion of {source}", changed_curve

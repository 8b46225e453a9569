"""Changes of a number of the instrument, or of a source: the amplitude is added to it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.effects.change import (
    BAND,
    KINDS,
    SKY,
    SLOW,
    Change,
    ChangeKind,
    Combinations,
    Grows,
    SlotTerm,
    Term,
    add,
    in_exposures,
    itself,
    place_of_star,
)
from walop_jax.model.effects.factors import EXPOSURE, FIELD, WAVELENGTH
from walop_jax.model.elements.wave_plate import Grown, WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.light_path import NoSuchPlaceError, Scalar
from walop_jax.model.parameters import Component, unknown_name
from walop_jax.model.sources import ExposureArrays, MoonPatches, Standards

OF_QU = ("polarisation q", "polarisation u")
OF_SOURCES = (*OF_QU, "polarisation")
PLACES = {
    "shift": {BAND: ("", "filter_shift")},
    "rotator": {SKY: ("", "rotator_zero"), Standards.name: (Standards.name, "angle")},
    "degree": {Standards.name: (Standards.name, "share")},
}
"""Places of numbers of the instrument as a whole: their part, and its field."""


_FIELD = ("even", "tilt", "r2")


def _with_ray(instrument: Instrument, change: Change) -> Grows:
    """What changes of plates may grow with: quantities of a ray, and the angle of the plate itself."""
    holders = [p for p in instrument.places(WavePlate) if f"{change.place}.".startswith(f"{p}.")]
    moves = instrument.element(holders[0]).moves if holders else None
    tried = (
        Combinations(_FIELD, ("steady", *SLOW)),
        Combinations(along=("step",)),
        Combinations(among=("all",)),
    )
    if change.kind != "axis" or change.place not in holders:
        tried = (Combinations(_FIELD),) if change.kind == "thickness" else (Combinations(),)
    return Grows((FIELD, WAVELENGTH, EXPOSURE), moves or "", tried)


def _number(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    """Add to the number that has the name of the kind: of the polariser, of a wave plate or of one of its layers.

    With factors, the number of a plate grows with the conditions (`wave_plate.Grown`).
    """
    for change, size in terms:
        if not change.factors:
            instrument = instrument.changed(change.place, **{change.kind: add(size)})
            continue
        grown = Grown(size, jnp.zeros(()), change)
        instrument = instrument.changed(change.place, grown=lambda old, new=grown: (*old, new))
    return instrument


def _of_instrument(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    """Add to a number of the instrument as a whole, or of all standards."""
    for change, size in terms:
        places = PLACES[change.kind]
        if change.place not in places:
            raise unknown_name(f"place of {change.kind}", change.place, places)
        holder, field = places[change.place]
        instrument = instrument.changed(holder, **{field: add(size)})
    return instrument


def _patches(change: Change) -> Hashable:
    """The key by which all changes of patches of the sky are patched together."""
    return SKY if change.place == SKY and change.kind != "polarisation" else change


def _polarised(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    """Add to the polarisation of a source.

    For a star: Q or U in the equatorial frame; for the Moon sky: its degree, or q or u in one exposure.
    """
    change, size = terms[0]
    if change.place != SKY:
        return _of_star(instrument, terms)
    if change.kind == "polarisation":
        return instrument.changed("sky", missing=lambda p: -size if p is None else p - size)
    positions = tuple(dict.fromkeys(item.number for item, _ in terms))
    components = {axis: [jnp.zeros(())] * len(positions) for axis in "qu"}
    for item, value in terms:
        at = positions.index(item.number)
        components[item.kind[-1]][at] = components[item.kind[-1]][at] + value
    patches = MoonPatches(jnp.stack(components["q"]), jnp.stack(components["u"]), positions)
    return instrument.changed("sky", patches=lambda old: patches if old is None else old.joined(patches))


def _of_patch(instrument: Instrument, change: Change) -> Grows:
    """Patches of the sky: single exposures; stars: changes with time and from filter to filter."""
    if change.place != SKY:
        return Grows((EXPOSURE, WAVELENGTH), tried=(Combinations(),))
    if change.kind == "polarisation":
        return Grows(tried=(Combinations(),))
    return Grows((EXPOSURE,), None, (Combinations(along=("patch",)),))


def _of_star(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    names = list(map(place_of_star, instrument.standard.names))
    for change, size in terms:
        axis = change.kind.removeprefix("polarisation").strip()
        if change.place not in names or not axis:
            names_of_stars = [f"polarisation q of {name}" for name in names]
            what = unknown_name("description", f"{change.kind} of {change.place}", names_of_stars)
            raise NoSuchPlaceError(str(what))
        at = names.index(change.place)
        if change.factors:
            grown = GrownStandard(size, at, "qu".index(axis), change)
            instrument = instrument.changed("standard", changes=lambda old, grown=grown: (*old, grown))
            continue
        instrument = instrument.changed(
            "standard", **{axis: lambda value, at=at, size=size: value.at[at].add(size)}
        )
    return instrument


class GrownStandard(Component):
    """A change of q (`axis` 0) or u (1) of one value of a standard with time, or from filter to filter."""

    size: Scalar
    value: int = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    change: Change = eqx.field(static=True)

    def factor(self, exposures: ExposureArrays) -> Float[Array, " e"]:
        """The product of its factors in every exposure (e)."""
        return in_exposures(self.change, exposures)


def _slots_of_source(instrument: Instrument, change: Change) -> list[SlotTerm]:
    """Slots of the light: q or u of a star, by the number of the star in the list."""
    names = list(map(place_of_star, instrument.standard.names))
    star = (names.index(change.place),) if change.place in names else ()
    place = instrument.standard.name if star else change.place
    return [SlotTerm(("light", change.kind, change.relation, place, *star), 1.0, change.factors)]


NUMBERS = {"axis": "angle", "cut": "angle", "thickness": "length", "thermal": "number"}
"""Numbers of wave plates and of their layers (µm, deg), with their amplitudes."""
KINDS |= {
    name: ChangeKind(amplitude, _number, grows=_with_ray, slots=itself("number"))
    for name, amplitude in NUMBERS.items()
}
OF_POLARISER = ("extinction", "ellipticity")
KINDS |= {name: ChangeKind("share", _number, slots=itself("light")) for name in OF_POLARISER}
_OF_BAND = "narrow bands beside the broad one"  # filters wider than `light.BROAD` are displaced
_ALONE = Grows(tried=(Combinations(),))
KINDS["shift"] = ChangeKind(
    "wavelength", _of_instrument, test=_OF_BAND, grows=lambda *_: _ALONE, slots=itself("whole")
)
_OF_ROTATOR = "a polariser aligned in the laboratory: an independent zero of the angle"
KINDS["degree"] = ChangeKind(
    "share", _of_instrument, test="standards of another catalogue", slots=itself("light")
)
KINDS["rotator"] = ChangeKind("angle", _of_instrument, test=_OF_ROTATOR, slots=itself("light"))
_OF_SOURCE = "the same patch or star again at another ROTATOR angle"
KINDS |= {
    name: ChangeKind("share", _polarised, _patches, _OF_SOURCE, _of_patch, slots=_slots_of_source)
    for name in OF_SOURCES
}

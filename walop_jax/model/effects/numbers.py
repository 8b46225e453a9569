"""Changes of a number that a part of the instrument has: what is found is added to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from walop_jax.model.effects.change import BAND, SKY, Kind, Term, add
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import unknown_name


class Number(Kind):
    """A number of the element, or of the layer, at the place; it has the name of the kind."""

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Add to the number."""
        for change, size in terms:
            instrument = instrument.changed(change.place, **{change.kind: add(size)})
        return instrument


class Angle(Number):
    """Axis of a wave plate, or of a layer of it; optic axis of a layer out of its surface (deg)."""

    names: ClassVar[tuple[str, ...]] = ("axis", "cut")
    parameter: ClassVar[str] = "angle"


class Thickness(Number):
    """Thickness of a layer of a wave plate (µm)."""

    names: ClassVar[tuple[str, ...]] = ("thickness",)
    parameter: ClassVar[str] = "length"


class Thermal(Number):
    """Thermal change of the birefringence of a wave plate, in units of the published one."""

    names: ClassVar[tuple[str, ...]] = ("thermal",)
    parameter: ClassVar[str] = "number"


class OfPolariser(Number):
    """Extinction ratio of the polariser, and circular polarisation behind it."""

    names: ClassVar[tuple[str, ...]] = ("extinction", "ellipticity")
    parameter: ClassVar[str] = "share"


class OfInstrument(Kind):
    """A number of the instrument as a whole, at the only `place` that it has."""

    place: ClassVar[str]
    field: ClassVar[str]

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Add to the number."""
        for change, size in terms:
            if change.place != cls.place:
                raise unknown_name(f"place of {change.kind}", change.place, (cls.place,))
            instrument = instrument.changed("", **{cls.field: add(size)})
        return instrument


class Shift(OfInstrument):
    """The band displaced (µm): filters wider than `light.BROAD`."""

    names: ClassVar[tuple[str, ...]] = ("shift",)
    parameter: ClassVar[str] = "wavelength"
    test: ClassVar[str] = "narrow bands beside the broad one"
    place: ClassVar[str] = BAND
    field: ClassVar[str] = "filter_shift"


class RotatorZeroPoint(OfInstrument):
    """True ROTATOR minus the header's (deg)."""

    names: ClassVar[tuple[str, ...]] = ("rotator",)
    parameter: ClassVar[str] = "angle"
    test: ClassVar[str] = "a polariser aligned in the laboratory: an independent zero of the angle"
    place: ClassVar[str] = SKY
    field: ClassVar[str] = "rotator_zero"


NUMBERS = (*Angle.names, *Thickness.names, *Thermal.names)
"""Kinds that are numbers of wave plates."""

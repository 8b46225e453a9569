"""Changes of a number that a part of the instrument has: what is found is added to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.change import BAND, SKY, Kind, Term, add
from walop_jax.model.parameters import unknown_name

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument


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


class Shift(Kind):
    """The band displaced (µm): filters wider than `light.BROAD`."""

    names: ClassVar[tuple[str, ...]] = ("shift",)
    parameter: ClassVar[str] = "wavelength"
    test: ClassVar[str] = "narrow bands beside the broad one"

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Displace broad bands."""
        for change, size in terms:
            if change.place != BAND:
                raise unknown_name("place of a shift", change.place, (BAND,))
            instrument = instrument.changed("", filter_shift=add(size))
        return instrument


class Rotator(Kind):
    """True ROTATOR minus the header's (deg)."""

    names: ClassVar[tuple[str, ...]] = ("rotator",)
    parameter: ClassVar[str] = "angle"
    test: ClassVar[str] = "a polariser aligned in the laboratory: an independent zero of the angle"

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Turn the sky against the instrument."""
        for change, size in terms:
            if change.place != SKY:
                raise unknown_name("place of the rotator", change.place, (SKY,))
            instrument = instrument.changed("", rotator_zero=add(size))
        return instrument


NUMBERS = (*Angle.names, *Thickness.names, *Thermal.names)
"""Kinds that are numbers of wave plates."""

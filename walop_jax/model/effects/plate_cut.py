"""Optic axis of a crystal out of its surface: `hwp1_axis_cut`, `hwp2_axis_cut`.

Equation    c = (cos α cos angle, sin α cos angle, sin angle) for one crystal of the plate
Symbols     c optic axis, along the light for 90°; α its azimuth; angle [deg]
Source      to first order the retardance changes by 2π d Δn/(λ n) · 2
            angle · s·c, odd in the field angle: about 0.55° per degree of incidence for 0.1° in a plate of
            36 waves. Cutting errors of large crystals: Harrington 2023, JATIS 9, 038003.
Neutral     angle = 0 (the waves are then those of `plates.stack_jones`; the general solver gives the same)
Revealed by a part of the cross-talk that is odd in the field angle and grows with the number of waves.

The discrete choice `crystal` says which, quartz unless said otherwise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Self

import equinox as eqx

from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Harrington 2023, JATIS 9, 038003"

CRYSTALS = ("quartz", "mgf2")


class PlateCut(Effect):
    """Optic axis of one crystal of the plate `where` tilted out of its surface."""

    angle: Scalar = param(
        unit="deg",
        about="optic axis out of the surface",
        source=SOURCE,
        width=0.1,
        default=0.0,
    )
    crystal: str = eqx.field(static=True, default=CRYSTALS[0])

    where: ClassVar[str]
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures over the field, best in narrow bands"
    separated_by: ClassVar[str] = (
        "narrow bands separate it from the wedge angle (it grows with the waves, the wedge with geometry); "
        "the calibration plate, which has no wedge, and the change of the pattern with field angle do too"
    )

    def __check_init__(self) -> None:
        if self.crystal not in CRYSTALS:
            raise ValueError(f"{self.name}: crystal {self.crystal!r} does not exist, choose quartz or mgf2")

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Either crystal."""
        return tuple((cls(crystal=crystal),) for crystal in CRYSTALS)

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """A cut."""
        del instrument
        return (f"cut of {self.where}.{self.crystal}",)

    def patch(self, instrument: Instrument) -> Instrument:
        """Tilt the optic axis of the crystal."""
        return instrument.changed(
            f"{self.where}.{self.crystal}", cut=lambda cut: self.angle if cut is None else cut + self.angle
        )


class Hwp1AxisCut(PlateCut):
    """Optic axis of one crystal of HWP1 tilted out of its surface."""

    name: ClassVar[str] = "hwp1_axis_cut"
    where: ClassVar[str] = "half1.plate"


class Hwp2AxisCut(PlateCut):
    """Optic axis of one crystal of HWP2 tilted out of its surface."""

    name: ClassVar[str] = "hwp2_axis_cut"
    where: ClassVar[str] = "half2.plate"

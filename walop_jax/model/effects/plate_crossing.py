"""Crystals of a half-wave plate that are not crossed at 90°: `hwp1_crossing`, `hwp2_crossing`.

Equation    optic axis of MgF2 = α + 90° + angle, that of quartz stays at α
Symbols     α fast axis of the plate; angle [deg]
Source      0.1–0.2° of clocking between crystals (Harrington 2023,
            JATIS 9, 038003), which makes 0.35–1.4 % of cross-talk.
Neutral     angle = 0
Revealed by cross-talk that oscillates fast with wavelength (35 waves), and by linear cross-talk of both
            signs over the field in the half concerned: the pair is an elliptical retarder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Harrington 2023, JATIS 9, 038003"


class PlateCrossing(Effect):
    """MgF2 of the plate `where` turned against its quartz."""

    angle: Scalar = param(
        unit="deg", about="added to the axis of MgF2", source=SOURCE, width=0.15, default=0.0
    )

    where: ClassVar[str]
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures in narrow bands, or over the field"
    separated_by: ClassVar[str] = (
        "several narrow bands (it oscillates with wavelength, a turned plate does not) and the calibration "
        "plate"
    )

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """The axis of one crystal."""
        del instrument
        return (f"axis of {self.where}.mgf2",)

    def patch(self, instrument: Instrument) -> Instrument:
        """Turn the MgF2 alone."""
        return instrument.changed(f"{self.where}.mgf2", axis=lambda axis: axis + self.angle)


class Hwp1Crossing(PlateCrossing):
    """Crystals of HWP1 not crossed at 90°."""

    name: ClassVar[str] = "hwp1_crossing"
    where: ClassVar[str] = "half1.plate"


class Hwp2Crossing(PlateCrossing):
    """Crystals of HWP2 not crossed at 90°."""

    name: ClassVar[str] = "hwp2_crossing"
    where: ClassVar[str] = "half2.plate"

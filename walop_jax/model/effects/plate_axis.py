"""Fast axes of the half-wave plates: `chwp_axis`, `hwp1_axis`, `hwp2_axis`.

Equation    α → α + angle for the optic axes of both crystals of the plate
Symbols     α fast axis in the ICS (0° HWP1, 22.5° HWP2, CHWP_ANGLE); angle [deg]
Source      1.8° was found in an instrument in use (NaCo, de Boer et al. 2014),
            0.1° is the repeatability of good mounts.
Neutral     angle = 0
Revealed by an analyser turned by 2 angle, in one half (or behind the calibration plate) only, constant over
            the field to first order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "de Boer et al. 2014, Proc. SPIE 9147, 914787"


class PlateAxis(Effect):
    """Both crystals of the plate `where` turned."""

    angle: Scalar = param(unit="deg", about="added to the fast axis", source=SOURCE, width=0.3, default=0.0)

    where: ClassVar[str]
    reference: ClassVar[str] = SOURCE

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """An axis."""
        del instrument
        return (f"axis of {self.where}",)

    def patch(self, instrument: Instrument) -> Instrument:
        """Turn the plate."""
        return instrument.changed(self.where, axis=lambda axis: axis + self.angle)


class ChwpAxis(PlateAxis):
    """Fast axis of the calibration plate away from its encoder reading."""

    name: ClassVar[str] = "chwp_axis"
    where: ClassVar[str] = "chwp"
    revealed_by: ClassVar[str] = "polariser exposures with the calibration plate in and out"
    separated_by: ClassVar[str] = (
        "the same polariser angles without the plate: only exposures with it are turned"
    )


class Hwp1Axis(PlateAxis):
    """Fast axis of HWP1 turned."""

    name: ClassVar[str] = "hwp1_axis"
    where: ClassVar[str] = "half1.plate"
    revealed_by: ClassVar[str] = "polariser exposures: the q half is turned against the u half"
    separated_by: ClassVar[str] = (
        "a polarised standard (together with the u half) separates it from the zero of the polariser; a "
        "turned Wollaston prism is told apart by the field pattern and by the calibration plate only"
    )


class Hwp2Axis(PlateAxis):
    """Fast axis of HWP2 turned."""

    name: ClassVar[str] = "hwp2_axis"
    where: ClassVar[str] = "half2.plate"
    revealed_by: ClassVar[str] = "polariser exposures: the u half is turned against the q half"
    separated_by: ClassVar[str] = Hwp1Axis.separated_by.replace("u half", "q half")

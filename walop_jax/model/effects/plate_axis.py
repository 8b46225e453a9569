"""Fast axes of the half-wave plates: `chwp_axis`, `hwp1_axis`, `hwp2_axis`.

Equation    α → α + angle for the optic axes of both crystals of the plate
Symbols     α fast axis in the ICS (0° HWP1, 22.5° HWP2, CHWP_ANGLE); angle [deg]
Source      calibration contract, section 6; 1.8° was found in an instrument in use (NaCo, SPIE 9147, 87),
            0.1° is the repeatability of good mounts.
Neutral     angle = 0
Revealed by an analyser turned by 2 angle, in one half (or behind the calibration plate) only, constant over
            the field to first order.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from walop_jax.model.effects.base import CONTRACT, Conditions, Effect, Scalar
from walop_jax.model.parameters import param
from walop_jax.model.plates import Plate


class PlateAxis(Effect):
    """Both crystals of the plate `where` turned."""

    angle: Scalar = param(
        unit="deg", about="added to the fast axis", source=CONTRACT, width=0.3, optical=True, default=0.0
    )

    where: ClassVar[str]

    def plates(self, where: str, plates: tuple[Plate, ...], conditions: Conditions) -> tuple[Plate, ...]:
        """Turn all crystals."""
        if where != self.where:
            return plates
        return tuple(plate._replace(axis=plate.axis + jnp.deg2rad(self.angle)) for plate in plates)


class ChwpAxis(PlateAxis):
    """Fast axis of the calibration plate = CHWP_ANGLE + angle."""

    name: ClassVar[str] = "chwp_axis"
    where: ClassVar[str] = "chwp"
    revealed_by: ClassVar[str] = "polariser exposures with the calibration plate in and out"
    separated_by: ClassVar[str] = (
        "the same polariser angles without the plate: only exposures with it are turned"
    )


class Hwp1Axis(PlateAxis):
    """Fast axis of HWP1 = angle."""

    name: ClassVar[str] = "hwp1_axis"
    where: ClassVar[str] = "half1"
    revealed_by: ClassVar[str] = "polariser exposures: the q half is turned against the u half"
    separated_by: ClassVar[str] = (
        "a polarised standard (together with the u half) separates it from the zero of the polariser; a "
        "turned Wollaston prism is told apart by the field pattern and by the calibration plate only"
    )


class Hwp2Axis(PlateAxis):
    """Fast axis of HWP2 = 22.5° + angle."""

    name: ClassVar[str] = "hwp2_axis"
    where: ClassVar[str] = "half2"
    revealed_by: ClassVar[str] = "polariser exposures: the u half is turned against the q half"
    separated_by: ClassVar[str] = Hwp1Axis.separated_by.replace("u half", "q half")

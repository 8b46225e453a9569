"""Thicknesses of the calibration plate other than those of the base model.

Equation    d → d + mgf2, d + quartz
Symbols     d thickness of the crystal; mgf2, quartz [µm]
Source      calibration contract, section 6; one µm is 6.8° of retardance in MgF2 and 5.3° in quartz at 0.62
            µm.
Neutral     mgf2 = quartz = 0
Revealed by exposures with the calibration plate: cross-talk that exceeds what its prior of 1 µm allows. The
            base model has both thicknesses free, so this is the same quantity without that prior.
"""

from __future__ import annotations

from typing import ClassVar

from walop_jax.model.effects.base import CONTRACT, Conditions, Effect, Scalar
from walop_jax.model.parameters import param
from walop_jax.model.plates import Plate


class ChwpThickness(Effect):
    """Crystals of the calibration plate thicker than as designed."""

    mgf2: Scalar = param(
        unit="um", about="added to the MgF2 plate", source=CONTRACT, width=5.0, optical=True, default=0.0
    )
    quartz: Scalar = param(
        unit="um", about="added to the quartz plate", source=CONTRACT, width=5.0, optical=True, default=0.0
    )

    name: ClassVar[str] = "chwp_thickness"
    revealed_by: ClassVar[str] = "exposures with the calibration plate in, best in several bands"
    separated_by: ClassVar[str] = "narrow bands: thickness goes with 1/λ, an error of its axis does not"

    def plates(self, where: str, plates: tuple[Plate, ...], conditions: Conditions) -> tuple[Plate, ...]:
        """Thicken quartz and MgF2."""
        if where != "chwp":
            return plates
        quartz, mgf2 = plates
        return (
            quartz._replace(thickness=quartz.thickness + self.quartz),
            mgf2._replace(thickness=mgf2.thickness + self.mgf2),
        )

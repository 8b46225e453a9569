"""Thicknesses of the calibration plate other than those of the base model.

Equation    d → d + mgf2, d + quartz
Symbols     d thickness of the crystal; mgf2, quartz [µm]
Source      one µm is 6.8° of retardance in MgF2 and 5.3° in quartz at 0.62
            µm.
Neutral     mgf2 = quartz = 0
Revealed by exposures with the calibration plate: cross-talk that exceeds what its prior of 1 µm allows. The
            base model has both thicknesses free, so this is the same quantity without that prior.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "one um is 6.8 deg of retardance in MgF2 and 5.3 deg in quartz at 0.62 um (Dodge 1984, Ghosh 1999)"


class ChwpThickness(Effect):
    """Crystals of the calibration plate thicker than as designed."""

    mgf2: Scalar = param(unit="um", about="added to the MgF2 plate", source=SOURCE, width=5.0, default=0.0)
    quartz: Scalar = param(
        unit="um", about="added to the quartz plate", source=SOURCE, width=5.0, default=0.0
    )

    name: ClassVar[str] = "chwp_thickness"
    said: ClassVar[tuple[str, ...]] = ("thickness of chwp.mgf2", "thickness of chwp.quartz")
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "exposures with the calibration plate in, best in several bands"
    separated_by: ClassVar[str] = "narrow bands: thickness goes with 1/λ, an error of its axis does not"

    def patch(self, instrument: Instrument) -> Instrument:
        """Thicken quartz and MgF2."""
        quartz = instrument.changed("chwp.quartz", thickness=lambda d: d + self.quartz)
        return quartz.changed("chwp.mgf2", thickness=lambda d: d + self.mgf2)

"""Flexure of the instrument.

Equation    (X, Y) → (X + rate_x · HA, Y + rate_y · HA) ahead of the mapping from field to pupil
Symbols     rate_x, rate_y [deg/h]; HA hour angle [h]
Source      calibration contract, section 6; 0.2 % in half an hour and 1 % between pointings were seen in
            WIRC+Pol (Tinyanont et al. 2019, arXiv:1811.03138; Millar-Blanchaer et al. 2019,
            arXiv:1908.10409).
Neutral     rate_x = rate_y = 0
Revealed by a pattern of cross-talk that moves over the field with hour angle. A missing HA counts as 0.
"""

from __future__ import annotations

from typing import ClassVar

from walop_jax.model.effects.base import CONTRACT, Conditions, Effect, Real, Scalar
from walop_jax.model.parameters import param


class Flexure(Effect):
    """Field coordinates displaced in proportion to the hour angle."""

    rate_x: Scalar = param(
        unit="deg/h", about="displacement along X", source=CONTRACT, width=0.003, optical=True, default=0.0
    )
    rate_y: Scalar = param(
        unit="deg/h", about="displacement along Y", source=CONTRACT, width=0.003, optical=True, default=0.0
    )

    name: ClassVar[str] = "flexure"
    optics_depend_on: ClassVar[tuple[str, ...]] = ("hour_angle",)
    revealed_by: ClassVar[str] = "polariser exposures at different hour angles"
    separated_by: ClassVar[str] = "the same polariser angles at several hour angles and at one temperature"

    def field(self, x: Real, y: Real, conditions: Conditions) -> tuple[Real, Real]:
        """Displace the field point."""
        return x + self.rate_x * conditions.hour_angle, y + self.rate_y * conditions.hour_angle

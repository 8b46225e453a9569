"""Zero point of the polariser's encoder.

Equation    θ = CLP_ANGLE + angle
Symbols     θ transmission axis in the ICS; angle [deg]
Source      calibration contract, section 6; axes of such polarisers are clocked to 0.1° (Harrington et al.
            2021, JATIS 7, 018004).
Neutral     angle = 0
Revealed by standard stars: polariser and sky then disagree on the direction of +q by the same angle
            everywhere.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from walop_jax.model.effects.base import CONTRACT, Effect, ExposureArrays, Real, Scalar
from walop_jax.model.parameters import param


class ClpZero(Effect):
    """Transmission axis = CLP_ANGLE + angle."""

    angle: Scalar = param(
        unit="deg", about="added to the encoder reading", source=CONTRACT, width=0.3, default=0.0
    )

    name: ClassVar[str] = "clp_zero"
    revealed_by: ClassVar[str] = (
        "polariser exposures together with polarised standards (or a trusted sky angle)"
    )
    separated_by: ClassVar[str] = (
        "a polarised standard separates it from rotated plates or analysers (they turn stars as well); "
        "standards and Moon at several ROTATOR angles separate it from the rotator zero"
    )

    def polariser_angle(self, angle: Real, exposures: ExposureArrays) -> Real:
        """Add the zero point."""
        return angle + jnp.deg2rad(self.angle)

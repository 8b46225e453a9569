"""Wollaston prisms turned about the axis.

Equation    analysers ½ (1, ±η cos 2 angle, ±η sin 2 angle, 0)
Symbols     angle of the analysers from +X toward +Y [deg]; η their efficiency
Source      calibration contract, section 6.
Neutral     angle = 0
Revealed by an analysed direction that is turned the same way in both halves.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from walop_jax.model.effects.base import CONTRACT, Effect, Scalar
from walop_jax.model.parameters import param


class WollastonAxis(Effect):
    """Analysers of both halves rotated."""

    angle: Scalar = param(
        unit="deg", about="rotation of the analysers", source=CONTRACT, width=0.3, optical=True, default=0.0
    )

    name: ClassVar[str] = "wollaston_axis"
    revealed_by: ClassVar[str] = "polariser exposures with polarised standards"
    separated_by: ClassVar[str] = (
        "nothing at one field point: only 2 α − angle enters; the field pattern of the plates, whose axes "
        "set its symmetry, and scans of the calibration plate tell it from their axes, polarised standards "
        "from the polariser's zero"
    )

    def analyser_angle(self, angle: Scalar | float) -> Scalar | float:
        """Turn the analysers."""
        return angle + jnp.deg2rad(self.angle)

"""Multiply scattered moonlight.

Equation    (q, u) → (q, u) − p · (q₁, u₁)/|(q₁, u₁)|
Symbols     (q₁, u₁) polarisation of single scattering, whose direction is kept; p what is missing of its
            degree
Source      calibration contract, section 6; light scattered twice splits the zero at the Moon into neutral
            points 10–20° from it (Berry, Dennis & Lee 2004, New J. Phys. 6, 162; Gál et al. 2001, JGR 106,
            22647).
Neutral     p = 0
Revealed by Moon patches at several distances from the Moon: a constant is missing, not a factor.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.effects.base import CONTRACT, Effect, Scalar
from walop_jax.model.parameters import param


class MoonMultipleScattering(Effect):
    """Sky polarisation smaller by p along the direction of single scattering."""

    p: Scalar = param(
        unit="", about="missing degree of polarisation", source=CONTRACT, width=0.01, default=0.0
    )

    name: ClassVar[str] = "moon_multiple_scattering"
    revealed_by: ClassVar[str] = "Moon patches at different distances from the Moon, with polariser exposures"
    separated_by: ClassVar[str] = (
        "patches at 40–90° from the Moon separate it from δ (which is a factor); patches on all sides "
        "separate it from the telescope"
    )

    def moon(self, beam: Float[Array, "e 2"], sky: Float[Array, "e 2"]) -> Float[Array, "e 2"]:
        """Subtract p along the direction of single scattering."""
        power = jnp.sum(sky**2, axis=-1, keepdims=True)
        direction = sky / jnp.sqrt(jnp.where(power > 0, power, 1.0))
        return beam - self.p * direction

"""Stress birefringence of the collimator lenses.

Equation    M = Ret(2π delta (r/0.3°)², φ) · collimator
Symbols     delta retardance in waves at 0.3°, fast axis radial; r, φ polar coordinates of the field point
Source      calibration contract, section 6; stress of mounted lenses grows like the radius squared (Selbing
            2005, arXiv:1010.4142; Patat & Romaniello 2006, PASP 118, 146, for the pattern in a focal
            reducer).
Neutral     delta = 0
Revealed by V picked up in proportion to r², with the pattern of cos 2φ and sin 2φ.

Written with (1 − cos Δ)/Δ² and sin Δ/Δ, both smooth at the centre of the field, Δ(cos 2φ, sin 2φ) being
k (x² − y², 2xy).
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.effects.base import CONTRACT, Effect, Scalar
from walop_jax.model.parameters import param

REFERENCE_RADIUS = 0.3  # degrees


class LensBirefringence(Effect):
    """Retardance of the collimator with a radial fast axis."""

    delta: Scalar = param(unit="wave", about="retardance at 0.3°", source=CONTRACT, width=0.005, default=0.0)

    name: ClassVar[str] = "lens_birefringence"
    revealed_by: ClassVar[str] = "polariser exposures over the field"
    separated_by: ClassVar[str] = (
        "the calibration plate at 45° turns what it makes; its radial pattern about the axis (errors of the "
        "plates have theirs about the wedge normal); narrow bands"
    )

    def upstream(self, mueller: Float[Array, "4 4"], x: Scalar, y: Scalar) -> Float[Array, "4 4"]:
        """Retard what leaves the collimator."""
        k = 2.0 * jnp.pi * self.delta / REFERENCE_RADIUS**2
        a, b, total = k * (x**2 - y**2), k * 2.0 * x * y, k * (x**2 + y**2)
        sine = jnp.sinc(total / jnp.pi)  # sin Δ / Δ
        bend = 0.5 * jnp.sinc(0.5 * total / jnp.pi) ** 2  # (1 − cos Δ) / Δ²
        one, zero = jnp.ones_like(total), jnp.zeros_like(total)
        rows = (
            (one, zero, zero, zero),
            (zero, one - bend * b**2, bend * a * b, -sine * b),
            (zero, bend * a * b, one - bend * a**2, sine * a),
            (zero, sine * b, -sine * a, jnp.cos(total)),
        )
        return jnp.stack([jnp.stack(row) for row in rows]) @ mueller

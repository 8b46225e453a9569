"""Lenses that polarise weakly: diattenuation and retardance growing with the square of the field radius.

Equation    diattenuation (q, u) = c r² (cos 2φ, sin 2φ) + (c_q, c_u)
            retardance Δ = 2π (delta + slope u + bend u²) (r/0.3°)², fast axis radial, u = λ − 0.62 µm (coatings)
Symbols     r, φ polar coordinates of the field point [deg]; c [deg⁻²]; delta in waves at 0.3°
Source      Fresnel transmission of curved surfaces and stress of mounted lenses, both ∝ r²: Paper II of WALOP-South
            (Maharana et al. 2022); Selbing 2010, arXiv:1010.4142; Patat & Romaniello 2006, PASP 118, 146.
Limits      nothing on the axis but (c_q, c_u). Written with (1 − cos Δ)/Δ² and sin Δ/Δ, both smooth at the centre of
            the field, Δ(cos 2φ, sin 2φ) being k (x² − y², 2xy).
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.conventions import FIELD_SCALE, REFERENCE_WAVELENGTH
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.parameters import number
from walop_jax.model.ray import Ray

Scalar = Float[Array, ""]
PAPER_II = "Maharana et al. 2022, Paper II"


class Collimator(Element):
    """Weak linear diattenuation: a radial part and a constant one."""

    diattenuation: Scalar = number(unit="deg-2", about="c, radial diattenuation of curved lenses")
    q: Scalar = number(unit="", about="c_q, constant part")
    u: Scalar = number(unit="", about="c_u, constant part")

    kind: ClassVar[str] = "collimator"
    reference: ClassVar[str] = PAPER_II

    def mueller(self, ray: Ray) -> Mueller:
        """A non-depolarising diattenuator."""
        q = self.diattenuation * (ray.x**2 - ray.y**2) + self.q
        u = self.diattenuation * 2.0 * ray.x * ray.y + self.u
        return mueller.diattenuator(q, u)


class RadialRetarder(Element):
    """Retardance with a radial fast axis, growing with the square of the field radius."""

    delta: Scalar = number(unit="wave", about="retardance at 0.3° (and 0.62 µm)")
    slope: Scalar | None = number(unit="wave/um", about="change of it with wavelength", default=None)
    bend: Scalar | None = number(unit="wave/um2", about="the same, per square of λ − 0.62 µm", default=None)

    kind: ClassVar[str] = "radial_retarder"
    reference: ClassVar[str] = "Selbing 2010, arXiv:1010.4142; Patat & Romaniello 2006, PASP 118, 146"

    def mueller(self, ray: Ray) -> Mueller:
        """A linear retarder, smooth at the centre of the field."""
        x, y, delta = ray.x, ray.y, self.delta
        if self.slope is not None:
            delta = delta + self.slope * (ray.wavelength - REFERENCE_WAVELENGTH)
        if self.bend is not None:
            delta = delta + self.bend * (ray.wavelength - REFERENCE_WAVELENGTH) ** 2
        k = 2.0 * jnp.pi * delta / FIELD_SCALE**2
        return mueller.general_retarder(k * (x**2 - y**2), k * 2.0 * x * y, jnp.zeros_like(k * x))

"""Metal mirrors: Fresnel's equations of a thick layer with a complex index of refraction.

Equation    r_s = (cos θ − w)/(cos θ + w),  r_p = (N² cos θ − w)/(N² cos θ + w),  w = √(N² − sin² θ),  N = n + ik
            M of the Jones matrix diag(r_p, r_s), p along `axis`, over ½ (|r_p|² + |r_s|²)
Symbols     θ angle of incidence; n, k index of refraction and extinction coefficient, natural cubic splines through
            their values at `n_at` and `k_at`; p in the plane of incidence, s normal to it
Source      Born & Wolf 1999, § 14.2, for fields that go as exp(i(kz − ωt)), k > 0 then absorbs; as an element of a
            telescope: van Harten, Snik & Keller 2009, PASP 121, 377
Limits      θ = 0: diag(1, 1, −1, −1), the frame of the reflected beam being (p, s, k) as that of the beam that arrives;
            k = 0 and tan θ = n (Brewster): light polarised along s alone; k → ∞: no diattenuation.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from walop_jax.model import mueller
from walop_jax.model.elements.base import Mueller
from walop_jax.model.elements.spectral import Curve, Scalar, WithCurves
from walop_jax.model.parameters import number
from walop_jax.model.ray import Ray


class Mirror(WithCurves):
    """A flat metal mirror; reflectance is part of the throughput."""

    n: Curve | None = number(unit="", about="index of refraction at `n_at`", default=None, several=True)
    k: Curve | None = number(unit="", about="extinction coefficient at `k_at`", default=None, several=True)
    incidence: Scalar = number(unit="deg", about="angle of incidence", default=45.0)
    axis: Scalar = number(unit="deg", about="plane of incidence, from +X toward +Y")
    n_at: tuple[float, ...] = eqx.field(static=True, default=())
    k_at: tuple[float, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "mirror"
    reference: ClassVar[str] = "Born & Wolf 1999, Principles of Optics, 14.2"

    def __check_init__(self) -> None:
        if (self.n is None) != (self.k is None):
            raise ValueError(f"{'n' if self.n is None else 'k'} is missing: a metal has both")

    def mueller(self, ray: Ray) -> Mueller | None:
        """The mirror at every wavelength, of unit mean reflectance; no metal: nothing."""
        if self.n is None or self.k is None:
            return None
        index = self.curve("n", ray.wavelength) + 1j * self.curve("k", ray.wavelength)
        cos, sin = jnp.cos(jnp.deg2rad(self.incidence)), jnp.sin(jnp.deg2rad(self.incidence))
        inside = jnp.sqrt(index**2 - sin**2)
        s = (cos - inside) / (cos + inside)
        p = (index**2 * cos - inside) / (index**2 * cos + inside)
        nothing = jnp.zeros_like(p)
        own = mueller.from_jones(mueller.Matrix2(p, nothing, nothing, s))
        axis = jnp.deg2rad(self.axis)
        return mueller.rotation(-axis) @ (own / own[..., :1, :1]) @ mueller.rotation(axis)

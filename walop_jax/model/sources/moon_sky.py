"""The sky lit by the full Moon.

Equation    (q, u) = δ (q₁, u₁) − p (q₁, u₁)/|(q₁, u₁)| + (q_e, u_e), (q₁, u₁) single Rayleigh scattering:
            p₁ = sin²γ / (1 + cos²γ), perpendicular to the scattering plane
Symbols     γ angle from the Moon; δ depolarisation, one for all patches and wavelengths; p degree that multiple
            scattering takes away; q_e, u_e what a patch has beyond it
Source      Maharana et al. 2022, Paper II, eq. 8; multiple scattering: Berry, Dennis & Lee 2004, New J. Phys. 6, 162.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from walop_jax.model.parameters import Component, number, param
from walop_jax.model.sources.base import Scalar, Sight, Source

PAPER_II = "Maharana et al. 2022, Paper II"


class Patches(Component):
    """What single Moon exposures, at some positions of the list, have beyond single scattering."""

    q: Float[Array, " m"]
    u: Float[Array, " m"]
    positions: tuple[int, ...] = eqx.field(static=True, default=())

    def joined(self, other: Patches) -> Patches:
        """These and others; what both have adds up."""
        q, u = jnp.concatenate([self.q, other.q]), jnp.concatenate([self.u, other.u])
        return Patches(q, u, (*self.positions, *other.positions))


class MoonSky(Source):
    """Singly scattered moonlight, depolarised."""

    depolarisation: Scalar = param(
        unit="",
        about="δ, one for all patches and wavelengths",
        source=f"{PAPER_II}, eq. 8",
        scale=0.05,
        default=0.8,
    )
    missing: Scalar | None = number(unit="", about="degree taken away by multiple scattering", default=None)
    patches: Patches | None = None

    name: ClassVar[str] = "sky"
    kind: ClassVar[str] = "moon"
    reference: ClassVar[str] = f"{PAPER_II}, eq. 8"

    def shines(self, sight: Sight) -> Bool[Array, " e"]:
        """Moon exposures that are not taken through the polariser."""
        return super().shines(sight) & ~sight.exposures.clp_in

    def polarisation(self, sight: Sight) -> Float[Array, "e 2"]:
        """That of the patch."""
        sky = sight.sky
        qu = self.depolarisation * sky
        if self.missing is not None:
            power = jnp.sum(sky**2, axis=-1, keepdims=True)
            qu = qu - self.missing * sky / jnp.sqrt(jnp.where(power > 0, power, 1.0))
        if self.patches is not None:
            extra = jnp.stack([self.patches.q, self.patches.u], axis=-1)
            qu = qu.at[np.asarray(self.patches.positions, int)].add(extra)
        return qu

"""Standard stars: catalogue Stokes parameters in the equatorial frame, with their errors as priors.

Equation    (q + iu) in the instrument frame = (Q + iU) exp(−2i ROTATOR)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from walop_jax.model.parameters import param
from walop_jax.model.sources.base import Sight, Source, turned


class Standards(Source):
    """Catalogue Stokes parameters of the standard stars."""

    names: tuple[str, ...] = eqx.field(static=True)
    q: Float[Array, " s"] = param(unit="", about="catalogue q", source="SOURCES table", scale=2e-4)
    u: Float[Array, " s"] = param(unit="", about="catalogue u", source="SOURCES table", scale=2e-4)

    name: ClassVar[str] = "standard"
    kind: ClassVar[str] = "standard"

    def labels(self, field: str) -> Sequence[str]:
        """One name per star."""
        return tuple(f"{name}.{field}" for name in self.names)

    def shines(self, sight: Sight) -> Bool[Array, " e"]:
        """Whatever has a star as its source."""
        seen = sight.source >= 0
        return seen if self.names else jnp.zeros_like(seen)

    def polarisation(self, sight: Sight) -> Float[Array, "e 2"]:
        """That of the star of each exposure."""
        if not self.names:
            return super().polarisation(sight)
        row = jnp.where(sight.source >= 0, sight.source, 0)
        return turned(jnp.stack([self.q[row], self.u[row]], axis=-1), sight.exposures.rotator)

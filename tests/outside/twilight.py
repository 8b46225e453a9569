"""A KIND of exposures that does not come with the package: the sky at dusk, polarised along +X."""

from typing import ClassVar

import jax
import jax.numpy as jnp

from walop_jax.model.parameters import param
from walop_jax.model.sources import Source


class Twilight(Source):
    """One degree of polarisation, along +X of the instrument."""

    degree: jax.Array = param(
        unit="", about="degree of polarisation", source="a test", scale=0.01, default=0.5
    )
    name: ClassVar[str] = "twilight"
    kind: ClassVar[str] = "twilight"

    def polarisation(self, illumination):
        """(degree, 0) in every exposure."""
        nothing = jnp.zeros_like(illumination.exposures.clp_angle)
        return jnp.stack([self.degree + nothing, nothing], axis=-1)

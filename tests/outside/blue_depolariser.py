"""A kind of element that does not come with the package: depolarisation that goes as λ⁻⁴."""

from typing import ClassVar

import jax
import jax.numpy as jnp

from walop_jax.model.elements.base import Element
from walop_jax.model.parameters import number


class BlueDepolariser(Element):
    """A share of the linear polarisation is lost, more in the blue."""

    loss: jax.Array = number(unit="", about="share lost at 0.62 um")
    kind: ClassVar[str] = "blue_depolariser"

    def mueller(self, ray):
        """Diagonal, at every wavelength."""
        kept = 1.0 - self.loss * (0.62 / ray.wavelength) ** 4
        one = jnp.ones_like(kept)
        return jax.vmap(jnp.diag)(jnp.stack([one, kept, kept, one], axis=-1))

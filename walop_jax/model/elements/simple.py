"""Elements that are one Mueller matrix: retarder, rotator, diattenuator, depolariser, polarisation of a telescope.

Sources     retarder: Paper II of WALOP-South, appendix B; diattenuator: Lu & Chipman 1996, JOSA A 13, 1106, eq. 18;
            depolariser: ibid., eq. 32, diagonal.
Limits      all are the identity at their neutral numbers.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.parameters import number
from walop_jax.model.ray import Ray

Scalar = Float[Array, ""]


class Retarder(Element):
    """A linear retarder, the same over the field, with a retardance that may go as 1/λ."""

    delta: Scalar = number(unit="rad", about="retardance")
    axis: Scalar = number(unit="deg", about="fast axis, from +X toward +Y")
    wavelength: Scalar | None = number(
        unit="um", about="wavelength of that retardance, which goes as 1/λ; none: achromatic", default=None
    )

    kind: ClassVar[str] = "retarder"
    reference: ClassVar[str] = "Maharana et al. 2022, Paper II, appendix B"

    def mueller(self, ray: Ray) -> Mueller:
        """The retarder."""
        delta = self.delta if self.wavelength is None else self.delta * self.wavelength / ray.wavelength
        return mueller.retarder(delta, jnp.deg2rad(self.axis))


class Rotator(Element):
    """Stokes parameters referred to turned axes: by a constant, and more for oblique rays.

    Equation: angle + skew · k_x k_y (rad), from +X toward +Y, k the direction in air. Ahead of an analyser it turns the
    analyser: beams of a crystal prism are polarised along n × k for an optic axis n. To second order that is skew
    = 1/(2 N²) for an optic axis along Y and −1/(2 N²) along X, in a medium of index N.
    """

    angle: Scalar = number(unit="deg", about="rotation, from +X toward +Y")
    skew: Scalar = number(unit="", about="rotation (rad) of oblique rays, per unit of k_x k_y")

    kind: ClassVar[str] = "rotator"
    reference: ClassVar[str] = "Chipman, Lam & Young 2018, Polarized Light and Optical Systems, ch. 17"

    def mueller(self, ray: Ray) -> Mueller:
        """The rotation."""
        return mueller.rotation(jnp.deg2rad(self.angle) + self.skew * ray.kx * ray.ky)


class Diattenuator(Element):
    """A linear diattenuator, the same over the field."""

    q: Scalar = number(unit="", about="diattenuation along +X")
    u: Scalar = number(unit="", about="diattenuation along +45°")
    axis: Scalar = number(unit="deg", about="angle by which its axes are turned, from +X toward +Y")

    kind: ClassVar[str] = "diattenuator"
    reference: ClassVar[str] = "Lu & Chipman 1996, JOSA A 13, 1106"

    def mueller(self, ray: Ray) -> Mueller:
        """The diattenuator."""
        del ray
        twice = 2.0 * jnp.deg2rad(self.axis)
        cos, sin = jnp.cos(twice), jnp.sin(twice)
        return mueller.diattenuator(self.q * cos - self.u * sin, self.q * sin + self.u * cos)


class Depolariser(Element):
    """Depolarisation: a share of the polarisation is lost, of the linear and of the circular part."""

    linear: Scalar = number(unit="", about="share of q and u that is lost")
    circular: Scalar = number(unit="", about="share of v that is lost")

    kind: ClassVar[str] = "depolariser"
    reference: ClassVar[str] = "Lu & Chipman 1996, JOSA A 13, 1106"

    def mueller(self, ray: Ray) -> Mueller:
        """The depolariser."""
        del ray
        kept = 1.0 - self.linear
        return jnp.diag(jnp.stack([jnp.ones_like(kept), kept, kept, 1.0 - self.circular]))


class AddedPolarisation(Element):
    """(0, q, u, 0) per unit of light is added: what mirrors of a telescope do to weakly polarised light."""

    q: Scalar = number(unit="", about="polarisation added along +X")
    u: Scalar = number(unit="", about="polarisation added along +45°")

    kind: ClassVar[str] = "added_polarisation"
    reference: ClassVar[str] = "Patat & Taubenberger 2011, A&A 529, A57"

    def mueller(self, ray: Ray) -> Mueller:
        """[[1, 0], [(q, u, 0)ᵀ, 1]]: not a physical Mueller matrix beyond first order in q and u."""
        del ray
        return jnp.eye(4).at[1, 0].add(self.q).at[2, 0].add(self.u)

"""An element whose polarisation is a curve over wavelength: mirrors, derotators, coatings, what has no closed form.

Equation    M = depolariser(loss) · [diattenuator(D) retarder(δ), both along `axis`]; they commute
            each of δ(λ), D(λ), loss(λ) is the natural cubic spline through its values at its own wavelengths, continued
            as a straight line beyond the first and the last; one value: constant
Symbols     δ retardance [rad], of the fast axis; D diattenuation along `axis`; loss share of q, u, v that is lost
Sources     mirrors as diattenuating retarders: van Harten, Snik & Keller 2009, PASP 121, 377; form of M: Lu & Chipman
            1996, JOSA A 13, 1106; spline: de Boor 1978, A Practical Guide to Splines, ch. IV.
Limits      no values: the identity. A spline with as many knots as bands takes up anything that has no
            curvature within a band; with fewer it is a smooth curve.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.parameters import number
from walop_jax.model.ray import Ray

Scalar = Float[Array, ""]
Curve = Float[Array, " k"]
CURVES = ("delta", "diattenuation", "loss")


class SpectralElement(Element):
    """A retarder, diattenuator and depolariser on one axis, each a smooth curve over wavelength."""

    delta: Curve | None = number(unit="rad", about="retardance at `delta_at`", default=None, several=True)
    diattenuation: Curve | None = number(
        unit="", about="diattenuation along the axis at `diattenuation_at`", default=None, several=True
    )
    loss: Curve | None = number(
        unit="", about="share of the polarisation lost at `loss_at`", default=None, several=True
    )
    axis: Scalar = number(unit="deg", about="fast axis, from +X toward +Y")
    delta_at: tuple[float, ...] = eqx.field(static=True, default=())
    diattenuation_at: tuple[float, ...] = eqx.field(static=True, default=())
    loss_at: tuple[float, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "spectral"
    reference: ClassVar[str] = "van Harten, Snik & Keller 2009, PASP 121, 377"

    def __check_init__(self) -> None:
        for name in CURVES:
            values, knots = getattr(self, name), getattr(self, f"{name}_at")
            if (values is None) != (len(knots) == 0):
                missing = name if values is None else f"{name}_at"
                raise ValueError(f"{missing} is missing: {name} and {name}_at (um) belong together")
            if any(b <= a for a, b in itertools.pairwise(knots)):
                raise ValueError(f"{name}_at must be wavelengths (um) that increase")
            if values is not None and jnp.ndim(values) == 1 and len(values) != len(knots):
                raise ValueError(f"{name} has {len(values)} values for {len(knots)} wavelengths in {name}_at")

    def labels(self, field: str) -> Sequence[str]:
        """Values of a curve are numbered from 1, by wavelength."""
        if field not in CURVES:
            return (field,)
        return tuple(f"{field}{i + 1}" for i in range(len(getattr(self, f"{field}_at"))))

    def curve(self, name: str, wavelength: Float[Array, " n"]) -> Float[Array, " n"]:
        """One of the curves at wavelengths (µm), 0 where there is none."""
        values = getattr(self, name)
        return (
            jnp.zeros_like(wavelength)
            if values is None
            else spline(getattr(self, f"{name}_at"), values, wavelength)
        )

    def mueller(self, ray: Ray) -> Mueller | None:
        """The element at every wavelength."""
        matrix, axis = None, jnp.deg2rad(self.axis)
        if self.delta is not None:
            matrix = mueller.retarder(self.curve("delta", ray.wavelength), axis)
        if self.diattenuation is not None:
            d = self.curve("diattenuation", ray.wavelength)
            own = mueller.diattenuator(d * jnp.cos(2.0 * axis), d * jnp.sin(2.0 * axis))
            matrix = own if matrix is None else own @ matrix
        if self.loss is not None:
            kept = 1.0 - self.curve("loss", ray.wavelength)
            own = jnp.stack([jnp.ones_like(kept), kept, kept, kept], axis=-1)[:, :, None] * jnp.eye(4)
            matrix = own if matrix is None else own @ matrix
        return matrix


def spline(knots: Sequence[float], values: Curve, at: Float[Array, " n"]) -> Float[Array, " n"]:
    """Natural cubic spline through `values` at `knots`, continued as straight lines."""
    x = np.asarray(knots, float)
    if len(x) == 1:
        return jnp.broadcast_to(values[0], jnp.shape(at))
    h = np.diff(x)
    bends = jnp.asarray(_bends(x)) @ values  # second derivatives at the knots
    piece = jnp.clip(jnp.searchsorted(jnp.asarray(x), at) - 1, 0, len(h) - 1)
    low, step = jnp.asarray(x)[piece], jnp.asarray(h)[piece]
    inside = jnp.clip(at, x[0], x[-1])
    b = (inside - low) / step
    a = 1.0 - b
    first, second = values[piece], values[piece + 1]
    curved = ((a**3 - a) * bends[piece] + (b**3 - b) * bends[piece + 1]) * step**2 / 6.0
    steep = (second - first) / step + (
        (3.0 * b**2 - 1.0) * bends[piece + 1] - (3.0 * a**2 - 1.0) * bends[piece]
    ) * step / 6.0
    return a * first + b * second + curved + steep * (at - inside)


def _bends(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
    """Matrix that gives the second derivatives at the knots from the values: de Boor's tridiagonal system."""
    n, h = len(x), np.diff(x)
    left, right = np.eye(n), np.zeros((n, n))
    for i in range(1, n - 1):
        left[i, i - 1 : i + 2] = h[i - 1] / 6.0, (h[i - 1] + h[i]) / 3.0, h[i] / 6.0
        right[i, i - 1 : i + 2] = 1.0 / h[i - 1], -1.0 / h[i - 1] - 1.0 / h[i], 1.0 / h[i]
    return np.linalg.solve(left, right)

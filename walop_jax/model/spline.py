"""Smooth curves over wavelength: natural cubic splines through a few values (de Boor 1978, ch. IV)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Curve = Float[Array, " k"]


def check_curve(name: str, values: Curve | None, knots: Sequence[float]) -> None:
    """Raise ValueError for values and wavelengths (`name`_at) that do not belong together."""
    if (values is None) != (len(knots) == 0):
        missing = name if values is None else f"{name}_at"
        raise ValueError(f"{missing} is missing: {name} and {name}_at (um) belong together")
    if any(b <= a for a, b in itertools.pairwise(knots)):
        raise ValueError(f"{name}_at must be wavelengths (um) that increase")
    if values is not None and jnp.ndim(values) == 1 and len(values) != len(knots):
        raise ValueError(f"{name} has {len(values)} values for {len(knots)} wavelengths in {name}_at")


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

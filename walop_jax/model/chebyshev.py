"""Chebyshev polynomials and the nodes at which a function is sampled for a series in them.

Nodes       t_j = cos(π (j + ½)/n), j = 0 … n − 1, in each direction, stretched over the rectangle.
Series      f(t) ≈ Σ_k c_k T_k(t), c_k = (2 − δ_k0)/n · Σ_j T_k(t_j) f(t_j): the polynomial of degree n − 1
            through the nodes.
Source      Trefethen 2013, Approximation Theory and Approximation Practice, chapters 2–4 and 8: for a function that
            is analytic in a neighbourhood of the rectangle the error falls geometrically with n.

Arrays of numpy give arrays of numpy, arrays of JAX give arrays of JAX.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Rectangle(NamedTuple):
    """Part of the field, by its corners (deg); no side may have length 0."""

    low: Float[np.ndarray | Array, 2]
    high: Float[np.ndarray | Array, 2]


def nodes(count: int) -> Float[np.ndarray, " n"]:
    """Chebyshev nodes of the first kind in (−1, 1)."""
    return np.cos(np.pi * (np.arange(count) + 0.5) / count)


def grid(rectangle: Rectangle, count: int) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Positions of count × count nodes; y runs fastest."""
    middle = 0.5 * (np.asarray(rectangle.low) + np.asarray(rectangle.high))
    half = 0.5 * (np.asarray(rectangle.high) - np.asarray(rectangle.low))
    x, y = (middle[i] + half[i] * nodes(count) for i in (0, 1))
    return np.repeat(x, count), np.tile(y, count)


def to_coefficients(count: int) -> Float[np.ndarray, "n n"]:
    """The matrix from values at `nodes` to coefficients."""
    k, j = np.arange(count)[:, None], np.arange(count)[None]
    return np.where(k > 0, 2.0, 1.0) / count * np.cos(np.pi * k * (j + 0.5) / count)


def polynomials(t: Float[Any, "*p"], count: int) -> Float[Any, "*p n"]:
    """T_0 … T_{count − 1} at t in [−1, 1]."""
    xp = jnp if isinstance(t, jax.Array) else np
    values = [xp.ones_like(t), t]
    for _ in range(2, count):
        values.append(2.0 * t * values[-1] - values[-2])
    return xp.stack(values[:count], axis=-1)


def scaled(
    x: Float[Any, "*p"], y: Float[Any, "*p"], rectangle: Rectangle
) -> tuple[Float[Any, "*p"], Float[Any, "*p"]]:
    """Field positions (deg) in units that run from −1 to 1 over the rectangle."""
    low, high = rectangle
    tx, ty = ((2.0 * value - low[i] - high[i]) / (high[i] - low[i]) for i, value in enumerate((x, y)))
    return tx, ty

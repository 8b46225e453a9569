"""Interpolation between Chebyshev nodes over a rectangle of the field.

Nodes       t_j = cos(π (j + ½)/n), j = 0 … n − 1, in each direction, stretched over the rectangle.
Weights     f(t) ≈ Σ_j w_j(t) f(t_j), w_j(t) = Σ_k (2 − δ_k0)/n · T_k(t_j) T_k(t): the polynomial of degree n − 1
            through the nodes. In two dimensions the product of the weights.
Source      Trefethen 2013, Approximation Theory and Approximation Practice, chapters 2–4 and 8: for a function that
            is analytic in a neighbourhood of the rectangle the error falls geometrically with n.
"""

from __future__ import annotations

from typing import NamedTuple

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


def _one_dimension(t: Float[Array, "*p"], count: int) -> Float[Array, "*p n"]:
    values = [jnp.ones_like(t), t]
    for _ in range(2, count):
        values.append(2.0 * t * values[-1] - values[-2])
    k, j = np.arange(count)[:, None], np.arange(count)[None]
    to_nodes = np.where(k > 0, 2.0, 1.0) / count * np.cos(np.pi * k * (j + 0.5) / count)
    return jnp.stack(values[:count], axis=-1) @ to_nodes


def weights(
    x: Float[Array, "*p"], y: Float[Array, "*p"], rectangle: Rectangle, count: int
) -> Float[Array, "*p t"]:
    """Weights of the nodes of `grid` at field positions (deg) in the rectangle."""
    low, high = jnp.asarray(rectangle.low), jnp.asarray(rectangle.high)
    wx, wy = (
        _one_dimension((2.0 * value - low[i] - high[i]) / (high[i] - low[i]), count)
        for i, value in enumerate((x, y))
    )
    return (wx[..., :, None] * wy[..., None, :]).reshape(*wx.shape[:-1], count * count)

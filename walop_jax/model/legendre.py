"""Polynomials over the field: products of Legendre polynomials up to a total degree.

Equation    f(x, y) = Σ_{i+j ≤ n} c_ij P_i(x/h) P_j(y/h), h the scale of the field, 0.3° for WALOP.
Recursion   (k+1) P_{k+1} = (2k+1) t P_k − k P_{k−1}.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model.conventions import FIELD_SCALE

SOURCE = "Abramowitz & Stegun 1964, 22.7.10"


def terms(degree: int) -> tuple[tuple[int, int], ...]:
    """Exponents (i, j) in order of total degree."""
    return tuple((n - j, j) for n in range(degree + 1) for j in range(n + 1))


def _one_dimension(t: Float[Any, ...], degree: int) -> list[Float[Any, ...]]:
    values = [t * 0.0 + 1.0, t]
    for k in range(1, degree):
        values.append(((2 * k + 1) * t * values[k] - k * values[k - 1]) / (k + 1))
    return values


def polynomial(degree: int, t: Float[Array, ...]) -> Float[Array, ...]:
    """The polynomial of one degree."""
    return _one_dimension(t, degree)[degree]


def basis(
    x: Float[Any, ...], y: Float[Any, ...], degree: int, scale: float = FIELD_SCALE
) -> Float[Any, "... t"]:
    """Values of all terms at field positions in degrees; arrays of numpy stay so."""
    xp = jnp if isinstance(x, jax.Array) else np
    px, py = (xp.stack(_one_dimension(t / scale, degree)[: degree + 1], axis=-1) for t in (x, y))
    i, j = np.array(terms(degree)).T
    return px[..., i] * py[..., j]

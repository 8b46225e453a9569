"""Polynomials over the field: products of Legendre polynomials up to a total degree.

Equation    f(x, y) = Σ_{i+j ≤ n} c_ij P_i(x/h) P_j(y/h), h the scale of the field, 0.3° for WALOP.
Recursion   (k+1) P_{k+1} = (2k+1) t P_k − k P_{k−1}.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.model.conventions import FIELD_SCALE

SOURCE = "Abramowitz & Stegun 1964, 22.7.10"


def terms(degree: int) -> tuple[tuple[int, int], ...]:
    """Exponents (i, j) in order of total degree."""
    return tuple((n - j, j) for n in range(degree + 1) for j in range(n + 1))


def polynomials(t: Float[Any, ...], degree: int) -> list[Float[Any, ...]]:
    """The polynomials of all degrees up to one."""
    values = [t * 0.0 + 1.0, t]
    for k in range(1, degree):
        values.append(((2 * k + 1) * t * values[k] - k * values[k - 1]) / (k + 1))
    return values


def polynomial(degree: int, t: Float[Any, ...]) -> Float[Any, ...]:
    """The polynomial of one degree by Horner's rule in t², which takes fewer operations than the recursion."""
    *lower, highest = np.polynomial.legendre.leg2poly(np.eye(degree + 1)[degree])[degree % 2 :: 2]
    value = t * 0.0 + highest
    for coefficient in reversed(lower):
        value = value * t**2 + coefficient
    return value * t if degree % 2 else value


def basis(
    x: Float[Any, ...], y: Float[Any, ...], degree: int, scale: float = FIELD_SCALE
) -> Float[Any, "... t"]:
    """Values of all terms at field positions in degrees; arrays of numpy stay so."""
    xp = jnp if isinstance(x, jax.Array) else np
    px, py = (xp.stack(polynomials(t / scale, degree)[: degree + 1], axis=-1) for t in (x, y))
    i, j = np.array(terms(degree)).T
    return px[..., i] * py[..., j]

"""Mueller and Jones algebra: plain functions, one equation each.

Stokes vectors are (S0, S1, S2, S3) in the convention of `conventions.py`. A Jones matrix has its two axes ahead of all
others, and products of long arrays are fastest when written out.
"""

from __future__ import annotations

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

Real = Float[Array, "..."]
Matrix2 = Inexact[Array, "2 2 ..."]

computed_once = jax.lax.optimization_barrier
"""Marks values that XLA is to compute once. By itself XLA repeats a cheap computation in every loop that uses its
result; cheap results made of cheap results then grow to loops of a thousand operations, which are compiled as often as
a matrix has elements."""


def matrix2(*elements: Inexact[Array, ...]) -> Matrix2:
    """The 2 × 2 matrix ((a, b), (c, d)) of arrays a, b, c, d that broadcast."""
    stack = jnp.stack(jnp.broadcast_arrays(*elements))
    return stack.reshape(2, 2, *stack.shape[1:])


def product2(left: Matrix2, right: Matrix2) -> Matrix2:
    """Product of 2 × 2 matrices, written out."""
    return computed_once(left[:, :1] * right[:1] + left[:, 1:] * right[1:])


def inverse2(matrix: Matrix2) -> Matrix2:
    """Inverse of 2 × 2 matrices."""
    # One division, and none in the derivatives, which are many times as long: XLA compiles each by itself.
    k = 1.0 / (matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0])
    sign = np.array([[1.0, -1.0], [-1.0, 1.0]]).reshape(2, 2, *(1,) * k.ndim)
    return computed_once(sign * k * matrix[::-1, ::-1].swapaxes(0, 1))


def _matrix(*rows: tuple[Real, ...]) -> Float[Array, "... 4 4"]:
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def product(matrices: Iterable[Float[Array, "... 4 4"] | None]) -> Float[Array, "... 4 4"] | None:
    """Product of Mueller matrices given in the order in which light meets the elements; None among them is the
    identity.

    None comes back if all of them are None.
    """
    result = None
    for matrix in matrices:
        if matrix is not None:
            result = matrix if result is None else matrix @ result
    return result


def from_jones(jones: Matrix2) -> Float[Array, "... 4 4"]:
    """Mueller matrix of a Jones matrix.

    M_ij = ½ Tr(σ_i J σ_j J†) with the Pauli matrices ordered as S0…S3 (Gil & Ossikovski 2016, eq. 3.11),
    written out; a non-depolarising matrix, Tr(MᵀM) = 4 M00².
    """
    (a, b), (c, d) = jones

    def power(z: Inexact[Array, ...]) -> Real:
        return z.real**2 + z.imag**2

    aa, bb, cc, dd = power(a), power(b), power(c), power(d)
    ab, cd = a * jnp.conj(b), c * jnp.conj(d)
    ac, bd = a * jnp.conj(c), b * jnp.conj(d)
    ad, bc = a * jnp.conj(d), b * jnp.conj(c)
    return _matrix(
        (0.5 * (aa + bb + cc + dd), 0.5 * (aa - bb + cc - dd), (ab + cd).real, -(ab + cd).imag),
        (0.5 * (aa + bb - cc - dd), 0.5 * (aa - bb - cc + dd), (ab - cd).real, -(ab - cd).imag),
        ((ac + bd).real, (ac - bd).real, (ad + bc).real, -(ad - bc).imag),
        ((ac + bd).imag, (ac - bd).imag, (ad + bc).imag, (ad - bc).real),
    )


def diattenuator(q: Real, u: Real, v: Real | float = 0.0) -> Float[Array, "... 4 4"]:
    """Non-depolarising diattenuator of unit mean transmission with diattenuation vector (q, u, v).

    M = [[1, Dᵀ], [D, √(1−D²) 1 + (1 − √(1−D²)) D̂D̂ᵀ]] (Lu & Chipman 1996, eq. 18); identity for D = 0. The
    factor (1 − √(1−D²))/D² is written 1/(1 + √(1−D²)), which has no singularity there.
    """
    q, u, v = jnp.broadcast_arrays(q, u, v)
    root = jnp.sqrt(1.0 - q**2 - u**2 - v**2)
    k, ones = 1.0 / (1.0 + root), jnp.ones_like(root)
    return _matrix(
        (ones, q, u, v),
        (q, root + k * q**2, k * q * u, k * q * v),
        (u, k * q * u, root + k * u**2, k * u * v),
        (v, k * q * v, k * u * v, root + k * v**2),
    )


def retarder(delta: Real, axis: Real) -> Float[Array, "... 4 4"]:
    """Linear retarder of retardance `delta` with its fast axis at `axis` (both rad).

    Paper II, appendix B, general retarder matrix; identity for delta = 0.
    """
    delta, axis = jnp.broadcast_arrays(delta, axis)
    c2, s2 = jnp.cos(2 * axis), jnp.sin(2 * axis)
    cd, sd = jnp.cos(delta), jnp.sin(delta)
    ones, zeros = jnp.ones_like(delta), jnp.zeros_like(delta)
    return _matrix(
        (ones, zeros, zeros, zeros),
        (zeros, c2**2 + s2**2 * cd, c2 * s2 * (1 - cd), -s2 * sd),
        (zeros, c2 * s2 * (1 - cd), c2**2 * cd + s2**2, c2 * sd),
        (zeros, s2 * sd, -c2 * sd, cd),
    )


def rotation(angle: Real) -> Float[Array, "... 4 4"]:
    """Stokes parameters referred to axes turned by `angle` (rad): the matrix M_rot(angle) of Paper II."""
    c2, s2 = jnp.cos(2 * angle), jnp.sin(2 * angle)
    ones, zeros = jnp.ones_like(c2), jnp.zeros_like(c2)
    return _matrix(
        (ones, zeros, zeros, zeros),
        (zeros, c2, s2, zeros),
        (zeros, -s2, c2, zeros),
        (zeros, zeros, zeros, ones),
    )


def polarised(angle: Real, extinction: Real | float) -> Float[Array, "... 4"]:
    """Stokes vector behind a polariser with its axis at `angle` (rad), per unit of transmitted light.

    (1, c cos 2θ, c sin 2θ, 0) with c = (1 − ε)/(1 + ε), ε the extinction ratio.
    """
    c = (1.0 - extinction) / (1.0 + extinction)
    two = 2.0 * angle
    return jnp.stack([jnp.ones_like(two), c * jnp.cos(two), c * jnp.sin(two), jnp.zeros_like(two)], axis=-1)


def general_retarder(q: Real, u: Real, v: Real | float = 0.0) -> Float[Array, "... 4 4"]:
    """Elliptical retarder of retardance vector (q, u, v) (rad): the Poincaré sphere turned about it by its length.

    M = 1 + s A + c A², A the cross product with the vector r, s = sin Δ/Δ, c = (1 − cos Δ)/Δ², Δ = |r|; smooth at 0.
    A linear one at an axis α has (Δ cos 2α, Δ sin 2α, 0).
    """
    q, u, v = jnp.broadcast_arrays(q, u, v)
    square = q**2 + u**2 + v**2
    small = square < 1e-6
    length = jnp.sqrt(jnp.where(small, 1.0, square))
    s = jnp.where(small, 1.0 - square / 6.0 + square**2 / 120.0, jnp.sin(length) / length)
    half = jnp.sin(0.5 * length) / (0.5 * length)
    c = jnp.where(small, 0.5 - square / 24.0 + square**2 / 720.0, 0.5 * half**2)
    ones, zeros = jnp.ones_like(square), jnp.zeros_like(square)
    return _matrix(
        (ones, zeros, zeros, zeros),
        (zeros, ones - c * (u**2 + v**2), c * q * u + s * v, c * q * v - s * u),
        (zeros, c * q * u - s * v, ones - c * (q**2 + v**2), c * u * v + s * q),
        (zeros, c * q * v + s * u, c * u * v - s * q, ones - c * (q**2 + u**2)),
    )

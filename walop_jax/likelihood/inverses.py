"""Linear algebra of quantities whose units differ by orders of magnitude: scaled row by row and column by column.

The threshold of rounding then depends on no unit.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from walop_jax.io.shapes import AnyMatrix

RANK_TOLERANCE = 1e-8


def whitening(matrix: AnyMatrix, least: float = RANK_TOLERANCE) -> AnyMatrix:
    """W with Wᵀ G W = 1 on the range of a symmetric matrix G, so that W Wᵀ is its inverse there.

    With a diagonal of ones, directions of which the matrix has less than the fraction `least` of its largest eigenvalue
    are left out, and rows of zeros with them.
    """
    norm = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    scale = np.where(norm > 0, 1.0 / np.where(norm > 0, norm, 1.0), 0.0)
    value, vector = np.linalg.eigh(matrix * np.outer(scale, scale))
    keep = value > max(value.max(initial=0.0), 1e-300) * least
    return scale[:, None] * vector[:, keep] / np.sqrt(value[keep])


def pseudo_inverse(matrix: AnyMatrix, least: float) -> AnyMatrix:
    """The inverse of a symmetric matrix on what `whitening` keeps of it, zero elsewhere."""
    root = whitening(matrix, least)
    return root @ root.T


def determined(matrix: AnyMatrix, weak: Float[np.ndarray, " _"]) -> float:
    """Number of parameters that data determine: the trace of (G − L) G⁻¹, that of the hat matrix.

    G is the matrix of data, priors and the weak pulls whose precisions L (a diagonal) are no knowledge: a parameter
    that only its weak pull determines counts as none.
    """
    return len(weak) - float(weak @ np.sum(whitening(matrix, 1e-15) ** 2, axis=1))


def unit_columns(matrix: AnyMatrix) -> tuple[AnyMatrix, Float[np.ndarray, " _"]]:
    """The columns of a matrix at unit length, and their lengths; of a column of zeros the length is 1."""
    length = np.linalg.norm(matrix, axis=0)
    length = np.where(length > 0, length, 1.0)
    return matrix / length, length


def square_root(covariance: Float[np.ndarray, "*r n n"]) -> Float[np.ndarray, "*r n n"]:
    """F with F Fᵀ the covariance, columns by size, smallest first; negative eigenvalues are rounding."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.clip(value, 0.0, None))[..., None, :]


def root_of(matrices: Float[np.ndarray, "r n n"], least: float = 0.0) -> Float[np.ndarray, "r n b"]:
    """B with B Bᵀ the matrices, without eigenvalues below a fraction `least` of the largest (none: as many columns)."""
    root = square_root(matrices)
    value = np.sum(root**2, axis=1)
    return root[:, :, -int((value > least * value[:, -1:]).sum(axis=1).max()) :]


def of_low_rank(responses: Float[np.ndarray, "*p e k c"]) -> Float[np.ndarray, "*p e k c"]:
    """U with 1 − U Uᵀ = (1 + A Aᵀ)^(−1/2), from A: with AᵀA = V D Vᵀ, U = A V √((1 − (1 + D)^(−1/2)) / D)."""
    square, axes = np.linalg.eigh(np.einsum("...ekc,...ekd->...cd", responses, responses))
    square = np.maximum(square, 0.0)
    root = np.sqrt(1.0 + square)
    size = 1.0 / np.sqrt(root * (1.0 + root))  # (1 − 1/√(1 + D)) / D without a difference of equal numbers
    return responses @ (axes * size[..., None, :])[..., None, :, :]

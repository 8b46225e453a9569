"""Errors of calibrated stars that errors of the instrument matrix make: of p on average, of q and u at worst.

Stars       q, u with p ≤ 5 %, evenly, at any angle.
Impact      m = m₀ + A s with s = (q, u), so a star that is calibrated with (m₀, A) while (m₀ + δm₀, A + δA) is true
            comes out wrong by A⁻¹ (δm₀ + δA s), at most |A⁻¹ δm₀| + p ‖A⁻¹ δA‖.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

Matrices = Float[np.ndarray, "p a 3"]  # point, arm, element

STARS, LARGEST_P = 100, 0.05
GOAL = 0.001
"""Error of p that instruments are built for."""
SMALLEST_DETERMINANT = 0.1
"""|m22 m33 − m23 m32| below which a single exposure carries almost no information on u."""
SHARE = 0.95  # of the field where one exposure measures u: the verdict is about that part
SIZE = 21  # points along each axis of a map of the field
NODES = (10, 14, 20, 28)
_ROUNDING = 1e-12  # of q and u: what the rounding of matrices may make of nothing
TOLERANCE = 1e-2  # relative, of errors that are given with two digits


def sample_stars(count: int = STARS, seed: int = 0) -> Float[np.ndarray, "n 2"]:
    """(q, u) of sources with p evenly up to `LARGEST_P` and any angle."""
    rng = np.random.default_rng(seed)
    p, angle = rng.uniform(0.0, LARGEST_P, count), rng.uniform(0.0, np.pi, count)
    return np.stack([p * np.cos(2 * angle), p * np.sin(2 * angle)], axis=1)


def p_errors(
    matrix: Float[np.ndarray, "p 6"],
    covariance: Float[np.ndarray, "p 6 6"],
    stars: Float[np.ndarray, "n 2"] | None = None,
) -> Float[np.ndarray, " p"]:
    """Error of p for stars (q, u; None: `sample_stars`), rms over them, from the matrix and its covariance."""
    form = p_forms(matrix, sample_stars() if stars is None else stars)
    variance = np.einsum("pni,pij,pnj->pn", form, covariance, form, optimize=True)
    return np.sqrt(np.mean(variance, axis=1))


def p_forms(
    matrix: Float[np.ndarray, "p 6"], stars: Float[np.ndarray, "*b n 2"]
) -> Float[np.ndarray, "p n 6"]:
    """δp = −e · M⁻¹ · (δm s) of every star as a linear form (p, n, 6) of the six matrix elements.

    `stars` (q, u) are the same at all points (n, 2), or others at each (p, n, 2).
    """
    stars = np.broadcast_to(stars, (len(matrix), *stars.shape[-2:]))
    with np.errstate(divide="ignore", invalid="ignore"):
        (a, b), (c, d) = matrix[:, 1:3].T, matrix[:, 4:].T
        inverse = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], 1) / (a * d - b * c)[:, None, None]
        along = stars / np.hypot(stars[..., :1], stars[..., 1:])
        s = np.concatenate([np.ones((*stars.shape[:2], 1)), stars], axis=2)
        row = np.einsum("pnc,pcr->pnr", along, inverse)
        return np.einsum("pnr,pns->pnrs", row, s).reshape(*stars.shape[:2], 6)


def measures_u(matrix: Float[np.ndarray, "p 2 3"]) -> Bool[np.ndarray, " p"]:
    """True (p) where one exposure measures q and u, by the determinant of the 2 × 2 part of its matrix."""
    return np.abs(np.linalg.det(matrix[:, :, 1:])) >= SMALLEST_DETERMINANT


def reached(error: Float[np.ndarray, "*p"]) -> float:
    """The error that the fraction `SHARE` of some field points stay below; NaN without a point."""
    return float(np.quantile(error, SHARE)) if error.size else np.nan


def field_measured(without_u: float) -> str:
    """The part of the field that `reached` is about, in words: "95 % of the field" where every exposure measures u.

    `without_u` is the fraction of the field, 0 to 1, in which one exposure does not measure u; it is left out.
    """
    field = f"{100 * SHARE:.0f} % of the field"
    return f"{field} with u in one exposure ({100 * (1.0 - without_u):.0f} %)" if without_u > 0 else field


def change_of_qu(assumed: Matrices, true: Matrices) -> Float[np.ndarray, " p"]:
    """Largest error (p) of q and u of stars with p ≤ `LARGEST_P` at each field point; NaN where they are not measured.

    Errors no larger than the rounding of the matrices are 0.
    """
    errors = np.full(len(assumed), np.nan)
    if assumed.shape[1] != 2:  # one exposure of one arm, or of three, does not give q and u and nothing else
        return errors
    good = measures_u(assumed)
    inverse = np.linalg.inv(assumed[good, :, 1:])
    change = (true - assumed)[good]
    offset = np.linalg.norm(inverse @ change[:, :, :1], axis=(1, 2))
    errors[good] = offset + LARGEST_P * np.linalg.norm(inverse @ change[:, :, 1:], ord=2, axis=(1, 2))
    return np.where(errors < _ROUNDING, 0.0, errors)


def largest_change(assumed: Matrices, true: Matrices) -> float:
    """The largest `change_of_qu` over the field; NaN if no point measures both q and u."""
    errors = change_of_qu(assumed, true)
    return float(np.nanmax(errors)) if np.isfinite(errors).any() else float("nan")

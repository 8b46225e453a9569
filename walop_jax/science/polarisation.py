"""Degree and angle of polarisation from (q, u) and their covariance, and the degree without its bias.

    p = √(q² + u²),    EVPA = ½ arctan2(u, q),    n = (q, u)/p,    t = (−u, q)/p

Errors      σ_p² = nᵀ C n;  σ_EVPA = σ_t / 2p with σ_t² = tᵀ C t, and no more than 180°/√12, what a uniform
            distribution has.
Bias        Noise across the direction of (q, u) only ever lengthens the vector: <p> ≈ p₀ + σ_t²/2p₀. Two
            estimators of p₀ are offered, both with b = σ_t, which is σ where C = σ² 1:

  MAS       p − b² (1 − exp(−p²/b²)) / 2p: the modified asymptotic estimator of Plaszczynski et al. 2014,
            MNRAS 439, 4048. Smooth, never negative, tends to p/2 at low signal.
  WK        √(p² − b²), and 0 where p < b: Wardle & Kronberg 1974, ApJ 194, 249.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, " s"]
ESTIMATORS = ("MAS", "WK")
NO_ANGLE = 180.0 / np.sqrt(12.0)
"""Standard deviation (deg) of an angle of which nothing is known."""


class Polarisation(NamedTuple):
    """Degree of polarisation, debiased degree, its error; angle and error in degrees, 0 ≤ EVPA < 180."""

    degree: Vector
    debiased: Vector
    degree_error: Vector
    angle: Vector
    angle_error: Vector


def polarisation(
    qu: Float[np.ndarray, "s 2"], covariance: Float[np.ndarray, "s 2 2"], estimator: str = "MAS"
) -> Polarisation:
    """Degree and angle of polarisation of stars; NaN stays NaN.

    Raises ValueError for an estimator that is none of `ESTIMATORS`.
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"there is no estimator {estimator!r}: choose {' or '.join(ESTIMATORS)}")
    q, u = qu.T
    p = np.hypot(q, u)
    lit = p > 0
    cos, sin = np.where(lit, q, 1.0) / np.where(lit, p, 1.0), np.where(lit, u, 0.0) / np.where(lit, p, 1.0)
    qq, qu_, uu = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    along = cos**2 * qq + 2.0 * cos * sin * qu_ + sin**2 * uu
    across = sin**2 * qq - 2.0 * cos * sin * qu_ + cos**2 * uu
    with np.errstate(divide="ignore", invalid="ignore"):
        if estimator == "MAS":
            # −expm1 keeps the difference of nearly equal numbers exact where p ≪ b.
            taken = across * -np.expm1(-(p**2) / across) / (2.0 * p)
            debiased = np.where(lit, p - np.where(across > 0, taken, 0.0), p)
        else:
            debiased = np.sqrt(np.maximum(p**2 - across, 0.0))
        error = np.minimum(np.rad2deg(np.sqrt(across) / (2.0 * p)), NO_ANGLE)
    return Polarisation(
        degree=p,
        debiased=debiased,
        degree_error=np.sqrt(np.maximum(along, 0.0)),
        angle=np.mod(np.rad2deg(0.5 * np.arctan2(u, q)), 180.0),
        angle_error=error,
    )

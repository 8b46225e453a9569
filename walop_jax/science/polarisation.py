"""Degree and angle of polarisation from (q, u) and their covariance, and the degree without its bias.

    p = √(q² + u²),    EVPA = ½ arctan2(u, q),    n = (q, u)/p,    t = (−u, q)/p

Errors      σ_p² = nᵀ C n;  σ_EVPA = σ_t / 2p with σ_t² = tᵀ C t, and no more than 180°/√12, that of a
            uniform distribution. Where p < 5 σ_p, (q, u) may as well lie on the other side of 0, and where p < 5 σ_t
            angles are no small ones: there it is the rms distance, within half a turn, of the angles of a normal
            distribution about (q, u) from EVPA. Where C = 1 and m = |(q, u)|, the angle α of the vectors from that of
            their mean has the density
            f(α) = φ(m) (1 + b Φ(b)/φ(b)) / √(2π), b = m cos α, φ and Φ the normal density and its integral
            (Mardia 1972, Statistics of Directional Data, 3.4); C^½ takes it to any other C
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
from scipy import special

from walop_jax.io.shapes import OfStars

ESTIMATORS = ("MAS", "WK")
_CERTAIN, _ANGLES, _TOGETHER = 5.0, 128, 4096  # σ from which C alone counts; angles, and stars at once
NO_ANGLE = 180.0 / np.sqrt(12.0)  # standard deviation (deg) of an angle of which nothing is known


class Polarisation(NamedTuple):
    """Degree of polarisation, debiased degree, its error; angle and error in degrees, 0 ≤ EVPA < 180."""

    degree: OfStars
    debiased: OfStars
    degree_error: OfStars
    angle: OfStars
    angle_error: OfStars


def polarisation(
    qu: Float[np.ndarray, "s 2"], covariance: Float[np.ndarray, "s 2 2"], estimator: str = "MAS"
) -> Polarisation:
    """Degree and angle of polarisation of stars; NaN stays NaN. Raises ValueError for an unknown estimator."""
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
            bias = across * -np.expm1(-(p**2) / across) / (2.0 * p)
            debiased = np.where(lit, p - np.where(across > 0, bias, 0.0), p)
        else:
            debiased = np.sqrt(np.maximum(p**2 - across, 0.0))
        error = np.minimum(np.rad2deg(np.sqrt(across) / (2.0 * p)), NO_ANGLE)
    least = (1.0 - 1e-9) * _CERTAIN**2 * np.maximum(along, across)
    weak = np.flatnonzero((p**2 < least) & (qq * uu > qu_**2))
    for chunk in np.array_split(weak, len(weak) // _TOGETHER + 1):
        error[chunk] = _spread_of_angles(qu[chunk], covariance[chunk])
    angle = np.mod(np.rad2deg(0.5 * np.arctan2(u, q)), 180.0)
    return Polarisation(p, debiased, np.sqrt(np.maximum(along, 0.0)), angle, error)


def _spread_of_angles(qu: Float[np.ndarray, "s 2"], covariance: Float[np.ndarray, "s 2 2"]) -> OfStars:
    """The rms distance (deg, within half a turn) of the angles of normal distributions from that of their means."""
    root = np.linalg.cholesky(covariance)
    mean = np.linalg.solve(root, qu[..., None])[..., 0]
    m = np.hypot(*mean.T)[:, None]
    # Angles are the closer to that of the mean the narrower their distribution, of width 1/m.
    tangent = np.tan(0.5 * ((np.arange(_ANGLES) + 0.5) * 2.0 * np.pi / _ANGLES - np.pi))
    narrow = 1.0 / (1.0 + m)
    away = 2.0 * np.arctan(narrow * tangent)
    step = narrow * (1.0 + tangent**2) / (1.0 + (narrow * tangent) ** 2)
    b = m * np.cos(away)
    integral = np.sqrt(2.0 * np.pi) * b * special.ndtr(b) * np.exp(0.5 * (b**2 - m**2))
    weight = step * (np.exp(-0.5 * m**2) + integral)
    phi = np.arctan2(mean[:, 1], mean[:, 0])[:, None] + away
    x, y = np.einsum("sij,jsa->isa", root, np.stack([np.cos(phi), np.sin(phi)]))
    turned = np.angle((x + 1j * y) * np.exp(-1j * np.arctan2(qu[:, 1], qu[:, 0]))[:, None])
    return np.rad2deg(0.5 * np.sqrt((weight * turned**2).sum(axis=1) / weight.sum(axis=1)))

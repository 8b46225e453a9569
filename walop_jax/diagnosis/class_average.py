"""Averages over models that the data do not distinguish: mean, covariance with their spread, equivalent members.

Equation     m̄ = Σ w_k m_k,   C = Σ w_k [C_k + (m_k − m̄)(m_k − m̄)ᵀ],   w_k = B_k / Σ B
Symbols      m_k values in model k, of numbers that may be 0 in some of them; C_k their covariance; B_k evidence
Source       Leamer 1978, Specification Searches, ch. 4; Hoeting et al. 1999, Stat. Sci. 14, 382 (law of total variance)
One step     A model without some amplitudes a leaves r + D of the residuals r, D = −J_a a. Other columns K take their
             place with b = −(KᵀPK)⁺ KᵀP(r + D), and all other parameters move by −J_o⁺ (D + K b), where P projects off
             the other columns J_o. Exact where everything is linear.
Limits       Members with the same effect on the result count once, as the most probable of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from walop_jax.likelihood.inverses import pseudo_inverse

Vector = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "_ _"]


def mixture(
    weights: Vector, values: Float[np.ndarray, "k n"], covariances: Sequence[Matrix]
) -> tuple[Vector, Matrix]:
    """Mean and covariance over models of some probabilities, by the law of total variance."""
    mean = weights @ values
    away = values - mean
    covariance = (away * weights[:, None]).T @ away
    for weight, within in zip(weights, covariances, strict=True):
        covariance += weight * within
    return mean, covariance


def known_apart_from(covariance: Matrix, at: Int[np.ndarray, " k"]) -> Matrix:
    """Conditional covariance of all others given the parameters `at`: C − C_a C_aa⁺ C_aᵀ, 0 in the rows of these."""
    across = covariance[:, at]
    conditional = covariance - across @ pseudo_inverse(covariance[np.ix_(at, at)], 1e-12) @ across.T
    conditional[at], conditional[:, at] = 0.0, 0.0
    return 0.5 * (conditional + conditional.T)


def distinct(
    evidence: Vector, changes: Float[np.ndarray, "k p m"], errors: Float[np.ndarray, "p m"], alike: float
) -> list[int]:
    """Models with different changes, the most probable of each group of equivalent ones, best first.

    Two are equivalent where their changes differ by less than `alike` of the errors, rms over places, in every element.
    """
    scale = np.where(errors > 0, errors, np.inf)
    chosen: list[int] = []
    for k in np.argsort(-evidence, kind="stable").tolist():
        apart = (np.sqrt(np.mean(((changes[k] - changes[j]) / scale) ** 2, axis=0)).max() for j in chosen)
        if all(distance >= alike for distance in apart):
            chosen.append(k)
    return chosen

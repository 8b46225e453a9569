"""Draws with errors from what a fit leaves, for data that scatter by more than the errors that they state.

Equation    θ' = m + Ω (θ − m),  Ω = L_C L_H⁻¹,  L_C L_Cᵀ = C,  L_H L_Hᵀ = H⁻¹
Symbols     θ draws under the stated errors, m their mean; H⁻¹ covariance of the fit under the stated errors; C that
            from residuals (`fit.robust`)
Source      open-faced sandwich: Shaby 2014, Journal of Computational and Graphical Statistics 23, 853
Limits      C = H⁻¹: nothing changes. Ω is not the symmetric root of that paper but lower triangular; both give draws of
            covariance C where those of the sampler have H⁻¹, and what is skew in them stays skew.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from walop_jax.model.specification import Model
from walop_jax.posterior.result import PosteriorSample

Matrix = Float[np.ndarray, "n n"]


def with_errors_of(
    sample: PosteriorSample, model: Model, stated: Matrix, wanted: Matrix, made_from: str
) -> PosteriorSample:
    """A sample with its draws spread about their mean as a covariance wants it; chains stay as they were sampled.

    `stated` and `wanted` are covariances of all parameters of the model; `made_from` says what `wanted` was made from.
    """
    free, ties = model.free, model.selection()
    at = np.ix_(free, free)
    unit = np.sqrt(np.diag(stated)[free])
    lower, upper = (np.linalg.cholesky(matrix[at] / np.outer(unit, unit)) for matrix in (stated, wanted))
    omega = unit[:, None] * np.linalg.solve(lower.T, upper.T).T / unit
    away = (sample.draws - sample.mean)[..., free] @ omega.T
    draws = sample.mean + away @ ties.T
    covariance = ties @ omega @ sample.covariance[at] @ omega.T @ ties.T
    return dataclasses.replace(sample, draws=draws, covariance=covariance, errors_from=made_from)

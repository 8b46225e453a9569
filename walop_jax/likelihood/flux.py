"""A flux that nobody knows: the one that fits best, and derivatives with it eliminated.

Equation    For the cameras of one exposure at one field point, with y = N/σ and a = model/σ for unit flux,
                F = y·a / a·a,    r = y − F a,    d ← d − a (a·d)/(a·a)
Symbols     d a derivative of F a, the flux held; behind detectors that are not linear a is ∂(model)/∂F over σ
Source      Kaufman's form of variable projection (Golub & Pereyra 2003, Inverse Problems 19, R1): the gradient
            is exact, and JᵀJ is the Fisher information with the flux marginalised
Limit       where the flux is known, F = 1 and nothing is projected
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float


def _namespace(array: Any) -> ModuleType:
    return jnp if isinstance(array, jax.Array) else np


def eliminate_flux(
    weighted_counts: Float[Any, "*e k"], weighted_model: Float[Any, "*e k"], flux_known: Bool[Any, ...]
) -> tuple[Float[Any, "*e"], Float[Any, "*e k"]]:
    """Best flux of every exposure and the normalised residuals data − model."""
    xp = _namespace(weighted_model)
    power = (weighted_model**2).sum(axis=-1)
    best = (weighted_counts * weighted_model).sum(axis=-1) / xp.where(power > 0, power, 1.0)
    flux = xp.where(flux_known, 1.0, best)
    return flux, weighted_counts - flux[..., None] * weighted_model


def project_flux(
    columns: Float[Any, "... k"], along: Float[Any, "... k"], flux_known: Bool[Any, ...] | bool = False
) -> Float[Any, "... k"]:
    """Derivatives of weighted counts, `columns`, without what a change of the flux can take up.

    `along` is the derivative with respect to the flux; it and `flux_known` broadcast against the columns. Arrays of
    numpy stay so.
    """
    xp = _namespace(columns)
    power = (along**2).sum(axis=-1)
    share = (columns * along).sum(axis=-1) / xp.where(power > 0, power, 1.0)
    return columns - xp.where(flux_known, 0.0, share)[..., None] * along

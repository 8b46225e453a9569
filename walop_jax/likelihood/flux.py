"""A flux that nobody knows: the one that fits best, and derivatives with it eliminated.

Equation    For the cameras of one exposure at one field point, with y = N/σ and a = model/σ for unit flux,
                F = y·a / a·a,    r = y − F a,    d ← d − a (a·d)/(a·a)
Symbols     d a derivative of F a, the flux held; behind detectors that are not linear a is ∂(model)/∂F over σ
Source      Kaufman's form of variable projection (Golub & Pereyra 2003, Inverse Problems 19, R1): the gradient
            is exact, and JᵀJ is the Fisher information with the flux marginalised
Limits      where the flux is known, F = 1 and nothing is projected; where the shares of the arms are unknown too
            (`Cameras.split`), each arm has a flux of its own: sums run over cameras that stand `together`
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


def _summed(values: Float[Any, "*e k"], together: Float[Any, "k k"] | None) -> Float[Any, "*e f"]:
    """Sums over the cameras of one flux, once for all cameras (f = 1) or camera by camera (f = k)."""
    return values.sum(axis=-1, keepdims=True) if together is None else values @ together


def eliminate_flux(
    weighted_counts: Float[Any, "*e k"],
    weighted_model: Float[Any, "*e k"],
    flux_known: Bool[Any, ...],
    together: Float[Any, "k k"] | None = None,
) -> tuple[Float[Any, "*e f"], Float[Any, "*e k"]]:
    """Best flux of every exposure and the normalised residuals data − model.

    `together` is 1 where two cameras have the same flux; None: all have, and the last axis of the flux has length 1.
    """
    xp = _namespace(weighted_model)
    power = _summed(weighted_model**2, together)
    best = _summed(weighted_counts * weighted_model, together) / xp.where(power > 0, power, 1.0)
    flux = xp.where(xp.asarray(flux_known)[..., None], 1.0, best)
    return flux, weighted_counts - flux * weighted_model


def project_flux(
    columns: Float[Any, "... k"],
    along: Float[Any, "... k"],
    flux_known: Bool[Any, ...] | bool = False,
    together: Float[Any, "k k"] | None = None,
) -> Float[Any, "... k"]:
    """Derivatives of weighted counts, `columns`, without what a change of the flux can take up.

    `along` is the derivative with respect to the flux; it and `flux_known` broadcast against the columns; `together`
    as in `eliminate_flux`. Arrays of numpy stay so.
    """
    xp = _namespace(columns)
    power = _summed(along**2, together)
    share = _summed(columns * along, together) / xp.where(power > 0, power, 1.0)
    return columns - xp.where(xp.asarray(flux_known)[..., None], 0.0, share) * along

"""Elimination of the unknown flux of each exposure, and derivatives with it eliminated.

Equation    For the cameras of one exposure at one field point, with y = N/σ and a = model/σ for unit flux,
                F = y·a / a·a,    r = y − F a,    d ← d − a (a·d)/(a·a)
Symbols     d a derivative of F a, the flux held; behind detectors that are not linear a is ∂(model)/∂F over σ
Source      Kaufman's form of variable projection (Golub & Pereyra 2003, Inverse Problems 19, R1): the gradient
            is exact, and JᵀJ is the Fisher information with the flux marginalised; a star of a field that is off by
            δ ~ N(0, 1) in a direction adds A Aᵀ to the covariance of its r, A = ∂r/∂δ, and r ← (1 + A Aᵀ)^(−1/2) r
            as well as d makes them independent again (`inverses.of_low_rank`)
Limits      where the flux is known, F = 1 and nothing is projected; where the fractions of the light in the arms are
            unknown (`Cameras.split`), y·a and a·a run over the cameras and exposures of one flux (`FluxGroups`)
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float


def namespace(*arrays: Any) -> ModuleType:
    """`jax.numpy` if one of the arrays is one of JAX, else `numpy`: arrays of numpy stay so."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np


class FluxGroups(NamedTuple):
    """Which intensities of a field point have one unknown flux in common.

    `cameras[k, l]` is 1 if cameras k and l have one flux; None: all cameras have one. `exposures[e, g]` is 1 if
    exposure e belongs to flux group g; None: every exposure has a flux of its own. `FluxGroups()` is the usual case: a
    flux for each exposure, the same for all cameras. A steady lamp seen in three exposures is one group: a column of
    three ones.

    `stars` is for stars of a field that differ from its mean q, u in all exposures of a point alike: the matrix U of 1
    − U Uᵀ = (1 + A Aᵀ)^(−1/2) at each point (`Source` in the head of this file); None: no star differs.
    """

    cameras: Float[Any, "k k"] | None = None
    exposures: Float[Any, "e s"] | None = None
    stars: Float[Any, "*p e k c"] | None = None

    @property
    def single(self) -> bool:
        """True where every exposure of a point is independent of the others."""
        return self.exposures is None and self.stars is None

    def summed(self, values: Float[Any, "... e k"]) -> Float[Any, "... e f"]:
        """Sums over the intensities with a common flux: once for all cameras (f = 1), or for each camera the sum of its
        group (f = k).
        """
        by_camera = values.sum(axis=-1, keepdims=True) if self.cameras is None else values @ self.cameras
        if self.exposures is None:
            return by_camera
        xp = namespace(values)
        groups = xp.einsum("...ek,es->...sk", by_camera, self.exposures)
        return xp.einsum("...sk,es->...ek", groups, self.exposures)

    def independent(self, values: Float[Any, "... e k"], inverse: bool = False) -> Float[Any, "... e k"]:
        """Weighted residuals or derivatives, the flux eliminated, made independent; `inverse` undoes it."""
        if self.stars is None:
            return values
        xp = namespace(values)
        *lead, exposures, cameras, directions = self.stars.shape
        stars = xp.asarray(self.stars).reshape(*lead, exposures * cameras, directions)
        back = xp.swapaxes(stars, -2, -1)
        if inverse:
            back = -xp.linalg.solve(xp.eye(directions) - back @ stars, back)
        flat = values.reshape(*values.shape[:-2], 1, exposures * cameras)
        return (flat - (flat @ xp.swapaxes(back, -2, -1)) @ xp.swapaxes(stars, -2, -1)).reshape(values.shape)


ALONE = FluxGroups()
"""A flux for every exposure, of all cameras."""


def eliminate_flux(
    weighted_counts: Float[Any, "... k"],
    weighted_model: Float[Any, "... k"],
    flux_known: Bool[Any, ...],
    shared: FluxGroups = ALONE,
) -> tuple[Float[Any, "... f"], Float[Any, "... k"]]:
    """Best flux of every exposure and the normalised residuals data − model; f as in `FluxGroups.summed`."""
    xp = namespace(weighted_model)
    power = shared.summed(weighted_model**2)
    best = shared.summed(weighted_counts * weighted_model) / xp.where(power > 0, power, 1.0)
    flux = xp.where(xp.asarray(flux_known)[..., None], 1.0, best)
    return flux, weighted_counts - flux * weighted_model


def project_flux(
    columns: Float[Any, "... k"],
    along: Float[Any, "... k"],
    flux_known: Bool[Any, ...] | bool = False,
    shared: FluxGroups = ALONE,
) -> Float[Any, "... k"]:
    """Derivatives of weighted counts, `columns`, without the component along a change of the flux.

    `along` is the derivative with respect to the flux; it and `flux_known` broadcast against the columns. Arrays of
    numpy stay so.
    """
    xp = namespace(columns)
    power = shared.summed(along**2)
    component = shared.summed(columns * along) / xp.where(power > 0, power, 1.0)
    return shared.independent(columns - xp.where(xp.asarray(flux_known)[..., None], 0.0, component) * along)

"""Derivatives of the instrument matrix: with respect to all parameters, and to amplitudes of effects not yet there."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from walop_jax.calibration.matrix import in_chunks, point_matrix, point_sky_vectors
from walop_jax.calibration.records import SMALLEST_DETERMINANT
from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.likelihood import limits
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.effects.base import Effect, with_amplitudes
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for_settings

Scalar = Float[Array, ""]
Vector = Float[np.ndarray, " p"]

LARGEST_P = 0.05


def change_of_qu(
    assumed: Float[np.ndarray, "p a 3"], true: Float[np.ndarray, "p a 3"], p: float = LARGEST_P
) -> Float[np.ndarray, " p"]:
    """Largest error of q and u at each field point for stars polarised by up to `p`; NaN where not measured."""
    found = np.full(len(assumed), np.nan)
    if assumed.shape[1] != 2:  # one exposure of one arm, or of three, does not give q and u and nothing else
        return found
    good = np.abs(np.linalg.det(assumed[:, :, 1:])) > SMALLEST_DETERMINANT
    inverse = np.linalg.inv(assumed[good, :, 1:])
    change = (true - assumed)[good]
    offset = np.linalg.norm(inverse @ change[:, :, :1], axis=(1, 2))
    found[good] = offset + p * np.linalg.norm(inverse @ change[:, :, 1:], ord=2, axis=(1, 2))
    return found


def matrix_slopes(
    instrument: Instrument, setting: Settings, filters: Mapping[str, FilterCurve], x: Vector, y: Vector
) -> tuple[Float[np.ndarray, "p a 3"], Float[np.ndarray, "p a 3 n"]]:
    """Instrument matrix (point, arm, element) at positions in degrees, and its derivatives to all parameters.

    `setting` has one row. Raises KeyError for a filter that `filters` does not hold.
    """
    plan = plan_for_settings(instrument, setting, filters)
    values, slopes = in_chunks(lambda a, b: _all_slopes(instrument, plan, a, b), x, y)
    return values[:, 0], slopes[:, 0]


def effect_slopes(
    instrument: Instrument,
    setting: Settings,
    filters: Mapping[str, FilterCurve],
    x: Vector,
    y: Vector,
    effects: tuple[Effect, ...],
) -> Float[np.ndarray, "p a 3 e"]:
    """Derivatives of the matrix with respect to the amplitudes of neutral effects, effect by effect in their order.

    What of an effect does not go with the matrix (single exposures, ghosts, detectors) has none.
    """
    if not effects:
        return np.zeros((len(x), len(instrument.arms), 3, 0))
    there = dataclasses.replace(instrument, effects=(*instrument.effects, *effects))
    plan = plan_for_settings(there, setting, filters)
    few = limits.MATRIX_POINTS[0]  # many amplitudes at a time: few points
    return in_chunks(lambda a, b: (_effect_slopes(instrument, plan, effects, a, b),), x, y, size=few)[0][:, 0]


def _point_effect_slopes(
    instrument: Instrument, plan: Plan, effects: tuple[Effect, ...], x: Scalar, y: Scalar
) -> Float[Array, "b a 3 e"]:
    neutral, put = with_amplitudes(instrument, effects)

    def matrix(amplitudes: list[Float[Array, ...]]) -> Float[Array, "b a 3"]:
        there = put(amplitudes)
        return light.instrument_matrix(point_sky_vectors(there, plan, x, y), there.cameras.pairs)

    _, push = jax.linearize(matrix, neutral)
    flat, to_tree = ravel_pytree(neutral)
    return jnp.moveaxis(jax.vmap(lambda one: push(to_tree(one)))(jnp.eye(flat.size)), 0, -1)


_all_slopes = compiled(jax.vmap(point_matrix, in_axes=(None, None, 0, 0)), kept_as="slopes")
_effect_slopes = compiled(
    jax.vmap(_point_effect_slopes, in_axes=(None, None, None, 0, 0)), kept_as="effect_slopes"
)

"""What effects that are not active would do to the residuals: derivatives to their amplitudes, at neutral."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from walop_jax.likelihood import limits
from walop_jax.likelihood.engine import PointData, best_flux, point_prediction, real_counts
from walop_jax.likelihood.flux import project_flux, sharing
from walop_jax.model.compiled import compiled
from walop_jax.model.effects.base import Effect, with_amplitudes
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan


def _point_effect_columns(
    instrument: Instrument, plan: Plan, probes: tuple[Effect, ...], point: PointData
) -> Float[Array, "a d"]:
    neutral, put = with_amplitudes(instrument, probes)
    at_neutral = put(neutral)
    unit = point_prediction(at_neutral, plan, point)
    flux = best_flux(at_neutral, plan, unit, point)

    def counts(amplitudes: list[Float[Array, ...]]) -> Float[Array, "e k"]:
        active = put(amplitudes)
        return real_counts(active, plan, point_prediction(active, plan, point), flux)

    _, push = jax.linearize(counts, neutral)
    flat, to_tree = ravel_pytree(neutral)
    change = jax.vmap(lambda one: push(to_tree(one)))(jnp.eye(flat.size)) * point.weight
    _, along = jax.jvp(lambda f: real_counts(at_neutral, plan, unit, f), (flux,), (jnp.ones_like(flux),))
    projected = project_flux(
        change, along * point.weight, plan.exposures.flux_known, sharing(instrument, plan)
    )
    return -projected.reshape(flat.size, -1)


def _effect_columns(
    instrument: Instrument, plan: Plan, probes: tuple[Effect, ...], data: PointData
) -> Float[Array, "p d a"]:
    """Derivatives of the residuals with respect to the amplitudes of effects that are not active, at neutral.

    Only what an effect changes is differentiated: one at the detectors costs a dot product, not the optics.
    """
    columns = jax.vmap(_point_effect_columns, in_axes=(None, None, None, 0))(instrument, plan, probes, data)
    return jnp.swapaxes(columns, 1, 2)


def _effect_columns_over_shapes(
    instrument: Instrument, plan: Plan, probes: Effect, data: PointData
) -> Float[Array, "g p d a"]:
    """As `effect_columns`, for one effect at many shapes: its parameters carry a leading axis g."""
    return jax.lax.map(
        lambda probe: _effect_columns(instrument, plan, (probe,), data),
        probes,
        batch_size=limits.PROBES_AT_ONCE,
    )


effect_columns = compiled(_effect_columns)
effect_columns_over_shapes = compiled(_effect_columns_over_shapes)

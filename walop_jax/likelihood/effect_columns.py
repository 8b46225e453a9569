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


def _point_effect_changes(
    instrument: Instrument, plan: Plan, probes: tuple[Effect, ...], point: PointData
) -> tuple[Float[Array, "a e k"], Float[Array, "e k"]]:
    """Derivatives of the weighted counts at the best flux with respect to amplitudes, and to the flux."""
    neutral, put = with_amplitudes(instrument, probes)
    at_neutral = put(neutral)
    unit = point_prediction(at_neutral, plan, point)
    flux = best_flux(at_neutral, plan, unit, point)

    def counts(amplitudes: list[Float[Array, ...]]) -> Float[Array, "e k"]:
        active = put(amplitudes)
        return real_counts(active, plan, point_prediction(active, plan, point), flux)

    _, push = jax.linearize(counts, neutral)
    flat, to_tree = ravel_pytree(neutral)
    some = min(limits.AMPLITUDES_AT_ONCE, max(flat.size, 1))
    change = jax.lax.map(lambda one: push(to_tree(one)), jnp.eye(flat.size), batch_size=some) * point.weight
    _, along = jax.jvp(lambda f: real_counts(at_neutral, plan, unit, f), (flux,), (jnp.ones_like(flux),))
    return change, along * point.weight


def _point_effect_columns(
    instrument: Instrument, plan: Plan, probes: tuple[Effect, ...], point: PointData
) -> Float[Array, "a d"]:
    change, along = _point_effect_changes(instrument, plan, probes, point)
    projected = project_flux(change, along, plan.exposures.flux_known, sharing(instrument, plan))
    return -projected.reshape(len(change), -1)


def _effect_changes(
    instrument: Instrument, plan: Plan, probes: tuple[Effect, ...], data: PointData
) -> tuple[Float[Array, "p a e k"], Float[Array, "p e k"]]:
    """As `effect_columns` with the flux held and of the counts; and the derivatives with respect to the flux."""
    return jax.vmap(_point_effect_changes, in_axes=(None, None, None, 0))(instrument, plan, probes, data)


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


effect_changes = compiled(_effect_changes, kept_as="effect_changes")
effect_columns = compiled(_effect_columns, kept_as="effect_columns")
effect_columns_over_shapes = compiled(_effect_columns_over_shapes, kept_as="effect_columns_over_shapes")

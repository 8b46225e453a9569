"""Derivatives of what is computed at a field point, once and for all: with respect to every parameter.

A quantity of a field point depends on the parameters in three ways, and each has a small Jacobian of its own:

optics      the band rows, which know few of the parameters (`optical_indices`) and come with their derivatives
plain       every other parameter but the coefficients of the throughput series, directly
local       the throughputs at the point, the only way in which the series enters: `through_series` expands them
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.model import light
from walop_jax.model.dependence import optical_indices
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.specification import series_indices

Vector = Float[Array, " n"]
Quantity = Callable[[Array, Vector, Array], Array]
"""What is computed from the rows, all parameters and the local throughputs."""


class LocalDerivatives(NamedTuple):
    """A quantity and its derivatives: leading axes are the plain parameters and the local throughputs, flattened."""

    value: Float[Array, ...]
    plain: Float[Array, "o ..."]
    local: Float[Array, "l ..."]


def optical_positions(instrument: Instrument) -> Int[np.ndarray, " o"]:
    """Positions of the parameters that enter before the band integral."""
    return np.asarray(optical_indices(instrument), int)


def series_positions(instrument: Instrument) -> Int[np.ndarray, " kt"]:
    """Positions of the coefficients of the throughput series, camera by camera."""
    return np.asarray(series_indices(instrument), int)


def plain_positions(instrument: Instrument) -> Int[np.ndarray, " o"]:
    """Positions of all other parameters."""
    return np.setdiff1d(np.arange(values_of(instrument).size), series_positions(instrument))


def rows_and_slopes(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> tuple[Float[Array, "b r 4"], Float[Array, "o b r 4"]]:
    """Band rows at a field position (deg) and their derivatives with respect to the optical parameters: exact."""
    values, to_instrument = values_of(instrument), with_values(instrument)
    optical = optical_positions(instrument)

    def optics(optical_values: Float[Array, " o"]) -> Float[Array, "b r 4"]:
        return light.band_rows(to_instrument(values.at[optical].set(optical_values)), plan, x, y)

    rows, push = jax.linearize(optics, values[optical])
    return rows, jax.vmap(push)(jnp.eye(optical.size))


def linearised(
    instrument: Instrument,
    quantity: Quantity,
    rows: Float[Array, ...],
    slopes: Float[Array, "o ..."],
    local: Float[Array, ...],
) -> LocalDerivatives:
    """A quantity of a field point and its derivatives at the values of an instrument.

    `rows` are band rows, of one site or more, and `slopes` their derivatives with respect to the optical parameters;
    `local` are the throughputs of the cameras there.
    """
    values = values_of(instrument)
    optical, plain = optical_positions(instrument), plain_positions(instrument)
    value, push = jax.linearize(quantity, rows, values, local)
    no_rows, no_values, no_local = jnp.zeros_like(rows), jnp.zeros_like(values), jnp.zeros_like(local)
    # Optical parameters carry their rows; those that act at other places as well do so at once.
    rows_of = jnp.zeros((values.size, *rows.shape)).at[optical].set(slopes)[plain]
    each = jnp.eye(values.size)[plain]
    each_local = jnp.eye(local.size).reshape(-1, *local.shape)
    return LocalDerivatives(
        value,
        jax.vmap(lambda dr, dv: push(dr, dv, no_local))(rows_of, each),
        jax.vmap(lambda dt: push(no_rows, no_values, dt))(each_local),
    )


def through_series(local: Float[Any, "... m k"], basis: Float[Any, "... m t"]) -> Float[Any, "... kt"]:
    """Derivatives with respect to the coefficients of the series from those with respect to the throughputs.

    `basis` holds the values of the terms at the sites m; leading axes broadcast. Arrays of numpy stay so.
    """
    xp = jnp if isinstance(local, jax.Array) else np
    spread = xp.einsum("...mk,...mt->...kt", local, basis)
    return spread.reshape(*spread.shape[:-2], -1)


def to_all(
    instrument: Instrument,
    plain: Float[Array, "o ..."],
    local: Float[Array, "l ..."],
    basis: Float[Array, "m t"],
) -> Float[Array, "... n"]:
    """Derivatives with respect to all parameters, in their order; `basis` as in `through_series`."""
    cameras = len(instrument.cameras)
    by_site = jnp.moveaxis(local, 0, -1).reshape(*local.shape[1:], -1, cameras)
    full = jnp.zeros((*plain.shape[1:], values_of(instrument).size))
    full = full.at[..., plain_positions(instrument)].set(jnp.moveaxis(plain, 0, -1))
    return full.at[..., series_positions(instrument)].set(through_series(by_site, basis))

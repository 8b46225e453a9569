"""Residuals and normal equations, built on the structure of the instrument. Pure functions of arrays.

Three layers, each with its own small Jacobian:

1. optics      band rows of a field point, derivatives with respect to the ~10 optical parameters only,
               once per (point, band), however many exposures there are;
2. data        counts and normalised residuals of all exposures of the point: dot products;
3. field       throughput is a series over the field, so at one point only its four values matter; the small
               Gram matrix of the point is expanded through the series afterwards.

Flux           For each (exposure, point) with y = N/σ and a = model/σ over the four cameras, the flux that fits best is
               F = y·a / a·a, and r = y − F a. Its derivative is taken as −F (1 − â âᵀ) da (Kaufman's form of
               variable projection, Golub & Pereyra 2003, Inverse Problems 19, R1): the gradient is exact, and JᵀJ is
               the Fisher information with the flux marginalised. KIND `flux`: F = 1.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from walop_jax.model import legendre, light
from walop_jax.model.compiled import compiled
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.specification import optical_indices, series_indices

Vector = Float[Array, " n"]


class PointData(NamedTuple):
    """Measurements at field points (leading axis p), dense in the exposures; `weight` is 1/σ, 0 where unused."""

    x: Float[Array, " p"]
    y: Float[Array, " p"]
    counts: Float[Array, "p e 4"]
    weight: Float[Array, "p e 4"]
    sky: Float[Array, "p e 2"]
    source: Int[Array, "p e"]
    band: Int[Array, "p e"]


class Normal(NamedTuple):
    """χ², and with respect to all parameters its half gradient Jᵀr and Gauss–Newton matrix JᵀJ."""

    chi2: Float[Array, ""]
    gradient: Vector
    matrix: Float[Array, "n n"]


def eliminate_flux(
    weighted_counts: Float[Array, "e 4"], weighted_model: Float[Array, "e 4"], flux_known: Bool[Array, " e"]
) -> tuple[Float[Array, " e"], Float[Array, "e 4"]]:
    """Best flux of every exposure and the normalised residuals data − model."""
    power = jnp.sum(weighted_model**2, axis=-1)
    best = jnp.sum(weighted_counts * weighted_model, axis=-1) / jnp.where(power > 0, power, 1.0)
    flux = jnp.where(flux_known, 1.0, best)
    return flux, weighted_counts - flux[:, None] * weighted_model


def _point_counts(
    instrument: Instrument,
    plan: Plan,
    rows: Float[Array, "b 2 2 4"],
    throughput: Float[Array, 4],
    point: PointData,
) -> Float[Array, "e 4"]:
    return light.counts(
        instrument, plan, rows, throughput, point.x, point.y, point.sky, point.source, point.band
    )


def _point_prediction(instrument: Instrument, plan: Plan, point: PointData) -> Float[Array, "e 4"]:
    rows = light.band_rows(instrument, plan, point.x, point.y)
    throughput = light.throughput_at(instrument, point.x, point.y)
    return _point_counts(instrument, plan, rows, throughput, point)


def _point_residuals(
    instrument: Instrument, plan: Plan, point: PointData
) -> tuple[Float[Array, " e"], Float[Array, "e 4"]]:
    model = _point_prediction(instrument, plan, point) * point.weight
    return eliminate_flux(point.counts * point.weight, model, plan.exposures.flux_known)


def _point_normal(
    instrument: Instrument, plan: Plan, point: PointData
) -> tuple[Float[Array, ""], Float[Array, " l"], Float[Array, "l l"]]:
    """χ², Jᵀr and JᵀJ of one point in its local quantities: all parameters but the series, then 4 throughputs."""
    values, to_instrument = ravel_pytree(instrument)
    optical = np.asarray(optical_indices(instrument), int)
    plain = np.setdiff1d(np.arange(values.size), series_indices(instrument))
    throughput = light.throughput_at(instrument, point.x, point.y)

    def optics(optical_values: Vector) -> Float[Array, "b 2 2 4"]:
        return light.band_rows(to_instrument(values.at[optical].set(optical_values)), plan, point.x, point.y)

    def data(
        rows: Float[Array, "b 2 2 4"], all_values: Vector, local: Float[Array, 4]
    ) -> Float[Array, "e 4"]:
        return _point_counts(to_instrument(all_values), plan, rows, local, point) * point.weight

    rows, push_optics = jax.linearize(optics, values[optical])
    model, push = jax.linearize(data, rows, values, throughput)
    d_rows = jax.vmap(push_optics)(jnp.eye(optical.size))
    unit = np.eye(values.size)

    # Tangents: plain parameters first (the optical ones carry their rows), then the four throughputs.
    rows_of = jnp.zeros((values.size, *rows.shape)).at[optical].set(d_rows)[plain]
    d_plain = jax.vmap(lambda dr, dv: push(dr, dv, jnp.zeros(4)))(rows_of, jnp.asarray(unit[plain]))
    zero_rows, zero_values = jnp.zeros_like(rows), jnp.zeros_like(values)
    d_local = jax.vmap(lambda dt: push(zero_rows, zero_values, dt))(jnp.eye(4))
    d_model = jnp.concatenate([d_plain, d_local])

    flux, residual = eliminate_flux(point.counts * point.weight, model, plan.exposures.flux_known)
    power = jnp.sum(model**2, axis=-1)
    along = jnp.sum(d_model * model, axis=-1) / jnp.where(power > 0, power, 1.0)
    projected = d_model - jnp.where(plan.exposures.flux_known, 0.0, along)[..., None] * model
    jacobian = (-flux[:, None] * projected).reshape(d_model.shape[0], -1)
    r = residual.reshape(-1)
    return r @ r, jacobian @ r, jacobian @ jacobian.T


def _normal_equations(instrument: Instrument, plan: Plan, data: PointData) -> Normal:
    values, _ = ravel_pytree(instrument)
    series = np.asarray(series_indices(instrument), int)
    plain = np.setdiff1d(np.arange(values.size), series)
    chi2, gradient, gram = jax.vmap(_point_normal, in_axes=(None, None, 0))(instrument, plan, data)
    k = plain.size
    basis = legendre.basis(data.x, data.y, instrument.throughput.degree)
    g = jnp.zeros(values.size).at[plain].set(gradient[:, :k].sum(axis=0))
    g = g.at[series].set(jnp.einsum("ps,pt->st", gradient[:, k:], basis).reshape(-1))
    cross = jnp.einsum("pis,pt->ist", gram[:, :k, k:], basis).reshape(k, -1)
    square = jnp.einsum("psr,pt,pu->stru", gram[:, k:, k:], basis, basis).reshape(series.size, series.size)
    matrix = jnp.zeros((values.size, values.size))
    matrix = matrix.at[np.ix_(plain, plain)].set(gram[:, :k, :k].sum(axis=0))
    matrix = matrix.at[np.ix_(plain, series)].set(cross).at[np.ix_(series, plain)].set(cross.T)
    matrix = matrix.at[np.ix_(series, series)].set(square)
    return Normal(chi2.sum(), g, matrix)


def _residuals(
    instrument: Instrument, plan: Plan, data: PointData
) -> tuple[Float[Array, "p e"], Float[Array, "p e 4"]]:
    return jax.vmap(_point_residuals, in_axes=(None, None, 0))(instrument, plan, data)


def _prediction(instrument: Instrument, plan: Plan, data: PointData) -> Float[Array, "p e 4"]:
    return jax.vmap(_point_prediction, in_axes=(None, None, 0))(instrument, plan, data)


normal_equations = compiled(_normal_equations)
residuals = compiled(_residuals)
prediction = compiled(_prediction)

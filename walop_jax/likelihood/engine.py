"""Residuals and normal equations, built on the structure of the instrument. Pure functions of arrays.

Three layers, each with its own small Jacobian:

1. optics      band rows of a field point, derivatives with respect to the ~10 optical parameters only,
               once per (point, band), however many exposures there are; or from a table of them (`field_table.py`);
2. data        counts and normalised residuals of all exposures of the point: dot products;
3. field       throughput is a series over the field, so at one point only its four values matter; the small
               Gram matrix of the point is expanded through the series afterwards.

Flux           of every (exposure, point) is eliminated (`flux.py`). Where an effect of the detectors D acts, the model
               is D(F a), F follows by Newton steps and ∂D/∂F takes the place of a.
Exposures      are not compressed into sums beforehand, although light is linear in them: with the flux eliminated, such
               sums would hold only near one set of parameter values, on which F and â depend.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.likelihood import limits, optics
from walop_jax.likelihood.field_table import FieldTable
from walop_jax.likelihood.flux import FluxGroups, eliminate_flux, project_flux
from walop_jax.likelihood.optics import KnownOptics, LocalDerivatives, linearised, plain_positions, to_all
from walop_jax.model import light
from walop_jax.model.compiled import array, compiled
from walop_jax.model.instrument import Instrument
from walop_jax.model.light import Counts
from walop_jax.model.parameters import ParameterVector, values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.sources import PointIllumination
from walop_jax.model.specification import series_indices

Flux = Float[Array, "e f"]
Nodes = FieldTable | KnownOptics | None
NEWTON_STEPS = 3  # each squares the fraction of the detectors' distortion that is missing from the flux


class PointData(NamedTuple):
    """Measurements at field points (leading axis p), dense in the exposures (e) and cameras (k).

    `counts` are electrons, `weight` is 1/σ of them, 0 where an intensity is not used. `sky` and `source` as in
    `PointIllumination`; `band` is the band of the exposure at this point (`Plan.band_of`).
    """

    x: Float[Array, " p"]
    y: Float[Array, " p"]
    counts: Float[Array, "p e k"]
    weight: Float[Array, "p e k"]
    sky: Float[Array, "p e 2"]
    source: Int[Array, "p e"]
    band: Int[Array, "p e"]
    opposite_sky: Float[Array, "p e 2"] | None = None  # the sky at (−X, −Y), only where an effect asks for it
    stars: Float[Array, "p e k c"] | None = None  # `FluxGroups.stars`, only where stars of a field scatter

    def illumination(self, plan: Plan) -> PointIllumination:
        """The light that this one point sees in the exposures of a plan."""
        return PointIllumination(plan.exposures, self.sky, self.source, self.x, self.y)


def flux_groups(instrument: Instrument, plan: Plan, point: PointData | None = None) -> FluxGroups:
    """Which intensities of a plan have a flux in common; at a point, which exposures of a star its own q, u."""
    stars = None if point is None else point.stars
    return FluxGroups(instrument.cameras.together, plan.exposures.shared, stars)


class NormalEquations(NamedTuple):
    """χ², and with respect to all parameters its half gradient Jᵀr and Gauss–Newton matrix JᵀJ."""

    chi2: Float[Any, ""]
    gradient: Float[Any, " n"]
    matrix: Float[Any, "n n"]


def field_sites(instrument: Instrument, point: PointData) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Field positions whose optics a point needs: its own and, for ghosts, the opposite one."""
    if light.has_ghosts(instrument):
        return jnp.stack([point.x, -point.x]), jnp.stack([point.y, -point.y])
    return point.x[None], point.y[None]


def rows_at(
    values: ParameterVector, template: Instrument, plan: Plan, point: PointData, nodes: Nodes = None
) -> Float[Array, "m b r 4"]:
    """Band rows (site, band, row, 4) at the sites of a point, for an instrument with `values` as its parameters.

    They carry the slopes of the optics with them when they are differentiated (`optics.band_rows`).
    """
    sites = field_sites(template, point)
    if nodes is None:
        return jax.vmap(optics.band_rows, (None, None, None, 0, 0))(values, template, plan, *sites)
    rows, slopes = nodes if isinstance(nodes, KnownOptics) else nodes(*sites)
    if rows is None:
        there = with_values(template)(jax.lax.stop_gradient(values))
        rows = jax.vmap(light.band_rows, (None, None, 0, 0))(there, plan, *sites)
    index = jnp.asarray(optics.directions(template, plan).index)
    return optics.with_slopes(values, rows, jnp.swapaxes(slopes, 0, 1), index)


def optics_of_points(instrument: Instrument, plan: Plan, data: PointData) -> KnownOptics:
    """Band rows and their derivatives at the sites of all points, one point after the other (p m)."""
    x, y = data.x, data.y
    if light.has_ghosts(instrument):
        x, y = (array(np.stack([at, -np.asarray(at)], axis=1).ravel()) for at in (x, y))
    return optics.known_optics(instrument, plan, x, y)


def _by_point(known: Any, data: PointData) -> Any:
    """Optics of sites one after the other by point (p, m)."""
    return jax.tree.map(lambda leaf: leaf.reshape(len(data.x), -1, *leaf.shape[1:]), known)


def throughput_at(instrument: Instrument, point: PointData) -> Float[Array, "m k"]:
    """Throughputs (site, camera) of the cameras at the sites of a point."""
    return jax.vmap(instrument.throughput.at)(*field_sites(instrument, point))


def unit_counts(
    instrument: Instrument,
    plan: Plan,
    rows: Float[Array, "m b r 4"],
    throughput: Float[Array, "m k"],
    point: PointData,
) -> Counts:
    """Counts (e, k) for light of unit flux, ahead of the detectors, from band rows and throughputs at the sites of a
    point.
    """
    x, y = field_sites(instrument, point)
    illumination = point.illumination(plan)
    counts = light.counts(instrument, rows[0], throughput[0], illumination, point.band)
    if point.opposite_sky is None or len(x) == 1:
        return counts
    illumination = illumination._replace(sky=point.opposite_sky, x=x[1], y=y[1])
    opposite = light.counts(instrument, rows[1], throughput[1], illumination, point.band)
    return light.with_ghosts(instrument, counts, opposite, point.source)


def point_prediction(instrument: Instrument, plan: Plan, point: PointData, nodes: Nodes = None) -> Counts:
    """Counts (e, k) of one point for light of unit flux, ahead of the detectors."""
    rows = rows_at(values_of(instrument), instrument, plan, point, nodes)
    return unit_counts(instrument, plan, rows, throughput_at(instrument, point), point)


def vectors_at(instrument: Instrument, plan: Plan, point: PointData, nodes: Nodes = None) -> light.Vectors:
    """Analysis vectors (band, camera, 4) of a point."""
    rows = rows_at(values_of(instrument), instrument, plan, point, nodes)[0]
    return light.camera_vectors(instrument, rows, throughput_at(instrument, point)[0], point.x, point.y)


def best_flux(instrument: Instrument, plan: Plan, unit: Counts, point: PointData) -> Flux:
    """The flux (e, f) that fits best, in electrons per unit of unpolarised light.

    It comes in closed form, refined by Newton steps where the detectors are not linear in it.
    """
    flux_known, shared = plan.exposures.flux_known, flux_groups(instrument, plan)
    flux, _ = eliminate_flux(point.counts * point.weight, unit * point.weight, flux_known, shared)
    if not light.is_linear(instrument):
        for _ in range(NEWTON_STEPS):
            counts, slope = counts_and_slope(instrument, plan, unit, flux, point)
            missing = (point.counts - counts) * point.weight
            step, _ = eliminate_flux(missing, slope * point.weight, flux_known, shared)
            flux = jnp.where(flux_known[:, None], flux, flux + step)
    return flux


def detected_counts(instrument: Instrument, plan: Plan, unit: Counts, flux: Flux, point: PointData) -> Counts:
    """Counts (e, k) that the detectors report for a flux; `unit` are the counts for light of unit flux."""
    return light.detected(instrument, plan.exposures, flux * unit, point.x, point.y)


def counts_and_slope(
    instrument: Instrument, plan: Plan, unit: Counts, flux: Flux, point: PointData
) -> tuple[Counts, Counts]:
    """Counts (e, k) as `detected_counts` gives them, and their derivative with respect to the flux."""
    return jax.jvp(
        lambda f: detected_counts(instrument, plan, unit, f, point), (flux,), (jnp.ones_like(flux),)
    )


def point_residuals(
    instrument: Instrument, plan: Plan, point: PointData, nodes: Nodes = None
) -> tuple[Flux, Counts]:
    """Best flux (e, f) in every exposure of one point, and normalised residuals (data − model)/σ (e, k)."""
    return residuals_of(instrument, plan, point_prediction(instrument, plan, point, nodes), point)


def residuals_of(instrument: Instrument, plan: Plan, unit: Counts, point: PointData) -> tuple[Flux, Counts]:
    """Best flux (e, f) and normalised residuals (e, k) from the counts for light of unit flux."""
    flux = best_flux(instrument, plan, unit, point)
    residual = (point.counts - detected_counts(instrument, plan, unit, flux, point)) * point.weight
    return flux, flux_groups(instrument, plan, point).independent(residual)


def _linear_unit_counts(
    instrument: Instrument, plan: Plan, point: PointData, nodes: Nodes
) -> LocalDerivatives:
    """Counts (e, k) of one point for light of unit flux, and their derivatives in its local quantities."""
    to_instrument = with_values(instrument)

    def counts(values: ParameterVector, local: Float[Array, "m k"]) -> Counts:
        rows = rows_at(values, instrument, plan, point, nodes)
        return unit_counts(to_instrument(values), plan, rows, local, point)

    return linearised(instrument, counts, throughput_at(instrument, point))


def _star_responses(
    instrument: Instrument, plan: Plan, fields: Float[Array, "f s"], data: PointData
) -> Float[Array, "p e k c"]:
    """Relative change of the counts of a star for 1 rms of q, then of u; `fields` holds the rms, field by field."""
    standard = instrument.standard

    def counts(off: Float[Array, "2 f"], point: PointData) -> Counts:
        moved = instrument.changed("standard", q=standard.q + off[0] @ fields, u=standard.u + off[1] @ fields)
        return point_prediction(moved, plan, point)

    def at(point: PointData) -> Float[Array, "e k c"]:
        neutral = jnp.zeros((2, len(fields)))
        unit, slope = counts(neutral, point)[..., None], jax.jacfwd(counts)(neutral, point)
        return slope.reshape(*unit.shape[:-1], -1) / jnp.where(unit > 0, unit, jnp.inf)

    return jax.vmap(at)(data)


def unit_slopes(instrument: Instrument, plan: Plan, point: PointData) -> tuple[Counts, Float[Array, "e k n"]]:
    """Counts (e, k) of one point for light of unit flux, and their derivatives (e, k, n) in all parameters."""
    unit, plain, local = _linear_unit_counts(instrument, plan, point, None)
    basis = instrument.throughput.basis(*field_sites(instrument, point))
    return unit, to_all(instrument, plain, local, basis)


def _point_jacobian(
    instrument: Instrument, plan: Plan, point: PointData, nodes: Nodes = None
) -> tuple[Float[Array, " d"], Float[Array, "l d"], Flux]:
    """Residuals of one point, their derivatives with respect to its local quantities, and the best flux.

    Local quantities are all parameters but the series, then the throughputs of its sites; d runs over
    exposures and cameras.
    """
    to_instrument = with_values(instrument)
    throughput = throughput_at(instrument, point)
    unit, d_plain, d_local = _linear_unit_counts(instrument, plan, point, nodes)
    # From unit flux to counts: `along` is the derivative with respect to the flux itself.
    flux = best_flux(instrument, plan, unit, point)
    counts, along = flux * unit, unit
    d_counts = flux * jnp.concatenate([d_plain, d_local])
    if not light.is_linear(instrument):
        values = values_of(instrument)
        counts, push_detector = jax.linearize(
            lambda v, n: light.detected(to_instrument(v), plan.exposures, n, point.x, point.y), values, counts
        )
        unit_steps = jnp.eye(values.size)[plain_positions(instrument)]
        all_values = jnp.concatenate([unit_steps, jnp.zeros((throughput.size, values.size))])
        d_counts = jax.vmap(push_detector)(all_values, d_counts)
        along = push_detector(jnp.zeros_like(values), unit)
    shared = flux_groups(instrument, plan, point)
    projected = project_flux(d_counts * point.weight, along * point.weight, plan.exposures.flux_known, shared)
    residual = shared.independent((point.counts - counts) * point.weight)
    return residual.reshape(-1), -projected.reshape(d_counts.shape[0], -1), flux


def normal_equations(
    instrument: Instrument, plan: Plan, data: PointData, nodes: Nodes = None
) -> NormalEquations:
    """χ² and its expansion (`NormalEquations`) from some points.

    With optics on `nodes` the sums are made block by block; without, from the Jacobian of all points at once, which
    comes from a program that errors and verdict need anyway, `limits.BATCH` points at a time.
    """
    if nodes is not None:
        return NormalEquations(*map(np.asarray, _table_equations(instrument, plan, data, nodes)))
    size, chi2, gradient, matrix = values_of(instrument).size, 0.0, 0.0, 0.0
    for start in range(0, len(data.x), limits.BATCH):
        rows = slice(start, start + limits.BATCH)
        few = len(data.x) <= limits.BATCH
        points = data if few else jax.tree.map(lambda leaf, rows=rows: np.asarray(leaf)[rows], data)
        found = linearised_residuals(instrument, plan, points)
        r, jacobian = np.asarray(found.residual).reshape(-1), np.asarray(found.slope).reshape(-1, size)
        chi2, gradient, matrix = chi2 + r @ r, gradient + jacobian.T @ r, matrix + jacobian.T @ jacobian
    return NormalEquations(chi2, gradient, matrix)


def _on_table(instrument: Instrument, plan: Plan, data: PointData, nodes: FieldTable) -> NormalEquations:
    """The normal equations as a sum over blocks of points, whose intermediate results stay in the processor's cache.

    Few points are one block.
    """
    points, block = data.x.shape[0], limits.JACOBIAN_BLOCK
    if points <= block or points % block:
        return block_equations(instrument, plan, data, nodes)
    blocks = jax.tree.map(lambda v: v.reshape(-1, block, *v.shape[1:]), data)
    return summed(lambda part: block_equations(instrument, plan, part, nodes), blocks)


def summed(function: Callable[[Any], Any], parts: Any) -> Any:
    """The sum of what `function` returns for the slices of `parts` along the first axis, one after the other."""
    first = jax.eval_shape(function, jax.tree.map(lambda v: v[0], parts))
    nothing = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), first)

    def add(total: Any, part: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, function(part)), None

    return jax.lax.scan(add, nothing, parts)[0]


def block_equations(
    instrument: Instrument, plan: Plan, data: PointData, nodes: Nodes = None
) -> NormalEquations:
    """The normal equations of some points, each in its local quantities first: far fewer products than of all columns.

    `nodes` that are `KnownOptics` hold the sites of all points, one after the other (`optics_of_points`).
    """
    size, series, plain = values_of(instrument).size, series_indices(instrument), plain_positions(instrument)

    def of_point(
        point: PointData, nodes: Nodes
    ) -> tuple[Float[Array, ""], Float[Array, " l"], Float[Array, "l l"]]:
        """χ², Jᵀr and JᵀJ in its local quantities."""
        r, jacobian, _ = _point_jacobian(instrument, plan, point, nodes)
        return r @ r, jacobian @ r, jacobian @ jacobian.T

    each, nodes = (0, _by_point(nodes, data)) if isinstance(nodes, KnownOptics) else (None, nodes)
    chi2, gradient, gram = jax.vmap(of_point, (0, each))(data, nodes)
    k = plain.size
    basis = instrument.throughput.basis(*jax.vmap(field_sites, (None, 0))(instrument, data))
    g = jnp.zeros(size).at[plain].set(gradient[:, :k].sum(axis=0))
    # Local throughputs are (site, camera); a coefficient of a camera acts at all sites of a point.
    sites = (basis.shape[1], len(instrument.cameras))
    by_site = gradient[:, k:].reshape(-1, *sites)
    g = g.at[series].set(jnp.einsum("pmk,pmt->kt", by_site, basis).reshape(-1))
    by_site = gram[:, :k, k:].reshape(-1, k, *sites)
    cross = jnp.einsum("pimk,pmt->ikt", by_site, basis).reshape(k, -1)
    by_site = gram[:, k:, k:].reshape(-1, *sites, *sites)
    square = jnp.einsum("pmknl,pmt,pnu->ktlu", by_site, basis, basis).reshape(series.size, series.size)
    matrix = jnp.zeros((size, size))
    matrix = matrix.at[np.ix_(plain, plain)].set(gram[:, :k, :k].sum(axis=0))
    matrix = matrix.at[np.ix_(plain, series)].set(cross).at[np.ix_(series, plain)].set(cross.T)
    matrix = matrix.at[np.ix_(series, series)].set(square)
    return NormalEquations(chi2.sum(), g, matrix)


def _residuals(
    instrument: Instrument, plan: Plan, data: PointData, nodes: Nodes = None
) -> tuple[Float[Array, "p e f"], Float[Array, "p e k"]]:
    return jax.vmap(point_residuals, in_axes=(None, None, 0, None))(instrument, plan, data, nodes)


class Linearised(NamedTuple):
    """Residuals of points and their derivatives in all parameters, and the best fluxes; d: exposures, then cameras."""

    residual: Float[Any, "p d"]
    slope: Float[Any, "p d n"]
    flux: Float[Any, "p e f"]


def residuals_and_slopes(
    instrument: Instrument, plan: Plan, data: PointData, known: KnownOptics | None = None
) -> Linearised:
    """All residuals, their derivatives, and the best fluxes; `known` are those of `optics_of_points`."""
    each, known = (None, None) if known is None else (0, _by_point(known, data))
    residual, local, flux = jax.vmap(_point_jacobian, (None, None, 0, each))(instrument, plan, data, known)
    basis = instrument.throughput.basis(*jax.vmap(field_sites, (None, 0))(instrument, data))
    count = plain_positions(instrument).size
    spread = jax.vmap(lambda columns, at: to_all(instrument, columns[:count], columns[count:], at))
    return Linearised(residual, spread(local, basis), flux)


def linearised_residuals(instrument: Instrument, plan: Plan, data: PointData) -> Linearised:
    """`residuals_and_slopes` by two programs: of the optics (`optics.known_optics`), and of all that is behind them."""
    return _linearised_residuals(instrument, plan, data, optics_of_points(instrument, plan, data))


def _incoming(instrument: Instrument, plan: Plan, point: PointData) -> Float[Array, "e 4"]:
    return light.stokes(instrument, point.illumination(plan))


incoming = compiled(jax.vmap(_incoming, (None, None, 0)), kept_as="incoming")
"""Stokes vectors that enter the collimator."""
_table_equations = compiled(_on_table, kept_as="table_equations")
_linearised_residuals = compiled(
    residuals_and_slopes, optimised_above=limits.OFTEN_OPTIMISED_ABOVE, kept_as="linearised_residuals"
)
star_responses = compiled(_star_responses, kept_as="star_responses")
residuals = compiled(_residuals, optimised_above=limits.OPTIMISED_ABOVE, kept_as="residuals")
prediction = compiled(
    jax.vmap(point_prediction, (None, None, 0)), optimised_above=limits.OPTIMISED_ABOVE, kept_as="prediction"
)
"""Counts for light of unit flux; `detected` takes electrons, flux × these, through the detectors."""
detected = compiled(jax.vmap(light.detected, (None, None, 0, 0, 0)), kept_as="detected")

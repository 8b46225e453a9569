"""Residuals of the smooth model of the instrument matrix, cell by cell of the field: a map of superpixels.

Quantities  In a cell of the field, at one optical setting, δm (three elements for each arm) is added to the instrument
            matrix and the throughput of the cameras of every arm but the first is multiplied by 1 + ρ. To first order,
            with light S, flux F, analysis vectors v_k and T the response of the two cameras of an arm to unpolarised
            light,
                δN_k = ± ½ F T (δm · S) in the two cameras of an arm,   δN_k = ρ F v_k · S in those of a later one.
Estimate    weighted least squares over the exposures and points of the cell, the flux of each exposure eliminated:
            (Σ A P Aᵀ) δ = Σ A r, with r the normalised residuals, A = δN/σ and P the projection off the flux.
            Its covariance is the inverse of the sum. A cell has few numbers of the millions of the smooth model's
            data, so the part of a cell that the fit absorbs is left out of account.
Limit       no structure smaller than the smooth model's: δ scatters about 0 with its standard errors.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.calibration.matrix import ResidualMap, residual_names
from walop_jax.data.cells import ORDER
from walop_jax.data.grid import Grid
from walop_jax.data.settings import Settings
from walop_jax.fit.refit import FitResult
from walop_jax.io.shapes import Vector
from walop_jax.likelihood import engine, limits
from walop_jax.likelihood.field_table import FieldTable
from walop_jax.likelihood.flux import project_flux
from walop_jax.likelihood.likelihood import Expansion, Likelihood, UsedData
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan

POINTS_PER_CELL = 64
"""Field points of a cell of the residual map: its errors are an eighth of those of a point."""

MOST_CELLS = 128
"""Cells of the residual map along a side at most."""


def _changes(
    vectors: Float[Any, "n k 4"], stokes: Float[Any, "n 4"], unit: Float[Any, "n k"], pairs: Sequence[Any]
) -> Float[Any, "n d k"]:
    """Counts that a change of each quantity of the map adds for light of unit flux."""
    first, second = np.array(pairs).T
    # One row of signs for each arm: first camera minus second.
    signs = np.eye(unit.shape[1])[first] - np.eye(unit.shape[1])[second]
    total = vectors[:, first, 0] + vectors[:, second, 0]
    elements = 0.5 * jnp.einsum("na,ns,ak->nask", total, stokes[:, :3], signs)
    later = unit[:, None] * np.abs(signs[1:])
    return jnp.concatenate([elements.reshape(len(unit), -1, unit.shape[1]), later], axis=1)


def _point_sums(
    instrument: Instrument,
    plan: Plan,
    chosen: Bool[Array, " e"],
    nodes: FieldTable | None,
    point: engine.PointData,
) -> Float[Array, " n"]:
    flux, residual = engine.point_residuals(instrument, plan, point, nodes)
    unit = engine.point_prediction(instrument, plan, point, nodes)
    vectors = engine.vectors_at(instrument, plan, point, nodes)[point.band]
    stokes = light.stokes(instrument, point.illumination(plan))
    weight = point.weight * chosen[:, None]
    change = _changes(vectors, stokes, unit, instrument.cameras.pairs) * (flux * weight)[:, None]
    fixed, shared = plan.exposures.flux_known, engine.flux_groups(instrument, plan, point)
    change = jnp.moveaxis(change, 1, 0)  # exposures next to cameras
    change = jnp.moveaxis(project_flux(change, unit * weight, fixed, shared), 0, 1)
    measured = (point.weight[:, 0] > 0) & chosen
    degrees = unit.shape[-1] - jnp.where(fixed, 0.0, instrument.cameras.fluxes)
    freedom = jnp.sum(jnp.where(measured, degrees, 0.0))
    chi2 = jnp.sum(jnp.where(chosen[:, None], residual, 0.0) ** 2)
    right = jnp.einsum("edk,ek->d", change, residual)
    matrix = jnp.einsum("edk,efk->df", change, change)[np.triu_indices(len(right))]
    return jnp.concatenate([jnp.stack([chi2, freedom]), right, matrix])


@compiled
def _sums(*given: Any) -> Float[Array, "p n"]:
    """`_point_sums` of the points of a batch, which come last."""
    return jax.lax.map(
        functools.partial(_point_sums, *given[:-1]), given[-1], batch_size=limits.JACOBIAN_BLOCK
    )


def cells_for(points: int, used_data: UsedData, points_per_cell: int = POINTS_PER_CELL) -> Grid:
    """A grid of nearly square cells over the used part of the field, with at least `points_per_cell` points in each."""
    low_x, high_x, low_y, high_y = used_data.field
    side = int(np.clip(np.sqrt(points / points_per_cell), 1, MOST_CELLS))
    width, height = (high_x - low_x) / side or 1.0, (high_y - low_y) / side or 1.0
    return Grid(side, side, (0.5, 0.5), (low_x, low_y), ((width, 0.0), (0.0, height)))


def cell_of(grid: Grid, x: Vector, y: Vector) -> Int[np.ndarray, " p"]:
    """Number of the cell, along the rows, that a field position (deg) lies in; positions beyond go to the nearest."""
    (width, _), (_, height) = grid.matrix
    column = np.clip(((x - grid.value[0]) / width).astype(int), 0, grid.width - 1)
    row = np.clip(((y - grid.value[1]) / height).astype(int), 0, grid.height - 1)
    return row * grid.width + column


def _main_setting(
    settings: Settings, through: Bool[np.ndarray, " e"]
) -> tuple[Settings, Bool[np.ndarray, " e"]]:
    """The setting that most exposures `through` the polariser have, if possible with all other elements out; and its
    exposures.
    """

    def preferred(layout: tuple[Settings, Int[np.ndarray, " r"]]) -> tuple[object, ...]:
        setting, rows = layout
        angles = (float(np.nan_to_num(angle[0], nan=-np.inf)) for angle in setting.positions.values())
        return (-int(through[rows].sum()), *angles, str(setting.filter[0]))

    setting, rows = min(settings.layouts(), key=preferred)
    return setting, np.isin(np.arange(len(settings)), rows)


def residual_map(result: FitResult) -> ResidualMap:
    """The map of the residuals of a fit, by one more pass over the points.

    >>> walop.residual_map(result).excess()["m21"]  # doctest: +SKIP
    """
    return residual_map_at(result.likelihood, result.values, result.expansion)


def residual_map_at(likelihood: Likelihood, values: Vector, near: Expansion | None = None) -> ResidualMap:
    """The map of `residual_map` at any full vector of values (n); `near` is an expansion at similar values."""
    instrument = likelihood.model.instrument(values)
    nodes, _ = likelihood.nodes(instrument, near)
    exposures = likelihood.calset.exposures
    setting, chosen = _main_setting(Settings.of(exposures, likelihood.plan.moving), exposures.clp_in)
    # The points of whole frames stand for many pixels: the points of one block of pixels are a cell.
    points_per_cell = ORDER**2 if likelihood.calset.fine is not None else POINTS_PER_CELL
    used_data = likelihood.used_data if near is None else near.used_data
    grid = cells_for(likelihood.layout.points, used_data, points_per_cell)
    count = grid.pixels

    def work(number: int) -> Vector:
        batches = likelihood.points.part(number)
        cell = np.concatenate([cell_of(grid, np.asarray(batch.x), np.asarray(batch.y)) for batch in batches])
        # Padded points carry no weight, hence zeros.
        columns = [_sums(instrument, likelihood.plan, jnp.asarray(chosen), nodes, c) for c in batches]
        sums = [np.bincount(cell, column, count) for column in np.concatenate(columns).T]
        return np.concatenate(sums)

    layout = likelihood.layout
    parts = likelihood.runner.each("residual map", work, layout.points, layout.part)
    total = functools.reduce(np.add, parts).reshape(-1, count)
    n = len(residual_names(len(instrument.cameras.pairs)))
    matrices = np.zeros((count, n, n))
    i, j = np.triu_indices(n)
    matrices[:, i, j] = matrices[:, j, i] = total[2 + n :].T
    return _solved_map(grid, setting, total[0], total[1], total[2 : 2 + n], matrices)


def _solved_map(
    grid: Grid,
    setting: Settings,
    chi2: Float[np.ndarray, " c"],
    freedom: Float[np.ndarray, " c"],
    right: Float[np.ndarray, "d c"],
    matrix: Float[np.ndarray, "c d d"],
) -> ResidualMap:
    """The map on a grid of cells at one setting, from Σ A r and Σ A P Aᵀ of each; NaN where these are singular."""
    size = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2))
    scaled = matrix / np.where(size > 0, size, 1.0)[:, :, None] / np.where(size > 0, size, 1.0)[:, None]
    regular = np.linalg.eigvalsh(scaled)[:, 0] > 1e-9
    inverse = np.full(matrix.shape, np.nan)
    inverse[regular] = np.linalg.inv(matrix[regular])
    solution = np.einsum("cij,jc->ic", inverse, right)
    errors = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)).T
    shape = (len(right), grid.height, grid.width)
    return ResidualMap(
        grid=grid,
        filter=str(setting.filter[0]),
        values=solution.reshape(shape),
        errors=errors.reshape(shape),
        chi2=(chi2 / np.where(freedom > 0, freedom, np.nan)).reshape(shape[1:]),
        positions=setting.inside(),
    )

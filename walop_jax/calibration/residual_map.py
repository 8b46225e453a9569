"""What the smooth model leaves of the instrument matrix, cell by cell of the field: a map of superpixels.

Quantities  In a cell of the field, at one optical setting, δm21 … δm33 are added to the instrument matrix and the
            throughput of cameras N2, N3 is multiplied by 1 + ρ. To first order, with light S, flux F, analysis vectors
            v_k and T the pair's response to unpolarised light,
                δN_k = ± ½ F T (δm · S) in a pair of cameras,   δN_k = ρ F v_k · S in N2, N3.
Estimate    weighted least squares over the exposures and points of the cell, the flux of each exposure eliminated:
            (Σ A P Aᵀ) δ = Σ A r, with r the normalised residuals, A = δN/σ and P what is left beside the flux.
            Its covariance is the inverse of the sum. A cell has seven numbers of the millions of the smooth model's
            data, so what the fit takes out of a cell is left out of account.
Limit       no structure smaller than the smooth model's: δ scatters about 0 with its standard errors.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.calibration.records import ResidualMap, residual_names
from walop_jax.data.frames import Grid
from walop_jax.data.records import Exposures
from walop_jax.fit.refit import FitResult
from walop_jax.likelihood import engine, limits
from walop_jax.likelihood.expansion import Census, Posterior
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.nodes import Nodes
from walop_jax.likelihood.runner import SlabSums
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan

Vector = Float[np.ndarray, " n"]

_QUANTITIES = residual_names(2)
_UPPER = np.triu_indices(len(_QUANTITIES))
_NUMBERS = 2 + len(_QUANTITIES) + len(_UPPER[0])  # χ², degrees of freedom, Σ A r, upper half of Σ A P Aᵀ


def _point_sums(
    instrument: Instrument,
    plan: Plan,
    chosen: Bool[Array, " e"],
    point: engine.PointData,
    nodes: Nodes | None,
) -> Float[Array, " n"]:
    flux, residual = engine.point_residuals(instrument, plan, point, nodes)
    unit = engine.point_prediction(instrument, plan, point, nodes)
    vectors = engine.vectors_at(instrument, plan, point, nodes)[point.band]
    stokes = light.stokes(instrument, plan.exposures, point.sky, point.source, point.x, point.y)[:, :3]
    first, second = (vectors[:, k, 0] + vectors[:, k + 1, 0] for k in (0, 2))
    signs = jnp.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    pairs = [
        0.5 * total[:, None, None] * stokes[:, :, None] * sign
        for total, sign in zip((first, second), signs, strict=True)
    ]
    ratio = (unit * jnp.array([0.0, 0.0, 1.0, 1.0]))[:, None]
    weight = point.weight * chosen[:, None]
    change = jnp.concatenate([*pairs, ratio], axis=1) * (flux[:, None] * weight)[:, None]
    along = unit * weight
    power = jnp.sum(along**2, axis=-1)
    share = jnp.einsum("edk,ek->ed", change, along) / jnp.where(power > 0, power, 1.0)[:, None]
    known = plan.exposures.flux_known
    change = change - jnp.where(known, 0.0, 1.0)[:, None, None] * share[..., None] * along[:, None]
    seen = (point.weight[:, 0] > 0) & chosen
    freedom = jnp.sum(jnp.where(seen, jnp.where(known, 4.0, 3.0), 0.0))
    chi2 = jnp.sum(jnp.where(chosen[:, None], residual, 0.0) ** 2)
    right = jnp.einsum("edk,ek->d", change, residual)
    left = jnp.einsum("edk,efk->df", change, change)[_UPPER]
    return jnp.concatenate([jnp.stack([chi2, freedom]), right, left])


def _chunk_sums(
    instrument: Instrument, plan: Plan, chosen: Bool[Array, " e"], data: engine.PointData, nodes: Nodes | None
) -> Float[Array, "p n"]:
    return jax.lax.map(
        lambda point: _point_sums(instrument, plan, chosen, point, nodes),
        data,
        batch_size=limits.JACOBIAN_BLOCK,
    )


_sums = compiled(_chunk_sums)


def cells_for(points: int, census: Census) -> Grid:
    """A grid of square-ish cells over the used part of the field: `limits.POINTS_PER_CELL` points in each, or more."""
    low_x, high_x, low_y, high_y = census.field
    side = int(np.clip(np.sqrt(points / limits.POINTS_PER_CELL), 1, limits.MOST_CELLS))
    width, height = (high_x - low_x) / side, (high_y - low_y) / side
    return Grid(
        side, side, (0.5, 0.5), (low_x, low_y), ((width or 1.0, 0.0), (0.0, height or 1.0))
    )  # fmt: skip


def cell_of(grid: Grid, x: Vector, y: Vector) -> Int[np.ndarray, " p"]:
    """Number of the cell, along the rows, that a field position (deg) lies in; positions beyond go to the nearest."""
    (width, _), (_, height) = grid.matrix
    column = np.clip(((x - grid.value[0]) / width).astype(int), 0, grid.width - 1)
    row = np.clip(((y - grid.value[1]) / height).astype(int), 0, grid.height - 1)
    return row * grid.width + column


def _main_setting(e: Exposures) -> tuple[str, float, Bool[np.ndarray, " e"]]:
    """The setting with the most polariser exposures, plate out preferred, and its exposures."""
    angle = np.where(e.chwp_in, e.chwp_angle, -np.inf)
    settings = sorted(
        set(zip(e.filter.tolist(), angle.tolist(), strict=True)), key=lambda setting: setting[1]
    )
    exposures = {setting: (e.filter == setting[0]) & (angle == setting[1]) for setting in settings}
    name, at = max(settings, key=lambda setting: int(np.sum(exposures[setting] & e.clp_in)))
    return name, at if np.isfinite(at) else np.nan, exposures[name, at]


def residual_map(result: FitResult) -> ResidualMap:
    """The map of what a fit leaves: one more pass over the points."""
    return residual_map_at(result.likelihood, result.values, result.posterior)


def residual_map_at(likelihood: Likelihood, values: Vector, near: Posterior | None = None) -> ResidualMap:
    """As `residual_map`, at any full vector of parameter values; `near` is an expansion at similar ones."""
    instrument = likelihood.model.instrument(values)
    nodes, _ = likelihood.nodes(instrument, near)
    filter_name, chwp_angle, chosen = _main_setting(likelihood.calset.exposures)
    grid = cells_for(likelihood.layout.points, likelihood.census if near is None else near.census)
    count = grid.width * grid.height

    def work(number: int) -> SlabSums:
        chunks = likelihood.points.slab(number)
        cell = np.concatenate([cell_of(grid, np.asarray(chunk.x), np.asarray(chunk.y)) for chunk in chunks])
        # Padded points carry no weight, hence zeros.
        columns = [
            np.asarray(_sums(instrument, likelihood.plan, jnp.asarray(chosen), c, nodes)) for c in chunks
        ]
        sums = [np.bincount(cell, column, count) for column in np.concatenate(columns).T]
        return SlabSums(np.concatenate(sums), np.zeros(4))

    total = likelihood.runner.total("residual map", None, work, likelihood.layout)
    total = total.sums.reshape(_NUMBERS, count)
    n = len(_QUANTITIES)
    matrix = np.zeros((count, n, n))
    matrix[:, _UPPER[0], _UPPER[1]] = matrix[:, _UPPER[1], _UPPER[0]] = total[2 + n :].T
    size = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2))
    scaled = matrix / np.where(size > 0, size, 1.0)[:, :, None] / np.where(size > 0, size, 1.0)[:, None]
    known = np.linalg.eigvalsh(scaled)[:, 0] > 1e-9
    inverse = np.full((count, n, n), np.nan)
    inverse[known] = np.linalg.inv(matrix[known])
    found = np.einsum("cij,jc->ic", inverse, total[2 : 2 + n])
    errors = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)).T
    shape = (grid.height, grid.width)
    return ResidualMap(
        grid=grid,
        filter=filter_name,
        chwp_angle=chwp_angle,
        values=found.reshape(n, *shape),
        errors=errors.reshape(n, *shape),
        chi2=(total[0] / np.where(total[1] > 0, total[1], np.nan)).reshape(shape),
    )

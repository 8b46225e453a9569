"""A pass over all pixels of whole frames: the counts for light of unit flux as a series, then sums cell by cell.

Frames see a source that shines everywhere, so the counts for light of unit flux, u, are smooth over the field: all
optics, sources and cameras there are, in one series of Chebyshev polynomials for each exposure and camera. With w = 1/σ
and the best flux F of every exposure of a pixel (`flux.py`), the information of a pixel on a change δ of u is

    χ²(δ) = Σ r² − 2 g · δ + δᵀ K δ,    r = w (N − F u),   g = F w r,   K = F² (w² − w²u uᵀw² / Σ w²u²)

Kept of a cell are Σ F²w² (from which K is made), Σ g, the flux, χ² and the number of pixels, for each exposure; of a
strip the moments Σ g T_i T_j with the polynomials T of the series. Derivatives J of u with respect to any parameter
are smooth too, so that these sums stand for the pixels: with ℓ_i the Lagrange polynomials of n × n Chebyshev nodes,
half of the gradient of χ² and of its Gauss–Newton matrix are

    −Σ_p J(x_p)ᵀ g_p = −Σ_i J(x_i)ᵀ g_i,               g_i = Σ_p ℓ_i(x_p) g_p,
    Σ_p J(x_p)ᵀ K_p J(x_p) = Σ_i J(x_i)ᵀ K_i J(x_i),   K_i = Σ_p ℓ_i(x_p) K_p,

for J that are polynomials of degree n − 1, or half of it.

Limits      Detectors that report counts as they are, so that N is linear in F. K is made from Σ F²w² of cells and u in
            their middle, which leaves out what falls with the fourth power of their side (Richardson 1911): some 10⁻⁴
            of a standard error in its size.
Source      Trefethen 2013, Approximation Theory and Approximation Practice, ch. 2–5 (interpolation on such nodes).

Cells and series lie in the coordinates of the frame, from −1 to 1 between the edges of the outermost pixels of each
side; the map from there to the field is linear (`Grid`). A pixel takes about a microsecond of a core.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.frames import FrameIntensities, RawRows, RowReader, float64
from walop_jax.data.grid import Grid
from walop_jax.data.merge import frames_among, without_frames
from walop_jax.data.records import Block
from walop_jax.data.table_intensities import NEGATIVE
from walop_jax.likelihood import engine, limits
from walop_jax.likelihood.field_table import TOLERANCE, FieldTable, accurate_table, details_of, in_batches
from walop_jax.likelihood.likelihood import Census, DataTerms, Expansion, Likelihood, Matrix, OpticsUsed
from walop_jax.model import chebyshev, light
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import compiled
from walop_jax.model.instrument import Instrument

Vector = Float[np.ndarray, " n"]
FRAME = Rectangle(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))


# ------------------------------------------------------------------------------- sums over pixels, cell by cell


class CellSums(NamedTuple):
    """Sums over the pixels of each cell (row, column), for every exposure and camera.

    `weight` is Σ F²/σ², `pull` Σ F (N − F u)/σ², `power` Σ F³ Σ_k u²/σ².
    """

    weight: Float[Any, "k e r c"]
    pull: Float[Any, "k e r c"]
    power: Float[Any, "e r c"]
    chi2: Float[Any, "e r c"]
    used: Float[Any, "e r c"]


class StripSums(NamedTuple):
    """Contribution of a strip of image rows; `moments` are Σ g T_i T_j, `impossible` counts errors not above zero."""

    cells: CellSums
    moments: Float[Array, "j i k e"]
    impossible: Int[Array, ""]


def _terms(
    unit: Float[Array, "k e w"],
    counts: Float[Array, "k e w"],
    sigma: Float[Array, "k e w"],
    open_: Bool[Array, "e w"],
    flux_known: Bool[Array, " e"],
    together: Float[Array, "k k"] | None,
    floor: Float[Array, ""],
) -> tuple[CellSums, Int[Array, " w"]]:
    """The terms of the pixels of a piece of an image row, each a cell by itself, and those with impossible errors."""

    def summed(values: Float[Array, "k e w"]) -> Float[Array, "f e w"]:
        if together is None:
            return values.sum(axis=0, keepdims=True)
        return jnp.einsum("kew,kl->lew", values, together)

    finite = jnp.isfinite(counts) & jnp.isfinite(sigma)
    wrong = open_ & jnp.any(jnp.isfinite(sigma) & (sigma <= 0), axis=0)
    used = open_ & ~wrong & jnp.all(finite & (counts >= -NEGATIVE * sigma), axis=0)
    counts = jnp.where(used, counts, 0.0)
    sigma = jnp.maximum(sigma, floor * counts.mean(axis=0))  # as `model.cameras.with_floor`
    weight = jnp.where(used, 1.0 / jnp.where(used, sigma, 1.0) ** 2, 0.0)
    light = unit * weight
    power = summed(light * unit)
    flux = jnp.where(flux_known[:, None], 1.0, summed(light * counts) / jnp.where(power > 0, power, 1.0))
    residual = counts - flux * unit
    scaled = flux * weight
    pull = scaled * residual
    sums = CellSums(
        weight=flux * scaled,
        pull=pull,
        power=jnp.sum(flux**3 * light * unit, axis=0),
        chi2=jnp.sum(weight * residual**2, axis=0),
        used=used.astype(float),
    )
    return sums, jnp.sum(wrong, axis=0)


def _strip_sums(
    rows: RawRows,
    series: Float[Array, "j i k e"],
    across: Float[Array, "i w"],
    along: Float[Array, "h j"],
    side: Float[Array, " c"],
    flux_known: Bool[Array, " e"],
    together: Float[Array, "k k"] | None,
    floor: Float[Array, ""],
) -> StripSums:
    cameras, exposures, height, width = rows.counts.shape
    cell, piece = side.size, piece_of(side.size)
    by_row = jnp.einsum("hj,jike->hkei", along, series).reshape(height, cameras * exposures, -1)

    def terms_at(row: Int[Array, ""], start: Int[Array, ""]) -> tuple[CellSums, Int[Array, " w"]]:
        def cut(array: Array) -> Array:
            return jax.lax.dynamic_slice(array, (0, 0, row, start), (*array.shape[:2], 1, piece))[:, :, 0]

        polynomials = jax.lax.dynamic_slice_in_dim(across, start, piece, axis=1)
        open_ = jax.lax.dynamic_slice(rows.open, (0, row, start), (exposures, 1, piece))[:, 0]
        unit = (by_row[row] @ polynomials).reshape(cameras, exposures, piece)
        counts, sigma = (float64(cut(values)) for values in (rows.counts, rows.sigma))
        return _terms(unit, counts, sigma, open_, flux_known, together, floor)

    def one_piece(first: Int[Array, ""], start: Int[Array, ""]) -> StripSums:
        polynomials = jax.lax.dynamic_slice_in_dim(across, start, piece, axis=1)

        def add(sums: tuple[Any, Float[Array, "j m i"]], row: Int[Array, ""]) -> tuple[Any, None]:
            terms = terms_at(row, start)
            moments = along[row][:, None, None] * (terms[0].pull.reshape(-1, piece) @ polynomials.T)
            return (jax.tree.map(jnp.add, sums[0], terms), sums[1] + moments), None

        terms = jax.eval_shape(terms_at, first, start)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), terms)
        no_moments = jnp.zeros((along.shape[1], cameras * exposures, len(across)))
        ((sums, impossible), moments), _ = jax.lax.scan(add, (nothing, no_moments), first + jnp.arange(cell))

        def cells(values: Float[Array, "... w"]) -> Float[Array, "... c"]:
            return values.reshape(*values.shape[:-1], piece // cell, cell).sum(axis=-1)

        return StripSums(jax.tree.map(cells, sums), moments, impossible.sum())

    def cell_row(first: Int[Array, ""]) -> StripSums:
        pieces = jax.lax.map(lambda start: one_piece(first, start), jnp.arange(0, width, piece))
        joined = jax.tree.map(lambda v: jnp.moveaxis(v, 0, -2).reshape(*v.shape[1:-1], -1), pieces.cells)
        return StripSums(joined, pieces.moments.sum(axis=0), pieces.impossible.sum())

    cell_rows = jax.lax.map(cell_row, jnp.arange(0, height, cell))
    moments = jnp.swapaxes(cell_rows.moments.sum(axis=0), 1, 2)
    return StripSums(
        jax.tree.map(lambda v: jnp.moveaxis(v, 0, -2), cell_rows.cells),
        moments.reshape(*moments.shape[:2], cameras, exposures),
        cell_rows.impossible.sum(),
    )


strip_sums = compiled(_strip_sums, fuse=True)
"""Sums over a strip of image rows.

`series` are the coefficients of the counts for light of unit flux; `across` and `along` the polynomials at the columns
and rows; `side` has as many entries as a cell has columns and rows; `known` says in which exposures the flux is one;
`together` which cameras have a flux in common (`Cameras.together`), `floor` the smallest error as a share of the light
(`Cameras.floor`). Columns come in whole pieces (`piece_of`), rows in whole cells.
"""


def piece_of(cell: int) -> int:
    """Columns that are worked on together: whole cells."""
    return cell * max(1, limits.COLUMNS // cell)


# --------------------------------------------------------------------------------------- a pass over the frames


@dataclasses.dataclass(frozen=True)
class Cells:
    """Division of frames into square cells of `side` pixels, those at the far ends partly beyond the frame."""

    grid: Grid
    side: int

    @classmethod
    def of(cls, grid: Grid) -> Cells:
        """At most `limits.CELLS` along the longer side."""
        return cls(grid, -(-max(grid.width, grid.height) // limits.CELLS))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return -(-self.grid.height // self.side), -(-self.grid.width // self.side)

    @property
    def size(self) -> Float[np.ndarray, 2]:
        """Width and height of a pixel in the coordinates of the frame."""
        return 2.0 / np.array([self.grid.width, self.grid.height])

    def edges(self, together: int = 1) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " r"]]:
        """Edges of the columns and rows of cells, or of blocks of `together` × `together` of them, within the frame."""
        rows, columns = self.shape
        counts = ((columns, self.grid.width), (rows, self.grid.height))
        s, t = (
            np.minimum(np.append(np.arange(0, n, together), n) * self.side, pixels) / pixels * 2.0 - 1.0
            for n, pixels in counts
        )
        return s, t

    def middles(self, together: int = 1) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " r"]]:
        """Middles of the columns and rows of cells, or of blocks of them."""
        s, t = (0.5 * (edges[:-1] + edges[1:]) for edges in self.edges(together))
        return s, t

    def blocks(self, together: int, shape: tuple[int, int]) -> Grid:
        """Blocks of `together` × `together` cells as a grid of rows and columns."""
        step = together * self.side
        first = (self.grid.reference[0] - 0.5) / step + 0.5, (self.grid.reference[1] - 0.5) / step + 0.5
        (a, b), (c, d) = self.grid.matrix
        return Grid(shape[1], shape[0], first, self.grid.value, ((a * step, b * step), (c * step, d * step)))

    def field(self, s: Any, t: Any) -> tuple[Any, Any]:
        """Field coordinates (deg) of places in the frame."""
        (a, b), (c, d) = self.grid.matrix
        i = (s + 1.0) * 0.5 * self.grid.width + 0.5 - self.grid.reference[0]
        j = (t + 1.0) * 0.5 * self.grid.height + 0.5 - self.grid.reference[1]
        return self.grid.value[0] + (a * i + b * j), self.grid.value[1] + (c * i + d * j)

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Place in the frame of field coordinates (deg): the inverse of `field`."""
        i, j = (
            np.linalg.solve(self.grid.matrix, np.subtract((x, y), self.grid.value))
            + self.grid.reference
            - 0.5
        )
        return float(2.0 * i / self.grid.width - 1.0), float(2.0 * j / self.grid.height - 1.0)


class Smooth(NamedTuple):
    """Smooth quantities of the frame: counts for light of unit flux, analysis vectors, Stokes vectors."""

    unit: Any
    vectors: Any
    stokes: Any


def _smooth(instrument: Instrument, plan: Any, point: engine.PointData) -> Smooth:
    return Smooth(
        unit=engine.point_prediction(instrument, plan, point).T,
        vectors=engine.vectors_at(instrument, plan, point),
        stokes=light.stokes(instrument, point.sight(plan)),
    )


_solve = compiled(jax.vmap(_smooth, in_axes=(None, None, 0)))
_slopes = compiled(jax.vmap(engine.unit_slopes, in_axes=(None, None, 0)))


def unit_slopes_at(
    likelihood: Likelihood, instrument: Instrument, x: Vector, y: Vector
) -> Float[np.ndarray, "p e k a"]:
    """Derivatives of the counts for light of unit flux with respect to all parameters, at field positions (deg)."""
    return _at(_slopes, likelihood, instrument, x, y)[1]


def _at(solve: Any, likelihood: Likelihood, instrument: Instrument, x: Vector, y: Vector) -> Any:
    """Results of a program at field positions (deg): exact. First axis: positions."""

    def solved(x: Vector, y: Vector) -> Any:
        # Points with counts and errors of one in every exposure.
        shape = (len(x), len(likelihood.flux_known))
        ones = np.ones((*shape, likelihood.cameras))
        block = Block(x, y, ones, ones, np.ones(shape, bool), np.full(shape, -1))
        return solve(instrument, likelihood.plan, likelihood.points.reader.point_data(block))

    return in_batches(solved, x, y)


@dataclasses.dataclass(frozen=True)
class FrameSums:
    """Sums over the pixels of a set, for each cell, at some values of the parameters, and the smooth quantities there.

    The sums run over one strip of image rows in `every`.
    """

    likelihood: Likelihood
    values: Vector
    cells: Cells
    sums: CellSums
    moments: Float[np.ndarray, "j i k e"]
    every: int
    smooth: FieldTable
    optics: OpticsUsed

    @cached_property
    def instrument(self) -> Instrument:
        """The instrument with the values."""
        return self.likelihood.model.instrument(self.values)

    def unit(self, together: int = 1) -> Float[np.ndarray, "k e r c"]:
        """Counts for light of unit flux in the middle of the cells, or of blocks of them."""
        s, t = np.meshgrid(*self.cells.middles(together))
        return np.moveaxis(np.asarray(self.smooth(s, t).unit), (0, 1), (2, 3))

    @property
    def chi2(self) -> float:
        """χ² of all pixels."""
        return float(self.sums.chi2.sum())

    @property
    def census(self) -> Census:
        """Pixels used in each exposure, and the part of the field in which any are."""
        used = self.sums.used
        any_used = used.sum(axis=0) > 0
        half = 0.5 * self.cells.size
        s, t = (
            np.stack([edges[:-1] + inner, edges[1:] - inner])
            for edges, inner in zip(self.cells.edges(), half, strict=True)
        )
        corners = [self.cells.field(s[i][None, :], t[j][:, None]) for i in (0, 1) for j in (0, 1)]
        x, y = (np.stack([corner[i] for corner in corners])[:, any_used] for i in (0, 1))
        extent = (x.min(), x.max(), y.min(), y.max()) if any_used.any() else (np.nan,) * 4
        low_x, high_x, low_y, high_y = (float(value) for value in extent)
        rows = used.sum(axis=(1, 2)).round().astype(int)
        return Census(rows, (low_x, high_x, low_y, high_y), self.likelihood.cameras)


def _frames(likelihood: Likelihood) -> tuple[FrameIntensities, Int[np.ndarray, " r"]]:
    """The frames of a set that has some, and the exposures (positions) that they hold."""
    selection = frames_among(likelihood.calset)
    assert selection is not None
    return selection


def strips_of(likelihood: Likelihood) -> int:
    """Number of strips of image rows in one pass over the frames of a set."""
    cells = Cells.of(_frames(likelihood)[0].grid)
    return -(-cells.shape[0] // _cell_rows(cells))


def stands_for_pixels(likelihood: Likelihood, values: Vector) -> bool:
    """True if cells can stand for the pixels of a set: counts linear in a flux of their own, smooth over the frames."""
    instrument, selection = likelihood.model.instrument(values), frames_among(likelihood.calset)
    if selection is None or not light.is_linear(instrument) or likelihood.plan.exposures.shared is not None:
        return False
    frames, exposures = selection
    return _series(likelihood, instrument, Cells.of(frames.grid), exposures)[0] is not None


def frame_sums(likelihood: Likelihood, values: Vector, every: int = 1) -> FrameSums:
    """Go once over the pixels of a set for which `stands_for_pixels` holds, or over one strip in `every`.

    Raises `DataError` for what cannot be read, and for errors that are not positive; ValueError where the counts
    are not smooth over the field.
    """
    frames, exposures = _frames(likelihood)
    cells, runner = Cells.of(frames.grid), likelihood.runner
    instrument = likelihood.model.instrument(values)
    smooth, off = _series(likelihood, instrument, cells, exposures)
    if smooth is None:
        raise ValueError(f"no series of the counts over the field: off by {off:.2g}")
    columns, rows = cells.shape[1], _cell_rows(cells)
    strips = range(0, strips_of(likelihood), every)
    width, height = -(-cells.grid.width // piece_of(cells.side)) * piece_of(cells.side), rows * cells.side
    # Beyond the frame there are no pixels: any place will do.
    s = np.minimum((np.arange(width) + 0.5) * cells.size[0] - 1.0, 1.0)
    across = jnp.asarray(chebyshev.polynomials(s, smooth.count).T)
    unit = np.asarray(smooth.coefficients.unit)[..., exposures]
    series = np.swapaxes(unit.reshape(smooth.count, smooth.count, *unit.shape[1:]), 0, 1)
    fixed = jnp.asarray(likelihood.flux_known[exposures])
    together, floor = instrument.cameras.together, jnp.asarray(instrument.cameras.floor)
    read = RowReader(frames, height, width)

    def work(number: int) -> tuple[np.ndarray, CellSums]:
        top = strips[number] * height
        bottom = min(top + height, cells.grid.height)
        pixels = read(top, bottom)
        t = np.minimum((top + np.arange(height) + 0.5) * cells.size[1] - 1.0, 1.0)
        along = jnp.asarray(chebyshev.polynomials(t, smooth.count))
        side = jnp.zeros(cells.side)
        strip = strip_sums(pixels, jnp.asarray(series), across, along, side, fixed, together, floor)
        if int(strip.impossible):
            frames.block(top * cells.grid.width, bottom * cells.grid.width)  # names the pixel
        cut = jax.tree.map(lambda leaf: np.asarray(leaf)[..., :columns], strip.cells)
        return np.asarray(strip.moments), cut

    step = height * cells.grid.width * every
    moments, strip_cells = np.zeros(series.shape), []
    for pull, cell_sums in runner.each("summing pixels", work, cells.grid.pixels, step):
        moments += pull
        strip_cells.append(cell_sums)
    count = len(likelihood.flux_known)
    sums = _assembled(strip_cells, cells.shape[0], every)
    sums = CellSums(*(_in_places(array, exposures, count, axis=-3) for array in sums))
    moments = _in_places(moments, exposures, count, axis=-1)
    return FrameSums(likelihood, values, cells, sums, moments, every, smooth, OpticsUsed(smooth.count, off))


def _in_places(values: np.ndarray, exposures: Int[np.ndarray, " r"], count: int, *, axis: int) -> np.ndarray:
    """Sums of some exposures among those of all, of which there are `count`; zeros for the others."""
    padded = np.zeros((*values.shape[:axis], count, *values.shape[axis:][1:]))
    np.moveaxis(padded, axis, 0)[exposures] = np.moveaxis(values, axis, 0)
    return padded


def _cell_rows(cells: Cells) -> int:
    """Rows of cells in a strip."""
    return max(1, limits.STRIP_ROWS // cells.side)


def _series(
    likelihood: Likelihood, instrument: Instrument, cells: Cells, exposures: Int[np.ndarray, " r"]
) -> tuple[FieldTable | None, float]:
    """The series of everything, accurate for these exposures, and how accurate."""

    def exact(s: Vector, t: Vector) -> Smooth:
        return _at(_solve, likelihood, instrument, *cells.field(s, t))

    def error(interpolated: Smooth, truth: Smooth) -> float:
        chosen = ((s.unit[..., exposures], s.vectors, s.stokes[:, exposures]) for s in (interpolated, truth))
        return float(np.max([np.abs(a - b).max() for a, b in zip(*chosen, strict=True)]))

    details = [cells.place(x, y) for x, y in details_of(instrument)]
    return accurate_table(exact, FRAME, limits.NODES_PER_SIDE, TOLERANCE, error, details=details)


def _assembled(strip_cells: Sequence[CellSums], height: int, every: int) -> CellSums:
    """The cells of one strip in `every` in their places, `height` rows of them; zeros in the others."""

    def column(*strips: np.ndarray) -> np.ndarray:
        rows = strips[0].shape[-2]
        joined = np.zeros((*strips[0].shape[:-2], -(-height // rows) * rows, strips[0].shape[-1]))
        for number, strip in enumerate(strips):
            first = number * every * rows
            joined[..., first : first + rows, :] = strip
        return joined[..., :height, :]

    return jax.tree.map(column, *strip_cells)


# ------------------------------------------------------------------------------- from sums to the parameters

NODES = 24  # per side for the matrix: products of two derivatives, of degree 11 and 12, are then exact


@dataclasses.dataclass(frozen=True)
class PixelExpansion(Expansion):
    """The expansion of all pixels, or of some strips of them, and the sums that it was made from."""

    sums: FrameSums


def expand_pixels(
    likelihood: Likelihood, values: Vector, noise_scale: float = 1.0, every: int = 1
) -> PixelExpansion:
    """As `Likelihood.expand`, by a pass over all pixels or one strip in `every`; a table beside them by its rows."""
    values = np.asarray(values, float)
    sums = frame_sums(likelihood, values, every)
    terms = DataTerms(sums.chi2, half_gradient(sums), gauss_newton(sums), sums.census)
    beside = without_frames(likelihood.calset)
    if beside is not None:
        terms = terms.joined(Likelihood.of(beside, likelihood.model).data_terms(values)[0])
    plain = likelihood.expanded(values, terms, noise_scale, sums.optics)
    return PixelExpansion(**{f.name: getattr(plain, f.name) for f in dataclasses.fields(plain)}, sums=sums)


def in_blocks(values: Float[np.ndarray, "... r c"], side: int) -> Float[np.ndarray, "... q d"]:
    """Sums over blocks of side × side cells; those at the far ends may be smaller."""
    if side == 1:
        return values
    rows, columns = (np.arange(0, size, side) for size in values.shape[-2:])
    return np.add.reduceat(np.add.reduceat(values, rows, axis=-2), columns, axis=-1)


def information(frame: FrameSums, together: int = 1) -> Float[np.ndarray, "k k e r c"]:
    """Information of the pixels on the counts for light of unit flux: the K of each cell, or of blocks of cells."""
    return information_of(frame, in_blocks(frame.sums.weight, together), frame.unit(together))


def information_of(
    frame: FrameSums, weight: Float[np.ndarray, "k ..."], unit: Float[np.ndarray, "k ..."]
) -> Float[np.ndarray, "k k ..."]:
    """K from Σ F²/σ² and the counts for light of unit flux, for any places: cameras, exposures, then these."""
    k, likelihood = len(unit), frame.likelihood
    shared = frame.instrument.cameras.together
    shared = np.ones((k, k)) if shared is None else np.asarray(shared)
    light = weight * unit
    power = np.einsum("k...,kl->l...", light * unit, shared)
    flux_known = likelihood.flux_known.reshape(-1, *(1,) * (unit.ndim - 2))
    share = np.where(~flux_known & (power > 0), light / np.where(power > 0, power, 1.0), 0.0)
    matrix = -np.einsum("kl,k...,l...->kl...", shared, share, light)
    matrix[np.arange(k), np.arange(k)] += weight
    return matrix


def _on_nodes(frame: FrameSums, count: int, together: int) -> Float[np.ndarray, "s t e k l"]:
    """The K of all cells, or of blocks of them, on Chebyshev nodes: Σ ℓ K."""
    to = chebyshev.to_coefficients(count)
    over, up = (chebyshev.polynomials(place, count) @ to for place in frame.cells.middles(together))
    return np.einsum("klerc,cs,rt->stekl", information(frame, together), over, up, optimize=True)


def half_gradient(frame: FrameSums) -> Vector:
    """Half gradient of χ² of all pixels in all parameters."""
    count = frame.smooth.count
    to = chebyshev.to_coefficients(count)
    pull = np.einsum("jike,jt,is->stek", frame.moments, to, to, optimize=True)
    pull = pull.reshape(count**2, *pull.shape[2:])
    gradient = np.zeros(len(frame.values))
    for rows, slopes in _slopes_on_nodes(frame, count):
        gradient -= np.einsum("pekn,pek->n", slopes, pull[rows], optimize=True)
    return gradient


def gauss_newton(frame: FrameSums) -> Matrix:
    """Gauss–Newton matrix of half of χ² of all pixels in all parameters."""
    matrices = _on_nodes(frame, NODES, 1)
    if frame.every == 1:
        # K of a cell that lies in its middle errs by the square of its side: so blocks of four give the error.
        correction = (frame.cells.side**2 - 1) / (3 * frame.cells.side**2)
        matrices = (1.0 + correction) * matrices - correction * _on_nodes(frame, NODES, 2)
    matrices = matrices.reshape(NODES**2, *matrices.shape[2:])
    size = len(frame.values)
    matrix = np.zeros((size, size))
    for rows, slopes in _slopes_on_nodes(frame, NODES):
        weighted = np.einsum("pekl,peln->pekn", matrices[rows], slopes, optimize=True)
        matrix += slopes.reshape(-1, size).T @ weighted.reshape(-1, size)
    return 0.5 * (matrix + matrix.T)


def _slopes_on_nodes(frame: FrameSums, count: int) -> Iterator[tuple[slice, Float[np.ndarray, "p e k a"]]]:
    """Derivatives of the counts on Chebyshev nodes, some at a time."""
    x, y = frame.cells.field(*chebyshev.grid(FRAME, count))
    for start in range(0, len(x), limits.BATCH):
        rows = slice(start, start + limits.BATCH)
        yield rows, unit_slopes_at(frame.likelihood, frame.instrument, x[rows], y[rows])

"""What the pixels of whole frames say, summed over cells of the field: about a microsecond of a core a pixel.

Frames see a source that shines everywhere, so the counts for light of unit flux, u, are smooth over the field: all
optics, sources and cameras there are, in one series of Chebyshev polynomials for each exposure and camera. With w = 1/σ
and the best flux F of every exposure of a pixel (`flux.py`), what a pixel says of a change δ of u is

    χ²(δ) = Σ r² − 2 g · δ + δᵀ K δ,    r = w (N − F u),   g = F w r,   K = F² (w² − w²u uᵀw² / Σ w²u²)

Kept of a cell are Σ F²w² (from which K is made), Σ g, the flux, χ² and the number of pixels, for each exposure; of a
strip the moments Σ g T_i T_j with the polynomials T of the series. Derivatives of u with respect to any parameter are
smooth too, so that these sums stand for the pixels (`pixels.py`).

Limit       detectors that report counts as they are, so that N is linear in F.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.raw_rows import RawRows, float64
from walop_jax.data.table_intensities import NEGATIVE
from walop_jax.likelihood import limits
from walop_jax.model.compiled import compiled


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
    """What a strip of image rows contributes; `moments` are Σ g T_i T_j, `impossible` counts errors not above zero."""

    cells: CellSums
    moments: Float[Array, "j i k e"]
    impossible: Int[Array, ""]


class _Terms(NamedTuple):
    weight: Float[Array, "k e w"]
    pull: Float[Array, "k e w"]
    power: Float[Array, "e w"]
    chi2: Float[Array, "e w"]
    used: Float[Array, "e w"]
    impossible: Int[Array, " w"]


def _terms(
    unit: Float[Array, "k e w"],
    counts: Float[Array, "k e w"],
    sigma: Float[Array, "k e w"],
    open_: Bool[Array, "e w"],
    known: Bool[Array, " e"],
    together: Float[Array, "k k"] | None,
) -> _Terms:
    """The terms of the pixels of a piece of an image row."""

    def summed(values: Float[Array, "k e w"]) -> Float[Array, "f e w"]:
        if together is None:
            return values.sum(axis=0, keepdims=True)
        return jnp.einsum("kew,kl->lew", values, together)

    finite = jnp.isfinite(counts) & jnp.isfinite(sigma)
    wrong = open_ & jnp.any(jnp.isfinite(sigma) & (sigma <= 0), axis=0)
    used = open_ & ~wrong & jnp.all(finite & (counts >= -NEGATIVE * sigma), axis=0)
    weight = jnp.where(used, 1.0 / jnp.where(used, sigma, 1.0) ** 2, 0.0)
    counts = jnp.where(used, counts, 0.0)
    light = unit * weight
    power = summed(light * unit)
    flux = jnp.where(known[:, None], 1.0, summed(light * counts) / jnp.where(power > 0, power, 1.0))
    left = counts - flux * unit
    scaled = flux * weight
    pull = scaled * left
    return _Terms(
        weight=flux * scaled,
        pull=pull,
        power=jnp.sum(flux**3 * light * unit, axis=0),
        chi2=jnp.sum(weight * left**2, axis=0),
        used=used.astype(float),
        impossible=jnp.sum(wrong, axis=0),
    )


def _strip_sums(
    rows: RawRows,
    series: Float[Array, "j i k e"],
    across: Float[Array, "i w"],
    along: Float[Array, "h j"],
    side: Float[Array, " c"],
    known: Bool[Array, " e"],
    together: Float[Array, "k k"] | None,
) -> StripSums:
    cameras, exposures, height, width = rows.counts.shape
    cell, piece = side.size, piece_of(side.size)
    by_row = jnp.einsum("hj,jike->hkei", along, series).reshape(height, cameras * exposures, -1)

    def terms_at(row: Int[Array, ""], start: Int[Array, ""]) -> _Terms:
        def cut(array: Array) -> Array:
            return jax.lax.dynamic_slice(array, (0, 0, row, start), (*array.shape[:2], 1, piece))[:, :, 0]

        here = jax.lax.dynamic_slice_in_dim(across, start, piece, axis=1)
        open_ = jax.lax.dynamic_slice(rows.open, (0, row, start), (exposures, 1, piece))[:, 0]
        unit = (by_row[row] @ here).reshape(cameras, exposures, piece)
        return _terms(unit, float64(cut(rows.counts)), float64(cut(rows.sigma)), open_, known, together)

    def one_piece(first: Int[Array, ""], start: Int[Array, ""]) -> StripSums:
        here = jax.lax.dynamic_slice_in_dim(across, start, piece, axis=1)

        def add(
            sums: tuple[_Terms, Float[Array, "j m i"]], row: Int[Array, ""]
        ) -> tuple[tuple[_Terms, Float[Array, "j m i"]], None]:
            terms = terms_at(row, start)
            moments = terms.pull.reshape(-1, piece) @ here.T
            return (
                jax.tree.map(jnp.add, sums[0], terms),
                sums[1] + along[row][:, None, None] * moments,
            ), None

        terms = jax.eval_shape(terms_at, first, start)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), terms)
        no_moments = jnp.zeros((along.shape[1], cameras * exposures, len(across)))
        (sums, moments), _ = jax.lax.scan(add, (nothing, no_moments), first + jnp.arange(cell))

        def cells(values: Float[Array, "... w"]) -> Float[Array, "... c"]:
            return values.reshape(*values.shape[:-1], piece // cell, cell).sum(axis=-1)

        found = CellSums(sums.weight, sums.pull, sums.power, sums.chi2, sums.used)
        return StripSums(jax.tree.map(cells, found), moments, sums.impossible.sum())

    def cell_row(first: Int[Array, ""]) -> StripSums:
        pieces = jax.lax.map(lambda start: one_piece(first, start), jnp.arange(0, width, piece))
        joined = jax.tree.map(lambda v: jnp.moveaxis(v, 0, -2).reshape(*v.shape[1:-1], -1), pieces.cells)
        return StripSums(joined, pieces.moments.sum(axis=0), pieces.impossible.sum())

    found = jax.lax.map(cell_row, jnp.arange(0, height, cell))
    moments = jnp.swapaxes(found.moments.sum(axis=0), 1, 2)
    return StripSums(
        jax.tree.map(lambda v: jnp.moveaxis(v, 0, -2), found.cells),
        moments.reshape(*moments.shape[:2], cameras, exposures),
        found.impossible.sum(),
    )


strip_sums = compiled(_strip_sums, fuse=True)
"""Sums over a strip of image rows.

`series` are the coefficients of the counts for light of unit flux; `across` and `along` the polynomials at the columns
and rows; `side` has as many entries as a cell has columns and rows; `known` says in which exposures the flux is one;
`together` which cameras have a flux in common (`Cameras.together`). Columns come in whole pieces (`piece_of`), rows in
whole cells.
"""


def piece_of(cell: int) -> int:
    """Columns that are worked on together: whole cells."""
    return cell * max(1, limits.COLUMNS // cell)

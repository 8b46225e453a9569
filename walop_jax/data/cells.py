"""Whole frames become cells: field points, usually 6400, that hold what all of their pixels say.

Surface     Frames are cut into blocks. To the pixels of a block a surface is fitted for each exposure and camera,
            a polynomial of degree `ORDER` − 1 along both sides, all pixels with the same weight. It is kept as its
            values at `ORDER` × `ORDER` points, the field points of the set, at the zeros of the polynomial of degree
            `ORDER` that is orthogonal over the pixels. Two things are special about these: values there have
            independent errors, σ/√(w n) each with w n the pixels that the point stands for, its cell; and the next
            polynomial, the largest of those left out, is zero there. A mean over a cell, taken for the value at its
            middle, is off by side²/24 · ∇²; these values by the eighth power of the side of a block.
Light       Fitted are fractions N_k/L of the light L = Σ_k N_k of a pixel, and N_k = fraction · (surface of L) at the
            points: what the cameras have in common, such as the illumination of the field, may be as rough as it likes.
            Of photons N_k/L is no biased estimate (given L, N_k are multinomial). Where the flux is known, shared or
            faint, L = 1, and the surface is that of the counts themselves.
Weights     N_ERR of the pixels is made from their counts: weights 1/σ² would favour pixels that happen to be faint. All
            have the same weight, in all cameras, so that errors are Σσ² of all, propagated.
Bad pixels  A pixel that is bad in one camera is left out of that exposure. Surfaces are then fitted to the others, with
            the errors that follow. A block without the pixels that its surface needs, at the edge of a round field,
            keeps one point for each part with pixels, at their mean position, and a surface that these can hold.
Structure   Residuals r of a pixel about the surfaces that agree between exposures: with q = L s(1 − s), the change of
            counts by a gain of one camera with the fraction s, Σ_{e≠e'} r_e r_e' = g² Σ_{e≠e'} q_e q_e' over exposures
            e, whatever the noise is, as long as it is independent. See `FineStructure`. Pixels of single spots, which
            no surface holds, are left out of all exposures.
Sources     Golub & Welsch 1969, Mathematics of Computation 23, 221 (zeros as eigenvalues); Szegő 1939, Orthogonal
            Polynomials, §3.4 (independence of values at zeros).
Limits      Structure that is finer than a block and no surface: in the mean it is in the values of the points, pixel by
            pixel it is told by `FineStructure` alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.polynomial.legendre import legvander

from walop_jax.data import plausible
from walop_jax.data.frames import Frames
from walop_jax.data.records import Block, FineStructure, Points
from walop_jax.data.table_intensities import SPOILT, TableIntensities, usable
from walop_jax.data.units import Place
from walop_jax.io.shapes import Vector

CELLS = 80
"""Cells along the longer side of frames, unless the user says otherwise: parameters then lie within 0.05 standard
errors of a fit to all pixels."""
ORDER = 4
"""Points along a side of a block."""
BRIGHT = 20.0
"""Standard errors of the light of a pixel, or of a cell, above which fractions of it are taken."""
MAP = 16
"""Parts of a block, along a side, in which structure is measured."""

_TOGETHER = 1 << 15  # pixels of a camera: their numbers stay in the cache of a processor
_HUGE = 10.0  # times the median error in its block row: a mark of a bad pixel, and no error
_WHOLE = 0.2  # smallest eigenvalue of the normal matrix, 1 with all pixels, of a block with all of its points
_SOUND = 0.05  # the same, for its fraction of pixels, of a surface that parts of a block hold
_FEW = 0.05  # of the patches of a row of blocks: with more of them spots are no spots, and stay
_ALIKE = 0.1  # of the best exposure of a block: exposures that have less of it are left out there
_PART = 0.1  # of the pixels of the fullest part of a block: parts that have less get no point


def orthonormal(
    places: Vector, order: int, weight: Vector | None = None
) -> tuple[Float[np.ndarray, " o"], Float[np.ndarray, "o o"]]:
    """The polynomials of degrees 0 to `order` − 1 that are orthonormal over some places between −1 and 1.

    `weight` is the weight of each place; None: all have weight 1. Returns the zeros of the next polynomial, and the
    matrix that makes these polynomials from Legendre's: `legvander(x, order - 1) @ matrix`.
    """
    plain = legvander(places, order - 1)
    values, triangle = np.linalg.qr(plain if weight is None else np.sqrt(weight)[:, None] * plain)
    return np.linalg.eigvalsh(values.T @ (places[:, None] * values)), np.linalg.inv(triangle)


class _Side:
    """One side of the frames, cut into blocks: polynomials, points and parts of each, along this side.

    `edges` are pixels; `order` is the number of points of a block. Polynomials are orthonormal over the pixels of a
    block.
    """

    def __init__(self, pixels: int, cells: int) -> None:
        blocks = pixels if pixels <= cells else max(1, round(cells / ORDER))
        self.edges = np.round(np.linspace(0, pixels, blocks + 1)).astype(int)
        self.order = min(ORDER, int(np.diff(self.edges).min()))
        self.nodes, self.offsets, self._matrices = [], [], []
        for first, last in self:
            t = self._scaled(first, last, np.arange(first, last))
            zeros, matrix = orthonormal(t, self.order)
            self._matrices.append(matrix)
            self.nodes.append(0.5 * (first + last - 1 + zeros * (last - first)))
            self.offsets.append(np.round(np.linspace(0, last - first, self.order + 1)).astype(int))

    def __len__(self) -> int:
        return len(self.edges) - 1

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return zip(self.edges[:-1].tolist(), self.edges[1:].tolist(), strict=True)

    @staticmethod
    def _scaled(first: int, last: int, pixel: np.ndarray) -> Vector:
        return (2.0 * pixel - (first + last - 1)) / (last - first)

    def polynomials(self, block: int, pixel: np.ndarray) -> Float[np.ndarray, "n o"]:
        """The polynomials of a block at places along the side."""
        first, last = self.edges[block : block + 2].tolist()
        return legvander(self._scaled(first, last, pixel), self.order - 1) @ self._matrices[block]

    def of_pixels(self, block: int) -> Float[np.ndarray, "n o"]:
        """The polynomials of a block at its pixels."""
        return self.polynomials(block, np.arange(*self.edges[block : block + 2]))

    def parts(self, block: int) -> Float[np.ndarray, "n o"]:
        """1 for the pixels of each part of a block."""
        offsets = self.offsets[block]
        pixel = np.arange(offsets[-1])[:, None]
        return ((pixel >= offsets[:-1]) & (pixel < offsets[1:])).astype(float)

    def spread(self, columns: list[Float[np.ndarray, "n c"]]) -> Float[np.ndarray, "w m"]:
        """Columns of all blocks, each beside the others and zero outside of its own."""
        width = columns[0].shape[1]
        joined = np.zeros((self.edges[-1], width * len(self)))
        for block, (first, last) in enumerate(self):
            joined[first:last, width * block : width * (block + 1)] = columns[block]
        return joined


class _Weights(NamedTuple):
    """What rows or columns are multiplied with: polynomials, their products, parts, positions within the parts."""

    fit: Float[np.ndarray, "n m"]
    products: Float[np.ndarray, "n m"]
    parts: Float[np.ndarray, "n m"]
    places: Float[np.ndarray, "n m"]

    @classmethod
    def of(cls, side: _Side, blocks: list[int]) -> _Weights:
        """Of one block, or of all side by side."""
        fit = [side.of_pixels(n) for n in blocks]
        products = [(p[:, :, None] * p[:, None]).reshape(len(p), -1) for p in fit]
        parts = [side.parts(n) for n in blocks]
        places = [
            part * np.arange(*side.edges[n : n + 2])[:, None] for n, part in zip(blocks, parts, strict=True)
        ]
        if len(blocks) == 1:
            return cls(fit[0], products[0], parts[0], places[0])
        return cls(*(side.spread(columns) for columns in (fit, products, parts, places)))


class _Sums(NamedTuple):
    """Sums over the pixels of the blocks in a row of blocks, for one exposure; q of them, ORDER² where there are all.

    `share` and `light` are the right sides of the fits, `normal` their matrix; of the parts of a block `variance`
    holds Σ σ²/L², `number` the used pixels, `column` and `row` the sums of their positions.
    """

    share: Float[np.ndarray, "b k q"]
    light: Float[np.ndarray, "b q"]
    normal: Float[np.ndarray, "b q q"]
    variance: Float[np.ndarray, "b k q"]
    number: Float[np.ndarray, "b q"]
    column: Float[np.ndarray, "b q"]
    row: Float[np.ndarray, "b q"]


@dataclasses.dataclass
class _Tally:
    """Counts of what was met on the way, for remarks and refusals."""

    pixels: int = 0
    flagged: int = 0
    spoilt: int = 0
    huge: int = 0
    left_out: int = 0
    spots: int = 0
    lowest: float = np.inf
    highest: float = -np.inf
    first_spoilt: str = ""


def cells_of(
    frames: Frames, path: object, known: Bool[np.ndarray, " e"], cells: int | None = None
) -> tuple[Points, TableIntensities, FineStructure, list[str]]:
    """Field points, intensities and structure finer than these of the frames of a file, and remarks.

    `known` says in which exposures the flux is known, or shared with others; `cells` is the number of cells along the
    longer side. One exposure of a row of blocks is read at a time.

    Raises `DataError` for errors that are not positive on open pixels, for frames of which more than a fifth of the
    pixels are spoilt, of which none is used, and whose counts are all equal.
    """
    return _Binning(frames, path, known, cells or CELLS).result()


class _Binning:
    """The work of `cells_of`, a row of blocks at a time."""

    def __init__(self, frames: Frames, path: object, known: Bool[np.ndarray, " e"], cells: int) -> None:
        self.frames, self.path, self.known, grid = frames, path, known, frames.grid
        longest = max(grid.width, grid.height)
        self.across, self.along = (
            _Side(pixels, int(np.ceil(cells * pixels / longest))) for pixels in (grid.width, grid.height)
        )
        self.columns = _Weights.of(self.across, list(range(len(self.across))))
        self.tally, self.samples = _Tally(), []
        self.single = (
            len(self.along) * len(self.across) == grid.pixels
        )  # each pixel is a cell, and stays as it is

    def result(self) -> tuple[Points, TableIntensities, FineStructure, list[str]]:
        """Go through all rows of blocks."""
        found, structure = [], []
        for number in range(len(self.along)):
            points, patches, spots = self._row_of_blocks(number)
            if spots.any():  # no surface holds a spot: all others are without it
                tally, samples = dataclasses.replace(self.tally), len(self.samples)
                points, *_ = self._row_of_blocks(number, spots)
                self.tally, self.samples = tally, self.samples[:samples]
                self.tally.spots += int(spots.sum())
            found += points
            structure.append(patches)
        remarks = self._checked_pixels()
        column, row, *data = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
        x, y = self.frames.grid.at(column, row)
        points = Points(np.arange(len(x), dtype=np.int32), x, y)
        counts, sigma, used = data
        block = Block(x, y, counts, sigma, used, np.full(used.shape, -1))
        fine = FineStructure(*(np.concatenate(arrays) for arrays in zip(*structure, strict=True)))
        return points, TableIntensities.dense(points, block), fine, remarks

    # ---------------------------------------------------------------------------------------------- sums over pixels

    def _row_of_blocks(
        self, number: int, closed: Bool[np.ndarray, "y x"] | None = None
    ) -> tuple[list[tuple[np.ndarray, ...]], tuple[np.ndarray, ...], Bool[np.ndarray, "y x"]]:
        """Points of a row of blocks with their data, the structure of its parts, and the pixels of spots in it.

        Pixels that are `closed` are used in no exposure.
        """
        rows = _Weights.of(self.along, [number])
        first, last = self.along.edges[number : number + 2].tolist()
        shape = (self.frames.cameras, last - first, self.frames.grid.width)
        agreeing = [np.zeros(shape, np.float32) for _ in range(5)]
        sums = []
        for exposure in range(self.frames.exposures):
            counts, sigma, used = self._pixels(exposure, first, last)
            used = used if closed is None else used & ~closed
            light = self._light(exposure, counts, sigma, used)
            sums.append(self._sums(counts, sigma, light, used, rows))
            if not (self.known[exposure] or self.single):
                self._add_residuals(agreeing, counts, light, used, sums[-1], rows)
        joined = _Sums(*(np.stack(arrays) for arrays in zip(*sums, strict=True)))
        points = [self._points(number, block, joined) for block in range(len(self.across))]
        return [p for p in points if len(p[0])], *self._structure(number, agreeing)

    def _pixels(
        self, exposure: int, first: int, last: int
    ) -> tuple[Float[np.ndarray, "k y x"], Float[np.ndarray, "k y x"], Bool[np.ndarray, "y x"]]:
        """Counts and errors of some image rows of an exposure, and which pixels are used."""
        counts, sigma, flag = self.frames.rows(exposure, first, last)
        used, spoilt, impossible = usable(np.moveaxis(counts, 0, -1), np.moveaxis(sigma, 0, -1), flag)
        if np.any(impossible):
            row, column = (int(entry[0]) for entry in np.nonzero(impossible))
            camera = int(np.argmax(sigma[:, row, column] <= 0))
            where = f"plane {exposure}, row {first + row}, column {column} (counted from 0)"
            what = f"is zero or negative in {where}, and {int(impossible.sum())} pixel(s) in these rows"
            advice = "give the true error, or set the FLAG image"
            raise self.frames.sigma[camera].place.fail(what, advice=advice)
        tally = self.tally
        tally.pixels += used.size
        tally.flagged += int(np.count_nonzero(flag))
        if count := int(spoilt.sum()):
            row, column = (int(entry[0]) for entry in np.nonzero(spoilt))
            tally.first_spoilt = tally.first_spoilt or f"plane {exposure}, row {first + row}, column {column}"
            tally.spoilt += count
        if used.any() and not self.single:
            sampled = used[:: 1 + len(used) // 64, ::8]
            for errors in sigma:
                thinned = errors[:: 1 + len(used) // 64, ::8][sampled]
                if thinned.size:
                    huge = used & (errors > _HUGE * np.median(thinned))
                    tally.huge += int(huge.sum())
                    used = used & ~huge
        middle = (last - first) // 2
        lit = used[middle] & (not self.known[exposure])
        self.samples.append((counts[:, middle].T.copy(), sigma[:, middle].T.copy(), lit))
        if used.any():
            values = np.where(used, counts, counts[:, used][0, 0])
            tally.lowest, tally.highest = min(tally.lowest, values.min()), max(tally.highest, values.max())
        return counts, sigma, used

    def _light(
        self,
        exposure: int,
        counts: Float[np.ndarray, "k y x"],
        sigma: Float[np.ndarray, "k y x"],
        used: Bool[np.ndarray, "y x"],
    ) -> Float[np.ndarray, "y x"]:
        """The light of every used pixel: the sum of its cameras, or 1 in blocks where fractions of that say nothing."""
        if self.known[exposure] or self.single:
            return np.ones(used.shape)
        total = np.where(used, counts.sum(axis=0, dtype=float), 0.0)
        noise = np.where(used, np.einsum("kyx,kyx->yx", sigma, sigma), 0.0)
        starts, widths = self.across.edges[:-1], np.diff(self.across.edges)
        number, light, variance = (
            np.add.reduceat(values.sum(axis=0, dtype=float), starts) for values in (used, total, noise)
        )
        bright = light > BRIGHT * np.sqrt(np.maximum(number * variance, 1e-300))
        least = np.repeat(np.where(bright, 0.01 * light / np.maximum(number, 1.0), 0.0), widths)
        return np.where(used & np.repeat(bright, widths), np.maximum(total, least), 1.0)

    def _sums(
        self,
        counts: Float[np.ndarray, "k y x"],
        sigma: Float[np.ndarray, "k y x"],
        light: Float[np.ndarray, "y x"],
        used: Bool[np.ndarray, "y x"],
        rows: _Weights,
    ) -> _Sums:
        """Sums over the pixels of a row of blocks in one exposure."""
        columns, whole = self.columns, bool(used.all())
        share = variance = shine = products = number = column = row = np.zeros(())
        for some in self._chunks(len(used)):
            mask, brightness = used[some].astype(float), light[some]
            fit, parts = rows.fit[some].T, rows.parts[some].T
            inverse = mask / brightness
            share = share + fit @ (np.where(used[some], counts[:, some], 0.0) * inverse)
            error = np.where(used[some], sigma[:, some], 0.0) * inverse
            variance = variance + parts @ (error * error)
            shine = shine + fit @ (mask * brightness)
            in_parts = parts @ mask
            number, column = number + in_parts @ columns.parts, column + in_parts @ columns.places
            row = row + rows.places[some].T @ mask
            products = products if whole else products + rows.products[some].T @ mask
        terms = rows.fit.shape[1] * self.across.order
        normal = np.broadcast_to(np.eye(terms), (len(self.across), terms, terms))
        if not whole:
            normal = self._in_blocks(products @ columns.products)
            normal = normal.reshape(len(normal), *[rows.fit.shape[1]] * 2, *[self.across.order] * 2)
            normal = np.moveaxis(normal, 3, 2).reshape(-1, terms, terms)
        return _Sums(
            share=self._in_blocks(share @ columns.fit),
            light=self._in_blocks(shine @ columns.fit),
            normal=normal,
            variance=self._in_blocks(variance @ columns.parts),
            number=self._in_blocks(number),
            column=self._in_blocks(column),
            row=self._in_blocks(row @ columns.parts),
        )

    def _chunks(self, rows: int) -> Iterator[slice]:
        """Image rows that are worked on together: they stay in the cache of the processor."""
        step = max(1, _TOGETHER // self.frames.grid.width)
        return (slice(first, min(first + step, rows)) for first in range(0, rows, step))

    def _in_blocks(self, sums: Float[np.ndarray, "... m"]) -> Float[np.ndarray, "b ..."]:
        """Sums of all blocks side by side, by block (first axis); rows and columns of one together on the last."""
        sums = np.moveaxis(sums.reshape(*sums.shape[:-1], len(self.across), -1), -2, 0)
        return sums.reshape(*sums.shape[:-2], -1)

    # ------------------------------------------------------------------------------------------ from sums to points

    def _points(self, number: int, block: int, sums: _Sums) -> tuple[np.ndarray, ...]:
        """Field points of a block: column, row, counts and errors (point, exposure, camera), used (point, exposure)."""
        normal, size = sums.normal[:, block], (self.along.order, self.across.order)
        count = sums.number[:, block]
        least = np.linalg.eigvalsh(normal)[:, 0]
        terms = np.arange(size[0] * size[1])
        if least.max() >= _WHOLE:
            row, column = (
                g.ravel()
                for g in np.meshgrid(self.along.nodes[number], self.across.nodes[block], indexing="ij")
            )
            parts = terms
        else:
            fullest = count.max(axis=0)
            parts = np.flatnonzero((fullest > 0) & (fullest >= _PART * fullest.max()))
            if not len(parts):
                return (np.zeros(0),) * 5
            terms, least = self._held(normal, len(parts))
            total, rows, columns = (
                entry.sum(axis=0) for entry in (count, sums.row[:, block], sums.column[:, block])
            )
            if len(terms) == 1:  # a constant, at the mean position of all pixels
                total, rows, columns = (entry.sum(keepdims=True) for entry in (total, rows, columns))
                count, parts = count.sum(axis=1, keepdims=True), np.zeros(1, int)
            row, column = rows[parts] / total[parts], columns[parts] / total[parts]
        kept = least >= _ALIKE * least.max()
        self.tally.left_out += round(float(count[~kept].sum()))
        along, across = self.along.polynomials(number, row), self.across.polynomials(block, column)
        basis = (along[:, :, None] * across[:, None]).reshape(len(row), -1)[:, terms]
        safe = np.where(kept[:, None, None], normal[:, terms[:, None], terms], np.eye(len(terms)))
        inverse = np.linalg.inv(safe)
        spread = np.einsum("pi,eij,pj->ep", basis, inverse, basis)
        share = np.einsum("pi,eij,ekj->pek", basis, inverse, sums.share[:, block][..., terms], optimize=True)
        light = np.einsum("pi,eij,ej->pe", basis, inverse, sums.light[:, block][:, terms], optimize=True)
        mean = sums.variance[:, block].sum(axis=-1) / np.maximum(count.sum(axis=-1), 1.0)[:, None]
        # More points than terms share the information of these.
        spread = spread * (len(row) / len(terms))
        here = count[:, None, parts]
        of_parts = sums.variance[:, block] if len(terms) > 1 else mean[..., None] * here
        part = of_parts[..., parts] / np.maximum(here, 1.0)
        variance = np.where(here > 0, part, mean[..., None]) * spread[:, None]
        used = np.broadcast_to(kept, (len(row), len(kept))) & (light > 0)
        counts = np.where(used[..., None], share * light[..., None], 0.0)
        sigma = np.where(used[..., None], np.sqrt(np.moveaxis(variance, -1, 0)) * light[..., None], 1.0)
        return column, row, counts, sigma, used

    def _held(
        self, normal: Float[np.ndarray, "e q q"], parts: int
    ) -> tuple[Int[np.ndarray, " t"], Float[np.ndarray, " e"]]:
        """Terms of the largest surface that the used parts of a block hold, and how well each exposure holds it."""
        size = self.along.order, self.across.order
        index = np.arange(size[0] * size[1]).reshape(size)
        for order in range(max(size), 1, -1):
            terms = index[:order, :order].ravel()
            least = np.linalg.eigvalsh(normal[:, terms[:, None], terms])[:, 0]
            if len(terms) <= parts and least.max() >= _SOUND * normal[:, 0, 0].max():
                return terms, least
        # The first polynomial is constant: its term is the fraction of the pixels that are used.
        return index[0, :1], normal[:, 0, 0]

    # --------------------------------------------------------------------------------------------------- structure

    def _add_residuals(
        self,
        agreeing: list[Float[np.ndarray, "k y x"]],
        counts: Float[np.ndarray, "k y x"],
        light: Float[np.ndarray, "y x"],
        used: Bool[np.ndarray, "y x"],
        sums: _Sums,
        rows: _Weights,
    ) -> None:
        """Add the residuals of an exposure about its surfaces and the effect of gains: Σ r, Σ r², Σ r⁴, Σ q, Σ q²."""
        size = rows.fit.shape[1], self.across.order
        regular = np.linalg.eigvalsh(sums.normal)[:, 0] >= _SOUND
        safe = np.where(regular[:, None, None], sums.normal, np.eye(size[0] * size[1]))
        terms = np.linalg.solve(safe[:, None], sums.share[..., None])[..., 0]
        terms = np.where(regular[:, None, None], terms, 0.0)
        terms = np.moveaxis(terms.reshape(len(safe), -1, *size), 0, 2)
        across = terms.reshape(*terms.shape[:2], -1) @ self.columns.fit.T
        seen = used & np.repeat(regular, np.diff(self.across.edges)) & (light != 1.0)
        for some in self._chunks(len(used)):
            surface = rows.fit[some] @ across
            expected = surface * np.where(seen[some], light[some], 0.0)
            residual = np.where(seen[some], counts[:, some], 0.0) - expected
            response = expected * (1.0 - surface)
            square = residual * residual
            made = residual, square, square * square, response, response * response
            for total, values in zip(agreeing, made, strict=True):
                total[:, some] += values

    def _structure(
        self, number: int, agreeing: list[Float[np.ndarray, "k y x"]]
    ) -> tuple[tuple[np.ndarray, ...], Bool[np.ndarray, "y x"]]:
        """Position, mean square gain and its error of the parts of a row of blocks; its pixels in and beside spots."""
        residual, square, fourth, response, power = agreeing
        first, last = self.along.edges[number : number + 2].tolist()

        def cut(edges: tuple[int, int]) -> np.ndarray:
            parts = max(1, min(MAP, (edges[1] - edges[0]) // ORDER))
            return np.round(np.linspace(*edges, parts + 1)).astype(int)

        rows = cut((first, last))
        columns = np.unique(np.concatenate([cut(edges) for edges in self.across]))

        def summed(values: np.ndarray) -> Float[np.ndarray, "n k"]:
            along = np.add.reduceat(values, rows[:-1] - first, axis=1, dtype=float)
            sums = np.add.reduceat(along, columns[:-1], axis=2)
            return sums.reshape(len(values), -1).T

        # The surfaces take up a little of what they are to show.
        terms = self.along.order * self.across.order * len(self.across)
        weight = summed(response**2 - power) * max(1.0 - terms / residual[0].size, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = summed(residual**2 - square) / weight
            error = np.sqrt(2.0 * summed(square**2 - fourth)) / weight
        middle = [0.5 * (edges[:-1] + edges[1:] - 1) for edges in (columns, rows)]
        x, y = self.frames.grid.at(*(values.ravel() for values in np.meshgrid(*middle)))
        measured = (weight > 0).all(axis=1) & (error > 0).all(axis=1)
        patches = x[measured], y[measured], gain[measured], error[measured]
        spots = np.flatnonzero(measured)[np.unique(FineStructure(*patches).spots[:, 0])]
        dark = np.zeros((len(rows) + 1, len(columns) + 1), bool)  # with a margin
        if len(spots) <= max(4, _FEW * len(x)):
            dark[1:-1, 1:-1].flat[spots] = True
        wide = np.any([np.roll(dark, step, (0, 1)) for step in np.ndindex(3, 3)], axis=0)
        wide = np.roll(wide, (-1, -1), (0, 1))[1:-1, 1:-1]
        return patches, np.repeat(np.repeat(wide, np.diff(rows), axis=0), np.diff(columns), axis=1)

    # ----------------------------------------------------------------------------------------------------- verdict

    def _checked_pixels(self) -> list[str]:
        """Refuse frames that cannot be measurements; remarks on pixels that are not used."""
        tally, last = self.tally, self.frames.cameras - 1
        place, images = Place(self.path, "N0"), f"N0…N{last}, E0…E{last}"
        if tally.spoilt > SPOILT * tally.pixels:
            what = f"{100 * tally.spoilt / tally.pixels:.0f} % of the pixels are not finite or far below zero"
            raise place.fail(what, images, "repair the reduction, or set the FLAG image")
        if tally.highest < tally.lowest:
            raise place.fail(
                "no pixel can be used: all are flagged or spoilt", images, "look at the reduction"
            )
        if tally.lowest == tally.highest and tally.pixels > 1:
            raise place.fail(
                f"all counts are equal ({tally.lowest:g})", f"N0…N{last}", "these are not measurements"
            )
        counts, sigma, lit = (np.concatenate(arrays) for arrays in zip(*self.samples, strict=True))
        doubts = plausible.of_errors(counts, sigma, lit)
        remarks = [f"{self.path} [E0…E{last}]: {what}" for _, what in doubts][:1]
        if tally.spoilt:
            what = f"not finite or below −5 sigma in {tally.spoilt} pixel(s), not used; the first: {tally.first_spoilt}"
            remarks.append(f"{self.path} [N0…N{last}]: {what}")
        if tally.huge:
            what = f"more than {_HUGE:g} times its neighbours in {tally.huge} pixel(s), not used: a mark of bad pixels?"
            remarks.append(f"{self.path} [E0…E{last}]: {what}")
        if tally.flagged:
            share = f"{100 * tally.flagged / tally.pixels:.2g} %"
            remarks.append(f"{self.path} [FLAG]: set in {share} of all pixels of all exposures, not used")
        if tally.spots:
            what = f"{tally.spots} pixel(s) of each exposure lie in spots of the field or beside them, and are left out"
            remarks.append(f"{self.path} [N0…N{last}]: {what}")
        if tally.left_out:
            what = "lie in blocks of the field of which other exposures have far more, and are left out"
            remarks.append(f"{self.path} [N0…N{last}]: {tally.left_out} pixel(s) {what}")
        return remarks

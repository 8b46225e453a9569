"""Cells of whole frames joined to fewer field points that hold what all of them say of anything smooth.

What looks at some hundred field points, a verdict or a diagnosis, sees all pixels of frames in this way; a sample of
the cells would show it a part of them.

Surface     The field is cut into rectangles. To the cells of a rectangle a polynomial of degree q − 1 along both sides
            is fitted for each exposure and camera, and kept as its values at q × q points: the zeros of the polynomials
            of degree q that are orthogonal over the cells, weighted by what these know. As in `cells` values there have
            independent errors, and the next polynomial, left out, is zero there.
Light       Fitted are fractions of the light of a cell, where fluxes are free, and their product with the surface of
            the light is kept (`cells`).
Weights     w of a cell is the mean of L²/σ² over exposures and cameras, alike for all of them, as a product of one
            number for each column and one for each row. Errors are those of σ, propagated.
Gaps        Cells that an exposure lacks are left out of its fit. A rectangle whose cells are no raster, at the edge of
            a round field, is cut into quarters; cells that are none there either stay as they are, as do field points
            of tables.
Limits      What is finer than the surfaces is lost: whoever looks for structure of places looks at single cells. A
            camera that is dark in a part of a rectangle knows more there than weights say that are alike for all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.polynomial.legendre import legvander

from walop_jax.data.cells import BRIGHT, orthonormal
from walop_jax.data.records import Block, CalibrationSet, Points
from walop_jax.data.table_intensities import ONE_CAMERA, TableIntensities
from walop_jax.io.shapes import Vector

ORDER, OF_LARGE = 5, 7
"""Points along a side of a rectangle, at least, and those of rectangles larger than a quarter of the field. Fewer would
leave more out of the surfaces; with more, rectangles are larger for the same number of points, and dark parts of them
are averaged with bright ones."""
LOWEST = 4
"""The same in quarters of a rectangle."""

_COMMON = 0.05  # of the cells: choices of exposures that fewer of them have are gaps of another choice
_ALIKE = 0.5  # of the exposures of a cell: with fewer in common it is no cell of that raster
_SAME = 1e-6  # of a side: cells nearer than that lie in the same column, or row
_HELD = 0.2  # smallest eigenvalue of the normal matrix, 1 with all cells, of an exposure that has gaps

CellIndex = Int[np.ndarray, " c"]


def joined_cells(calset: CalibrationSet, most: int) -> CalibrationSet:
    """The set with its cells joined to `most` field points or somewhat fewer.

    There are more where cells are no raster, and where the set has points of tables as well. A set that has no more
    points comes back as it is.
    """
    count = len(calset.points)
    if count <= most:
        return calset
    block = calset.intensities.block(0, count)
    shared = np.isin(calset.exposures.kind, ONE_CAMERA)
    parts, single = [], np.ones(count, bool)
    for raster in _rasters(block):
        for rectangle in _cut(block, raster, most * len(raster) / count):
            if (joined := _joined(block, rectangle, shared)) is not None:
                parts.append(joined)
                single[rectangle.cells] = False
    whole = Block.joined([*parts, _some(block, np.flatnonzero(single))])
    points = Points(np.arange(len(whole.x), dtype=np.int32), whole.x, whole.y)
    return dataclasses.replace(calset, points=points, intensities=TableIntensities.dense(points, whole))


class _Rectangle(NamedTuple):
    """Cells (numbers of points of the set), row by row of their raster; its columns `x` and rows `y`; `order`: q."""

    cells: CellIndex
    x: Vector
    y: Vector
    order: tuple[int, int]


def _some(block: Block, chosen: CellIndex) -> Block:
    return Block(**{f.name: getattr(block, f.name)[chosen] for f in dataclasses.fields(Block)})


def _rasters(block: Block) -> Iterator[CellIndex]:
    """Cells that have the same exposures, but for gaps."""
    cells = np.flatnonzero((block.source < 0).all(axis=1) & block.used.any(axis=1))
    used = block.used[cells]
    choices, count = np.unique(used, axis=0, return_counts=True)
    choices = choices[count >= _COMMON * len(cells)]
    if not len(choices):
        return
    common = used.astype(float) @ choices.T
    alike = common / (used.sum(axis=1)[:, None] + choices.sum(axis=1) - common)
    nearest = np.where(alike.max(axis=1) >= _ALIKE, alike.argmax(axis=1), -1)
    for number in range(len(choices)):
        yield cells[nearest == number]


def _cut(block: Block, cells: CellIndex, most: float) -> Iterator[_Rectangle]:
    """Rectangles of cells that become about `most` field points together."""
    place = np.stack([block.x[cells], block.y[cells]], axis=1)
    low, size = place.min(axis=0), np.ptp(place, axis=0)
    if not (size > 0).all():
        return
    wanted = np.sqrt(most * size / size[::-1])  # points along each side
    number = np.maximum(1, wanted // np.where(wanted < 4 * ORDER, OF_LARGE, ORDER)).astype(int)
    order = np.maximum(LOWEST, wanted // number).astype(int)
    column, row = np.minimum((number * (place - low) / size).astype(int), number - 1).T
    for i, j in np.ndindex(*number.tolist()):
        here, middle = cells[(column == i) & (row == j)], low + size / number * (i + 0.5, j + 0.5)
        yield from _rectangles(block, here, middle, size / number, order)


def _rectangles(
    block: Block, cells: CellIndex, middle: Vector, size: Vector, order: Int[np.ndarray, " 2"]
) -> Iterator[_Rectangle]:
    """The cells of a rectangle, or those of its quarters where they are no raster."""
    sides = []
    for values in (block.x[cells], block.y[cells]):
        near = np.round(values / (_SAME * size.max())).astype(int)
        _, first, number = np.unique(near, return_index=True, return_inverse=True)
        sides.append((values[first], number))
    (x, column), (y, row) = sides
    if len(x) < order[0] or len(y) < order[1]:
        return
    if len(cells) == len(x) * len(y):
        yield _Rectangle(cells[np.lexsort((column, row))], x, y, (int(order[0]), int(order[1])))
    elif order.max() > LOWEST:
        right, above = block.x[cells] >= middle[0], block.y[cells] >= middle[1]
        half = np.maximum(LOWEST, -(-order // 2))
        for i, j in np.ndindex(2, 2):
            of_quarter = middle + 0.25 * size * (2 * i - 1, 2 * j - 1)
            yield from _rectangles(block, cells[(right == i) & (above == j)], of_quarter, 0.5 * size, half)


class _Side(NamedTuple):
    """One side of a rectangle: its field points, and polynomials at its cells and at these points.

    The polynomials are orthonormal over the weighted cells.
    """

    points: Vector
    at_cells: Float[np.ndarray, "c q"]
    at_points: Float[np.ndarray, "q q"]

    @classmethod
    def of(cls, places: Vector, weight: Vector, order: int) -> _Side:
        """For cells at these places along the side, with weights of sum 1."""
        middle, half = 0.5 * (places.min() + places.max()), 0.5 * np.ptp(places)
        t = (places - middle) / half
        zeros, matrix = orthonormal(t, order, weight)
        at_cells, at_points = (legvander(places, order - 1) @ matrix for places in (t, zeros))
        return cls(middle + half * zeros, at_cells, at_points)


def _joined(block: Block, rectangle: _Rectangle, shared: Bool[np.ndarray, " e"]) -> Block | None:
    """Field points that stand for the cells of a rectangle; None where an exposure has too few of these."""
    here, shape = _some(block, rectangle.cells), (len(rectangle.y), len(rectangle.x))
    used, measured = here.used, here.used[..., None]
    total, noise = here.counts.sum(axis=2), np.sqrt(np.sum(here.sigma**2, axis=2))
    bright = ~shared & ((total > BRIGHT * noise) | ~used).all(axis=0)
    light = np.where(bright & used, total, 1.0)
    share = np.where(measured, here.counts / light[..., None], 0.0)
    variance = np.where(measured, (here.sigma / light[..., None]) ** 2, 0.0)
    mean = variance.sum(axis=0) / np.maximum(used.sum(axis=0), 1)[:, None]
    known = np.where(measured, mean / np.where(measured, variance, 1.0), 0.0).mean(axis=2)
    weight = (known.sum(axis=1) / np.maximum(used.sum(axis=1), 1)).reshape(shape)
    weight /= weight.sum()
    sides = weight.sum(axis=0), weight.sum(axis=1)
    x, y = map(_Side.of, (rectangle.x, rectangle.y), sides, rectangle.order)
    basis, wanted = (np.kron(y.at_cells, x.at_cells), np.kron(y.at_points, x.at_points))
    weights = np.outer(sides[1], sides[0]).ravel()
    of_points = (len(wanted), *here.counts.shape[1:])
    counts, sigma, lit = np.zeros(of_points), np.ones(of_points), np.zeros(of_points[:2], bool)
    for exposures, there in _alike(used):
        held = np.where(there, weights, 0.0)
        normal = basis.T @ (held[:, None] * basis)
        if there.any() and np.linalg.eigvalsh(normal)[0] < _HELD:
            return None
        if there.any():
            take = wanted @ np.linalg.solve(normal, basis.T * held)
            level = (take @ light[:, exposures])[..., None]
            lit[:, exposures] = level[..., 0] > 0
            counts[:, exposures] = np.tensordot(take, share[:, exposures], 1) * level
            sigma[:, exposures] = np.sqrt(np.tensordot(take**2, variance[:, exposures], 1)) * level
    counts, sigma = np.where(lit[..., None], counts, 0.0), np.where(lit[..., None], sigma, 1.0)
    column, row = np.meshgrid(x.points, y.points)
    return Block(column.ravel(), row.ravel(), counts, sigma, lit, np.full(lit.shape, -1))


def _alike(used: Bool[np.ndarray, "c e"]) -> Iterator[tuple[Int[np.ndarray, " e"], Bool[np.ndarray, " c"]]]:
    """Exposures that have the same cells, and these cells."""
    choices, number = np.unique(used, axis=1, return_inverse=True)
    for choice in range(choices.shape[1]):
        yield np.flatnonzero(number.ravel() == choice), choices[:, choice]

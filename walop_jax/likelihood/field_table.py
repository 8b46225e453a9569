"""Functions of the field are Chebyshev series, with an error that is measured every time:

    f(x, y) ≈ Σ c_ij T_i(tx) T_j(ty),    tx, ty from −1 to 1 over a rectangle of the field

The optics are analytic in the field, so a few hundred field points stand for every pixel: they are solved on n × n
nodes, and a table is taken only if it gives their values at other places as well. A series has all terms with
i, j < n, which is the polynomial through the nodes, or half of them, i + j < n: as accurate with a few nodes more,
and quicker to evaluate at many points.

Optics      Band rows and their derivatives with respect to the optical parameters are all the optics there is: on nodes
            they serve every point of a large set (`accurate_nodes`).
Tolerance   A relative error ε of all n counts, each known to σ/N, moves a parameter by up to √n ε / (σ/N) of its
            standard errors: with n = 1.7·10⁹ and σ/N = 10⁻³, 10⁻² standard errors are ε = 2.4·10⁻¹⁰. Two nodes
            more per side gain a factor of 30, so that much costs little.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from walop_jax.io.shapes import OfPoints
from walop_jax.likelihood import limits
from walop_jax.likelihood.optics import known_optics
from walop_jax.model import chebyshev
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import array
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan

# --------------------------------------------------------------------------- functions of the field as Chebyshev series

Tree = Any
"""Arrays, or a tuple of them, with the field positions (or the terms of a series) along the first axis."""


class FieldTable(eqx.Module):
    """Series over a rectangle; `coefficients` is a tree of arrays whose first axis runs over the terms.

    `count` is the number of nodes per side; `total` says that only terms with i + j < count are there.
    """

    rectangle: Rectangle
    coefficients: Tree
    count: int = eqx.field(static=True)
    total: bool = eqx.field(static=True, default=False)

    @classmethod
    def through(cls, rectangle: Rectangle, count: int, values: Tree, *, total: bool = False) -> Self:
        """The series through values at `chebyshev.grid`."""
        to = chebyshev.to_coefficients(count)
        i, j = _terms(count, total)

        def series(leaf: np.ndarray) -> np.ndarray:
            square = np.asarray(leaf).reshape(count, count, -1)
            coefficients = np.einsum("ai,bj,ijf->abf", to, to, square, optimize=True)
            return coefficients[i, j].reshape(-1, *np.shape(leaf)[1:])

        return cls(rectangle, jax.tree.map(series, values), count, total)

    def basis(self, x: Float[Any, "*p"], y: Float[Any, "*p"]) -> Float[Any, "*p t"]:
        """Values of the terms at field positions (deg)."""
        tx, ty = chebyshev.scaled(x, y, self.rectangle)
        across, along = (chebyshev.polynomials(t, self.count) for t in (tx, ty))
        if self.total:
            i, j = _terms(self.count, total=True)
            return across[..., i] * along[..., j]
        return (across[..., :, None] * along[..., None, :]).reshape(*across.shape[:-1], -1)

    def __call__(self, x: Float[Any, "*p"], y: Float[Any, "*p"]) -> Tree:
        """The functions at field positions (deg); arrays of numpy give arrays of numpy."""
        xp, basis = (jnp if isinstance(x, jax.Array) else np), self.basis(x, y)
        return jax.tree.map(lambda leaf: xp.tensordot(basis, leaf, 1), self.coefficients)


def _terms(count: int, total: bool) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " t"]]:
    i, j = np.indices((count, count)).reshape(2, -1)
    included = i + j < (count if total else 2 * count)
    return i[included], j[included]


def held_out(rectangle: Rectangle, details: Sequence[tuple[float, float]] = ()) -> tuple[OfPoints, OfPoints]:
    """Places at which a table is checked: the corners, the middles of the sides, and a spread of others.

    The others follow the sequence of Roberts 2018 (multiples of 1/φ and 1/φ², φ³ = φ + 1), which falls on no grid.
    `details` inside the rectangle take the place of the last: what is finer than these places lies there.
    """
    corners = [(a, b) for a in (0.0, 0.5, 1.0) for b in (0.0, 0.5, 1.0)]
    plastic = 1.324717957244746
    number = np.arange(1, limits.CHECKED_PLACES - len(corners) + 1)[:, None]
    unit = np.concatenate([corners, np.mod(number * np.array([1 / plastic, 1 / plastic**2]), 1.0)])
    low, high = np.asarray(rectangle.low), np.asarray(rectangle.high)
    places = low + unit * (high - low)
    inside = [place for place in details if np.all((low <= place) & (place <= high))]
    if inside:
        places[-len(inside) :] = inside[-len(places) :]
    x, y = places.T
    return x, y


def details_of(instrument: Instrument) -> list[tuple[float, float]]:
    """Field positions (deg) of the local features of the effects of an instrument."""
    return [place for effect in instrument.effects for place in effect.details()]


def accurate_table(
    exact: Callable[[OfPoints, OfPoints], Tree],
    rectangle: Rectangle,
    counts: Sequence[int],
    tolerance: float,
    error: Callable[[Tree, Tree], float],
    *,
    truth: Tree | None = None,
    total: bool = False,
    details: Sequence[tuple[float, float]] = (),
) -> tuple[FieldTable | None, float]:
    """The smallest table that is accurate where it has no node, and its error there.

    `exact` gives the functions at field positions (deg); `counts` are tried in turn. `error` compares what a table
    gives at the places of `held_out`, `details` among them, with `truth` there (None: what `exact` gives). None where
    no number of nodes is enough. An error that is not finite ends the search: functions that are not finite somewhere
    make such a table.
    """
    other_x, other_y = held_out(rectangle, details)
    off = np.inf
    for count in counts:
        x, y = chebyshev.grid(rectangle, count)
        if truth is None:
            solutions, points = exact(np.append(x, other_x), np.append(y, other_y)), len(x)
            values = jax.tree.map(lambda leaf, end=points: leaf[:end], solutions)
            truth = jax.tree.map(lambda leaf, end=points: leaf[end:], solutions)
        else:
            values = exact(x, y)
        table = FieldTable.through(rectangle, count, values, total=total)
        off = error(table(other_x, other_y), truth)
        if off <= tolerance or not np.isfinite(off):
            return table, off
    return None, off


# ----------------------------------------------------------------------------------- the optics of a large set


Optics = tuple[Float[np.ndarray, "p b r 4"], Float[np.ndarray, "p o b r 4"]]
"""Band rows, and their derivatives with respect to the optical parameters."""

TOLERANCE = 2e-10


def solved_optics(instrument: Instrument, plan: Plan, x: OfPoints, y: OfPoints) -> Optics:
    """Band rows and their derivatives at field positions (deg): exact."""
    return tuple(in_batches(lambda x, y: known_optics(instrument, plan, array(x), array(y)), x, y))


def in_batches(
    solve: Callable[..., Any],
    *columns: Float[np.ndarray, " p"],
    size: int = limits.BATCH,
    threads: int = 1,
) -> Any:
    """Results of `solve` for the rows of columns, a tree of arrays, `size` rows at a time, as it is compiled for."""

    def solved(start: int) -> Any:
        # The last batch is filled up with its last row, so that padding cannot overflow or give NaN.
        rows = np.minimum(np.arange(start, start + size), len(columns[0]) - 1)
        return jax.tree.map(np.asarray, solve(*(column[rows] for column in columns)))

    batches = [solved(0)]  # compiles
    with ThreadPoolExecutor(threads) as pool:
        batches += pool.map(solved, range(size, len(columns[0]), size))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(columns[0])], *batches)


def accurate_nodes(
    instrument: Instrument, plan: Plan, rectangle: Rectangle, scale: OfPoints, first: int | None = None
) -> tuple[FieldTable | None, float]:
    """The smallest table of the optics (of at least `first` nodes per side) accurate to `TOLERANCE`, and its error.

    `scale` holds the solver's unit of every optical parameter. None where no number of nodes is enough: the optics
    oscillate over the field, and must be solved point by point. Optics that are not finite somewhere make the table not
    finite, and with it all that is computed from it.
    """

    def error(interpolated: Optics, truth: Optics) -> float:
        off = np.abs(interpolated[0] - truth[0]).max(initial=0.0)
        tilt = np.abs(interpolated[1] - truth[1]) * scale[:, None, None, None]
        return float(max(off, tilt.max(initial=0.0)))

    exact, counts = functools.partial(solved_optics, instrument, plan), limits.NODES_PER_SIDE
    counts = [count for count in counts if count >= (first or 0)]
    details = details_of(instrument)
    table, off = accurate_table(exact, rectangle, counts, TOLERANCE, error, details=details)
    return jax.tree.map(array, table), off

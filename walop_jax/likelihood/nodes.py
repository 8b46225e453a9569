"""The optics of a large set on Chebyshev nodes of the field, with an error that is measured every time.

Band rows and their derivatives with respect to the optical parameters are smooth over the field, and they are all
the optics there is. They are solved exactly on n × n nodes and at other places; the largest difference
between interpolated and exact values there, derivatives in units of the solver's scales, is the error.

Tolerance   A relative error ε of all n counts, each known to σ/N, moves a parameter by up to √n ε / (σ/N) of its
            standard errors: with n = 1.7·10⁹ and σ/N = 10⁻³, 10⁻² standard errors are ε = 2.4·10⁻¹⁰. Two nodes
            more per side gain a factor of 30, so that much costs little.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.likelihood import limits
from walop_jax.model import chebyshev, light
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import compiled
from walop_jax.model.dependence import optical_indices
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import values_of, with_values
from walop_jax.model.plan import Plan

Vector = Float[np.ndarray, " n"]

TOLERANCE = 2e-10


class Nodes(NamedTuple):
    """Band rows at the nodes t of a rectangle, and their derivatives with respect to the optical parameters o."""

    rectangle: Rectangle
    rows: Float[Array, "t b r 4"]
    slopes: Float[Array, "t o b r 4"]

    @property
    def per_side(self) -> int:
        """Nodes per side."""
        return round(self.rows.shape[0] ** 0.5)


def rows_and_slopes(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> tuple[Float[Array, "b r 4"], Float[Array, "o b r 4"]]:
    """Band rows at a field position and their derivatives with respect to the optical parameters: exact."""
    values, to_instrument = values_of(instrument), with_values(instrument)
    optical = np.asarray(optical_indices(instrument), int)

    def optics(optical_values: Float[Array, " o"]) -> Float[Array, "b r 4"]:
        return light.band_rows(to_instrument(values.at[optical].set(optical_values)), plan, x, y)

    rows, push = jax.linearize(optics, values[optical])
    return rows, jax.vmap(push)(jnp.eye(optical.size))


def interpolated(
    nodes: Nodes, x: Float[Array, " m"], y: Float[Array, " m"]
) -> tuple[Float[Array, "m b r 4"], Float[Array, "m o b r 4"]]:
    """Band rows and their derivatives between the nodes."""
    weights = chebyshev.weights(x, y, nodes.rectangle, nodes.per_side)
    return jnp.tensordot(weights, nodes.rows, 1), jnp.tensordot(weights, nodes.slopes, 1)


_solve = compiled(jax.vmap(rows_and_slopes, in_axes=(None, None, 0, 0)))
_interpolate = compiled(interpolated)


def _solve_all(
    instrument: Instrument, plan: Plan, x: Vector, y: Vector
) -> tuple[Float[np.ndarray, "p b r 4"], Float[np.ndarray, "p o b r 4"]]:
    parts = []
    for start in range(0, len(x), limits.SOLVED_TOGETHER):
        # The last batch is filled up with its first place.
        inside = np.minimum(np.arange(start, start + limits.SOLVED_TOGETHER), len(x) - 1)
        parts.append(_solve(instrument, plan, jnp.asarray(x[inside]), jnp.asarray(y[inside])))
    rows, slopes = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in (0, 1))
    return rows[: len(x)], slopes[: len(x)]


def held_out(rectangle: Rectangle) -> tuple[Vector, Vector]:
    """Places at which the interpolation is checked: the corners, the middles of the sides, and a spread of others.

    The others follow the sequence of Roberts 2018 (multiples of 1/φ and 1/φ², φ³ = φ + 1), which meets no grid.
    """
    corners = [(a, b) for a in (0.0, 0.5, 1.0) for b in (0.0, 0.5, 1.0)]
    plastic = 1.324717957244746
    number = np.arange(1, limits.CHECKED_PLACES - len(corners) + 1)[:, None]
    unit = np.concatenate([corners, np.mod(number * np.array([1 / plastic, 1 / plastic**2]), 1.0)])
    low, high = np.asarray(rectangle.low), np.asarray(rectangle.high)
    x, y = (low + unit * (high - low)).T
    return x, y


def tabulate(
    instrument: Instrument, plan: Plan, rectangle: Rectangle, count: int, scale: Vector
) -> tuple[Nodes, float]:
    """The optics at count × count nodes and the error between them.

    `scale` holds the solver's unit of every optical parameter. The error is the largest difference at the places of
    `held_out`; it is not finite where the optics are not.
    """
    x, y = chebyshev.grid(rectangle, count)
    other_x, other_y = held_out(rectangle)
    rows, slopes = _solve_all(instrument, plan, np.append(x, other_x), np.append(y, other_y))
    n = len(x)
    nodes = Nodes(rectangle, jnp.asarray(rows[:n]), jnp.asarray(slopes[:n]))
    near, slope = _interpolate(nodes, jnp.asarray(other_x), jnp.asarray(other_y))
    off = np.abs(np.asarray(near) - rows[n:]).max(initial=0.0)
    tilt = np.abs(np.asarray(slope) - slopes[n:]) * scale[:, None, None, None]
    return nodes, float(max(off, tilt.max(initial=0.0)))


def accurate_nodes(
    instrument: Instrument, plan: Plan, rectangle: Rectangle, scale: Vector, first: int | None = None
) -> tuple[Nodes | None, float]:
    """The smallest table (of at least `first` nodes per side) that is accurate to `TOLERANCE`, and its error.

    None where no number of nodes is enough: the optics oscillate over the field, and must be solved point by point.
    Optics that are not finite somewhere make the table not finite, and with it all that is computed from it.
    """
    error = np.inf
    for count in limits.NODES_PER_SIDE:
        if first is not None and count < first:
            continue
        nodes, error = tabulate(instrument, plan, rectangle, count, scale)
        if error <= TOLERANCE or not np.isfinite(error):
            return nodes, error
    return None, error

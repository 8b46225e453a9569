"""The optics of a large set on Chebyshev nodes of the field, with an error that is measured every time.

Band rows and their derivatives with respect to the optical parameters are smooth over the field, and they are all
the optics there is. They are solved exactly on n × n nodes and at other places (`field_table.py`); the largest
difference between interpolated and exact values there, derivatives in units of the solver's scales, is the error.

Tolerance   A relative error ε of all n counts, each known to σ/N, moves a parameter by up to √n ε / (σ/N) of its
            standard errors: with n = 1.7·10⁹ and σ/N = 10⁻³, 10⁻² standard errors are ε = 2.4·10⁻¹⁰. Two nodes
            more per side gain a factor of 30, so that much costs little.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.likelihood import limits
from walop_jax.likelihood.field_table import FieldTable, accurate_table
from walop_jax.likelihood.linear import rows_and_slopes
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import compiled
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan

Vector = Float[np.ndarray, " n"]
Optics = tuple[Float[np.ndarray, "p b r 4"], Float[np.ndarray, "p o b r 4"]]
"""Band rows, and their derivatives with respect to the optical parameters."""

TOLERANCE = 2e-10

_solve = compiled(jax.vmap(rows_and_slopes, in_axes=(None, None, 0, 0)), kept_as="nodes")


def solved_optics(instrument: Instrument, plan: Plan, x: Vector, y: Vector) -> Optics:
    """Band rows and their derivatives at field positions (deg): exact."""
    return in_batches(lambda x, y: _solve(instrument, plan, jnp.asarray(x), jnp.asarray(y)), x, y)


def in_batches(solve: Callable[[Vector, Vector], Any], x: Vector, y: Vector) -> Any:
    """What `solve` gives at field positions (deg), a tree of arrays, solved so many at a time as it is compiled for."""
    parts = []
    for start in range(0, len(x), limits.SOLVED_TOGETHER):
        # The last batch is filled up with its last place.
        inside = np.minimum(np.arange(start, start + limits.SOLVED_TOGETHER), len(x) - 1)
        parts.append(jax.tree.map(np.asarray, solve(x[inside], y[inside])))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(x)], *parts)


def accurate_nodes(
    instrument: Instrument, plan: Plan, rectangle: Rectangle, scale: Vector, first: int | None = None
) -> tuple[FieldTable | None, float]:
    """The smallest table of the optics (of at least `first` nodes per side) accurate to `TOLERANCE`, and its error.

    `scale` holds the solver's unit of every optical parameter. None where no number of nodes is enough: the optics
    oscillate over the field, and must be solved point by point. Optics that are not finite somewhere make the table not
    finite, and with it all that is computed from it.
    """

    def error(found: Optics, truth: Optics) -> float:
        off = np.abs(found[0] - truth[0]).max(initial=0.0)
        tilt = np.abs(found[1] - truth[1]) * scale[:, None, None, None]
        return float(max(off, tilt.max(initial=0.0)))

    table, off = accurate_table(
        lambda x, y: solved_optics(instrument, plan, x, y),
        rectangle,
        [count for count in limits.NODES_PER_SIDE if count >= (first or 0)],
        TOLERANCE,
        error,
    )
    return jax.tree.map(jnp.asarray, table), off

"""Some hundred field points that stand for all pixels of whole frames.

Method      Blocks of cells are given n × n field points, at the nodes of the Gauss–Legendre rule; the sums of the cells
            (`likelihood.frames`) are shared between these by their Lagrange polynomials. At each point counts and
            errors are made from the sums there: with Ω = Σ F²w² and F the mean flux
                N = F (u + Ω⁻¹ g),   σ = F Ω^(−½),
            so that the usual likelihood of these points has the gradient and the matrix of the pixels.
Gradient    That of the points differs by structure within a block. The g are changed by K J β, the least
            change in units of their errors that gives the parameters of the model the gradient of the pixels.
Limits      The matrix is that of the points. Structure that is not smooth over the frame is in the residual
            map of the fit alone. χ² is that of the points; that of the pixels is in `records.Compression`.
Source      Golub & Welsch 1969, Mathematics of Computation 23, 221 (nodes of the rule).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from numpy.polynomial import legendre

from walop_jax.data.merge import without_frames
from walop_jax.data.records import Block, CalibrationSet, Compression, Points
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.likelihood import frames, limits
from walop_jax.likelihood.inverses import whitening

SINGULAR = 1e-12  # of the largest eigenvalue: directions of the parameters without data


def _shares(edges: frames.Vector) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "c p"]]:
    """Places of the points along a side of the frame, and the contribution of each cell between `edges` to them."""
    cells, (nodes, weights) = len(edges) - 1, legendre.leggauss(limits.COMPRESSED_POINTS)
    count = len(nodes)
    scaled = legendre.legvander(nodes, count - 1) * (np.arange(count) + 0.5) * weights[:, None]
    cells_per_block = -(-cells // limits.COMPRESSED_BLOCKS)
    places, shares = [], np.zeros((cells, count * -(-cells // cells_per_block)))
    for block, first in enumerate(range(0, cells, cells_per_block)):
        last = min(first + cells_per_block, cells)
        middle, half = 0.5 * (edges[last] + edges[first]), 0.5 * (edges[last] - edges[first])
        at = (0.5 * (edges[first:last] + edges[first + 1 : last + 1]) - middle) / half
        places.append(middle + half * nodes)
        shares[first:last, count * block : count * (block + 1)] = legendre.legvander(at, count - 1) @ scaled.T
    return np.concatenate(places), shares


def compressed(expansion: frames.PixelExpansion) -> CalibrationSet:
    """The set of points that stands for all pixels near the values of an expansion, and the rows of a table beside."""
    sums = expansion.sums
    cells, likelihood = sums.cells, sums.likelihood
    (s, over), (t, up) = (_shares(edges) for edges in cells.edges())

    def shared(values: np.ndarray) -> np.ndarray:
        """Sums for the points (row by row), exposures and cameras."""
        moved = np.einsum("...rc,cs,rt->...ts", np.asarray(values), over, up, optimize=True)
        return np.moveaxis(moved.reshape(*moved.shape[:-2], -1), (-1, -2), (0, 1))

    s, t = (nodes.ravel() for nodes in np.meshgrid(s, t))
    unit = np.swapaxes(np.asarray(sums.smooth(s, t).unit), 1, 2)
    weight, pull, power = shared(sums.sums.weight), shared(sums.sums.pull), shared(sums.sums.power)
    used = (weight > 0).all(axis=2) & (power > 0)
    weight = np.where(used[..., None], weight, 0.0)
    x, y = cells.field(s, t)
    pull = _with_gradient(sums, pull, weight, unit, (x, y))
    safe = np.where(used[..., None], weight, 1.0)
    mean = np.where(used, power / np.sum(safe * unit**2, axis=2), 1.0)
    flux = np.where(likelihood.flux_known, 1.0, mean)[..., None]
    counts = np.where(used[..., None], flux * (unit + pull / safe), 0.0)
    sigma = np.where(used[..., None], flux / np.sqrt(safe), 1.0)
    calset = likelihood.calset
    block = Block(x, y, counts, sigma, used, np.full(used.shape, -1))
    beside = without_frames(calset)
    if beside is not None:
        block = Block.joined([block, beside.intensities.block(0, len(beside.points))])
    points = Points(np.arange(len(block.x), dtype=np.int32), block.x, block.y)
    names = [parameter.name for parameter in likelihood.model.parameters]
    record = Compression(
        pixels=cells.grid.pixels,
        chi2=expansion.data,
        dof=expansion.dof,
        values=dict(zip(names, sums.values.tolist(), strict=True)),
        frames=calset.inputs,
    )
    table = TableIntensities.dense(points, block)
    return dataclasses.replace(calset, points=points, intensities=table, compression=record, remarks=())


def _with_gradient(
    sums: frames.FrameSums,
    pull: Float[np.ndarray, "p e k"],
    weight: Float[np.ndarray, "p e k"],
    unit: Float[np.ndarray, "p e k"],
    place: tuple[frames.Vector, frames.Vector],
) -> Float[np.ndarray, "p e k"]:
    """The pull at points without its component along the flux, with the gradient of all pixels."""
    matrix = frames.information_of(sums, weight.T, unit.T).transpose(3, 2, 0, 1)
    inverse = np.where(weight > 0, 1.0 / np.where(weight > 0, weight, 1.0), 0.0)
    pull = np.einsum("pekl,pel->pek", matrix, inverse * pull)
    slopes = frames.unit_slopes_at(sums.likelihood, sums.instrument, *place)
    changes = np.einsum("pekl,peln->pekn", matrix, slopes, optimize=True)
    lacking = -frames.half_gradient(sums) - np.einsum("pekn,pek->n", slopes, pull)
    normal = np.einsum("pekn,pekm->nm", slopes, changes, optimize=True)
    root = whitening(normal, SINGULAR)
    return pull + changes @ (root @ (root.T @ lacking))

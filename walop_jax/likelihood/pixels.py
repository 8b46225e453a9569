"""What all pixels of whole frames say of the parameters: χ² and its quadratic expansion, from the sums of one pass.

Equation    The counts of light of unit flux, u, and their derivatives J are smooth over the frame. With ℓ_i the
            Lagrange polynomials of n × n Chebyshev nodes the half gradient of χ² and its Gauss–Newton matrix are
                −Σ_p J(x_p)ᵀ g_p = −Σ_i J(x_i)ᵀ g_i,   g_i = Σ_p ℓ_i(x_p) g_p,
                Σ_p J(x_p)ᵀ K_p J(x_p) = Σ_i J(x_i)ᵀ K_i J(x_i),   K_i = Σ_p ℓ_i(x_p) K_p,
            for J that are polynomials of degree n − 1, or half of it; g and K as in `frames`.
Limits      g is that of the pixels; K is made from Σ F²w² of cells and u in their middle, which leaves out what falls
            with the fourth power of their side (Richardson 1911): some 10⁻⁴ of a standard error in its size.
Source      Trefethen 2013, Approximation Theory and Approximation Practice, ch. 2–5 (interpolation on such nodes).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from walop_jax.data.merge import without_frames
from walop_jax.likelihood import limits
from walop_jax.likelihood.expansion import DataTerms, Posterior
from walop_jax.likelihood.flux import sharing
from walop_jax.likelihood.frames import FRAME, FrameSums, frame_sums, unit_slopes_at
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import chebyshev

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

NODES = 24  # per side for the matrix: products of two derivatives, of degree 11 and 12, are then exact


@dataclasses.dataclass(frozen=True)
class PixelPosterior(Posterior):
    """The posterior of all pixels, or of some strips of them, and the sums that it was made from."""

    sums: FrameSums


def expand(
    likelihood: Likelihood, values: Vector, noise_scale: float = 1.0, every: int = 1
) -> PixelPosterior:
    """As `Likelihood.expand`, by one pass over all pixels of frames, or over one strip in `every`.

    A table beside the frames is gone through row by row.

    Raises what `frame_sums` raises.
    """
    values = likelihood.runner.processes.agreed("values", np.asarray(values, float))
    found = frame_sums(likelihood, values, every)
    terms = DataTerms(found.chi2, half_gradient(found), gauss_newton(found), found.census)
    beside = without_frames(likelihood.calset)
    if beside is not None:
        terms = terms.joined(Likelihood.of(beside, likelihood.model).data_terms(values)[0])
    plain = likelihood.posterior(values, terms, noise_scale, found.optics)
    return PixelPosterior(**{f.name: getattr(plain, f.name) for f in dataclasses.fields(plain)}, sums=found)


def in_blocks(values: Float[np.ndarray, "... r c"], side: int) -> Float[np.ndarray, "... q d"]:
    """Sums over blocks of side × side cells; those at the far ends may be smaller."""
    if side == 1:
        return values
    rows, columns = (np.arange(0, size, side) for size in values.shape[-2:])
    return np.add.reduceat(np.add.reduceat(values, rows, axis=-2), columns, axis=-1)


def information(found: FrameSums, together: int = 1) -> Float[np.ndarray, "k k e r c"]:
    """What the pixels say of the counts for light of unit flux: the K of each cell, or of blocks of cells."""
    return information_of(found, in_blocks(found.sums.weight, together), found.unit(together))


def information_of(
    found: FrameSums, weight: Float[np.ndarray, "k ..."], unit: Float[np.ndarray, "k ..."]
) -> Float[np.ndarray, "k k ..."]:
    """K from Σ F²/σ² and the counts for light of unit flux, for any places: cameras, exposures, then these."""
    k, likelihood = len(unit), found.likelihood
    shared = sharing(found.instrument, likelihood.plan).cameras
    shared = np.ones((k, k)) if shared is None else np.asarray(shared)
    light = weight * unit
    power = np.einsum("k...,kl->l...", light * unit, shared)
    known = likelihood.flux_known.reshape(-1, *(1,) * (unit.ndim - 2))
    share = np.where(~known & (power > 0), light / np.where(power > 0, power, 1.0), 0.0)
    matrix = -np.einsum("kl,k...,l...->kl...", shared, share, light)
    matrix[np.arange(k), np.arange(k)] += weight
    return matrix


def _on_nodes(found: FrameSums, count: int, together: int) -> Float[np.ndarray, "s t e k l"]:
    """The K of all cells, or of blocks of them, on Chebyshev nodes: Σ ℓ K."""
    to = chebyshev.to_coefficients(count)
    over, up = (chebyshev.polynomials(place, count) @ to for place in found.cells.middles(together))
    return np.einsum("klerc,cs,rt->stekl", information(found, together), over, up, optimize=True)


def half_gradient(found: FrameSums) -> Vector:
    """Half gradient of χ² of all pixels in all parameters."""
    count = found.smooth.count
    to = chebyshev.to_coefficients(count)
    pull = np.einsum("jike,jt,is->stek", found.moments, to, to, optimize=True)
    pull = pull.reshape(count**2, *pull.shape[2:])
    gradient = np.zeros(len(found.values))
    for here, slopes in _slopes_on_nodes(found, count):
        gradient -= np.einsum("pekn,pek->n", slopes, pull[here], optimize=True)
    return gradient


def gauss_newton(found: FrameSums) -> Matrix:
    """Gauss–Newton matrix of half of χ² of all pixels in all parameters."""
    matrices = _on_nodes(found, NODES, 1)
    if found.every == 1:
        # K of a cell that lies in its middle errs by the square of its side: so blocks of four say by how much.
        left = (found.cells.side**2 - 1) / (3 * found.cells.side**2)
        matrices = (1.0 + left) * matrices - left * _on_nodes(found, NODES, 2)
    matrices = matrices.reshape(NODES**2, *matrices.shape[2:])
    size = len(found.values)
    matrix = np.zeros((size, size))
    for here, slopes in _slopes_on_nodes(found, NODES):
        weighted = np.einsum("pekl,peln->pekn", matrices[here], slopes, optimize=True)
        matrix += slopes.reshape(-1, size).T @ weighted.reshape(-1, size)
    return 0.5 * (matrix + matrix.T)


def _slopes_on_nodes(found: FrameSums, count: int) -> Iterator[tuple[slice, Float[np.ndarray, "p e k a"]]]:
    """Derivatives of the counts on Chebyshev nodes, some at a time."""
    x, y = found.cells.field(*chebyshev.grid(FRAME, count))
    for start in range(0, len(x), limits.SOLVED_TOGETHER):
        here = slice(start, start + limits.SOLVED_TOGETHER)
        yield here, unit_slopes_at(found.likelihood, found.instrument, x[here], y[here])

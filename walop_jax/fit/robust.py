"""Errors from the residuals of a fit: of data that scatter about the model by more than the errors that they state.

Equation    C = H⁻¹ M H⁻¹ with H the Gauss–Newton matrix of data and priors, and M the covariance of its gradient:
                scaled      M₀ = s² JᵀJ + P,  s² = χ²/dof
                grouped     M_w = B/(B − 1) Σ_b g_b g_bᵀ + P, for each way w of cutting the data into B blocks
            and C is the smallest covariance that is, in every direction, at least as large as each of these.
Symbols     J, g_b derivatives of the residuals and gradient of the rows of block b; P inverse covariance of the priors
Blocks      states: exposures at one time that differ in nothing but the filter; filters; cells of the field
Sources     s²: Birge 1932, Phys. Rev. 40, 207; sandwich: White 1982, Econometrica 50, 1; blocks: Liang & Zeger 1986,
            Biometrika 73, 13. Residuals of a wrong model hang together, so independent scatter alone is not enough;
            few blocks leave directions without any gradient, so blocks alone are not either.
Limits      data that scatter as they should, in blocks that know nothing of each other: C = H⁻¹, and a third more in
            standard errors where there are fewer blocks than parameters, as M_w is noisy then
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.search import free_scales
from walop_jax.io.shapes import Matrix, Vector
from walop_jax.likelihood import engine
from walop_jax.likelihood.inverses import root_of
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Expansion, Likelihood

ROBUST_POINTS = 4096
"""Field points whose residuals give the errors of a fit that does not explain its data."""

FEWEST_BLOCKS = 8
CELLS = 6  # of the field along a side


def robust_errors(
    likelihood: Likelihood, values: Vector, expansion: Expansion
) -> tuple[Float[np.ndarray, "f f"], str]:
    """Covariance of the free parameters from the residuals at a minimum, and its origin in words.

    `expansion` is the expansion there, `values` a full vector.
    Of a large set the blocks are those of a sample of its points, as if the others had residuals like them.
    """
    rows = likelihood.priors
    model, scale = likelihood.model, expansion.noise_scale
    unit = free_scales(model)
    prior = np.zeros((len(values), len(values)))
    prior[rows.index, rows.index] = rows.width**-2
    prior = model.selection().T @ prior @ model.selection()
    square = max(expansion.misfit, 1.0)
    bread = np.linalg.pinv(expansion.matrix * np.outer(unit, unit), hermitian=True, rcond=1e-15)
    independent = (expansion.matrix - prior) * square / scale**2 + prior
    covariance = bread @ (independent * np.outer(unit, unit)) @ bread
    ways = []
    for name, gradients in _gradients(likelihood, values):
        count = len(gradients)
        if count < FEWEST_BLOCKS:
            continue
        gradients = gradients / scale**2
        meat = count / (count - 1) * gradients.T @ gradients + prior
        covariance = larger(covariance, bread @ (meat * np.outer(unit, unit)) @ bread)
        ways.append(f"{count} {name}")
    # A FITS card has room for 68 characters.
    made_from = f"residuals: chi2/dof = {square:.4g}" + "".join(f", {way}" for way in ways)
    return covariance * np.outer(unit, unit), made_from


def larger(one: Matrix, other: Matrix) -> Matrix:
    """The smallest covariance that is at least as large as two others in every direction.

    Smallest among those that share their principal axes: where one is the unit matrix, the eigenvalues of the other
    are raised to 1.
    """
    (root,) = root_of(0.5 * (one + one.T)[None], 1e-15)
    whiten = (root / np.sum(root**2, axis=0)).T
    ratio, axis = np.linalg.eigh(whiten @ other @ whiten.T)
    spread = root @ axis
    return (spread * np.maximum(ratio, 1.0)) @ spread.T


def _gradients(likelihood: Likelihood, values: Vector) -> Iterator[tuple[str, Float[np.ndarray, "b f"]]]:
    """Gradients of the blocks, with the errors as stated, for each way of cutting the data."""
    count = likelihood.layout.points
    if count > ROBUST_POINTS:
        likelihood = Likelihood.of(thinned(likelihood.calset, ROBUST_POINTS), likelihood.model)
    share = count / likelihood.layout.points
    calset, select = likelihood.calset, likelihood.model.selection()
    instrument, cell = likelihood.model.instrument(values), field_cells(calset)
    by_exposure = np.zeros((len(calset.exposures), select.shape[1]))
    by_cell, first = np.zeros((int(cell.max(initial=0)) + 1, select.shape[1])), 0
    for batch in likelihood.points:
        found = engine.linearised_residuals(instrument, likelihood.plan, batch)
        residual = np.asarray(found.residual).reshape(batch.counts.shape)
        rows = np.asarray(found.slope).reshape(*residual.shape, -1)
        # Points that fill the last batch have no weight, and so no gradient.
        gradients = np.einsum("pekn,pek->pen", rows, residual) @ select
        by_exposure += gradients.sum(axis=0)
        inside = min(len(gradients), len(cell) - first)
        np.add.at(by_cell, cell[first : first + inside], gradients[:inside].sum(axis=1))
        first += inside
    for name, labels in (("states", states(calset)), ("filters", _labels(calset.exposures.filter))):
        grouped = np.zeros((int(labels.max(initial=0)) + 1, select.shape[1]))
        np.add.at(grouped, labels, by_exposure)
        yield name, share * grouped
    yield "cells", share * by_cell


def states(calset: CalibrationSet) -> Int[np.ndarray, " e"]:
    """Number (e) of the state of every exposure.

    Exposures of one state differ in nothing but the filter: same time, KIND and positions of everything that moves.
    """
    e = calset.exposures
    columns = [e.kind, e.mjd, e.temp, e.rotator]
    columns += [np.where(at.inside, at.angle, np.nan) for at in e.positions.values()]
    return _labels(np.array(["/".join(map(str, row)) for row in zip(*columns, strict=True)]))


def field_cells(calset: CalibrationSet) -> Int[np.ndarray, " p"]:
    """Number of the cell of every field point: the field cut into `CELLS` × `CELLS`."""
    return _labels(cut(calset.points.x, CELLS) * CELLS + cut(calset.points.y, CELLS))


def cut(values: Float[np.ndarray, " p"], count: int) -> Int[np.ndarray, " p"]:
    """Number (p) of the interval in which each value lies, of `count` intervals of equal width from the smallest value
    on.
    """
    return np.minimum((count * (values - values.min()) / (np.ptp(values) or 1.0)).astype(int), count - 1)


def _labels(values: np.ndarray) -> Int[np.ndarray, " n"]:
    return np.unique(values, return_inverse=True)[1].reshape(-1)

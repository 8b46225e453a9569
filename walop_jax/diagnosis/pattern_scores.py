"""The scores of all patterns against a fit, from one number for each exposure at a point instead of each intensity.

Equation    A pattern of camera k changes the counts of that camera alone: its column is v (e_k − m m_k) in every row,
                C_aᵀC_b = Σ v_a v_b (δ_kl − m_k m_l),   QᵀC_a = Σ v_a (Q_k − m_k (m·Q))
            and behind the base G = CᵀC − (QᵀC)ᵀ(QᵀC).
Symbols     a, b patterns of the cameras k, l; v = flux × unpolarised counts per flux / error × pattern; m = expected
            counts / errors of what has a flux in common, of unit length, 0 where the flux is known; Q orthonormal basis
            of the derivatives with respect to the free parameters
Source      `score`, `freeform`
Limits      The difference leaves 10⁻¹⁶ of the square of a column; what has less than `score.ABSORBED` left plays no
            part. Where exposures have a flux in common their rows hang together, and all columns are written out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from walop_jax.diagnosis import tall
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.freeform import Stratum, strata
from walop_jax.diagnosis.score import Scorer, ScoreSpace, ScoreTable
from walop_jax.likelihood.flux import project_flux

Vector = Float[np.ndarray, " _"]


def pattern_scores(design: Design, seed: int = 0) -> ScoreTable:
    """The scores of all patterns that the exposures allow, against a fit."""
    found = list(strata(design.measured))
    alone = design.measured.shared.exposures is None
    space, scores, square = (_from_rows if alone else _from_columns)(design, found)
    return Scorer(space, np.random.default_rng(seed))(scores, square)


def _from_columns(design: Design, found: list[Stratum]) -> tuple[ScoreSpace, Vector, float]:
    """Space, C̃ᵀr and r·r from columns of all intensities."""
    columns = design.stacked([design.measured.candidate(stratum).columns for stratum in found])
    names, widths = [stratum.name for stratum in found], [stratum.widths for stratum in found]
    space = ScoreSpace.projected(design.projector, names, widths, columns)
    residual = design.projector(design.residual)
    return space, columns.T @ residual, float(residual @ residual)


def _from_rows(design: Design, found: list[Stratum]) -> tuple[ScoreSpace, Vector, float]:
    """The same from the rows of exposures and points."""
    measured, scale = design.measured, design.fit.noise_scale
    camera = np.concatenate([stratum.camera for stratum in found])
    together, along = measured.together, measured.unit_model
    change = measured.changes(found) / scale

    products = -together[np.ix_(camera, camera)] * tall.gram(change * along[:, camera])
    for k in range(measured.cameras):
        own = np.flatnonzero(camera == k)
        products[np.ix_(own, own)] += tall.gram(change[:, own])
    residual = design.projector(design.residual)
    rows = np.column_stack([design.projector.basis, residual])[: design.rows]
    rows = project_flux(rows.T.reshape(-1, *along.shape), along, shared=measured.shared)
    both = np.empty((len(rows), len(camera)))
    for k in range(measured.cameras):
        own = np.flatnonzero(camera == k)
        both[:, own] = -rows[..., k] @ change[:, own]
    base, scores = both[:-1], both[-1]
    space = ScoreSpace(
        names=tuple(stratum.name for stratum in found),
        sizes=tuple(len(stratum.camera) for stratum in found),
        widths=np.concatenate([stratum.widths for stratum in found]),
        before=np.diag(products).copy(),
        gram=products - base.T @ base,
        free=design.projector.free,
    )
    return space, scores, float(residual @ residual)

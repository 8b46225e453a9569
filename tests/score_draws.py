"""Draws of the scores of noise, and the alarm by its own definition."""

from __future__ import annotations

import numpy as np
from scipy import stats

from walop_jax.diagnosis.score import ScoreSpace


def noise_scores(space: ScoreSpace, rng: np.random.Generator, draws: int) -> np.ndarray:
    """Scores of noise alone, one row for each draw: their covariance is the Gram matrix."""
    value, vector = np.linalg.eigh(space.gram)
    root = vector * np.sqrt(np.clip(value, 0.0, None))
    return rng.standard_normal((draws, root.shape[1])) @ root.T


def alarms(space: ScoreSpace, scores: np.ndarray, threshold: float) -> float:
    """Share of draws (rows) in which some candidate undercuts the threshold (ln p)."""
    alive, smallest = space.alive, np.zeros(len(scores))
    for at in space.places().values():
        chosen = np.arange(at.start, at.stop)[alive[at]]
        if len(chosen):
            inverse = np.linalg.pinv(space.gram[np.ix_(chosen, chosen)], rcond=1e-8, hermitian=True)
            rank = np.linalg.matrix_rank(space.gram[np.ix_(chosen, chosen)], rtol=1e-8, hermitian=True)
            statistic = np.einsum("di,ij,dj->d", scores[:, chosen], inverse, scores[:, chosen])
            smallest = np.minimum(smallest, stats.chi2.logsf(statistic, rank))
    return float(np.mean(smallest < threshold))

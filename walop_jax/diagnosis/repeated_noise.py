"""Is the noise of two exposures the same? The general test for data that are there twice, whatever was done to them.

Equation    ρ = Σ r₁·r₂ / √(Σ r₁² Σ r₂²) over the field points that two exposures share, r the residuals of each.
            Independent noise gives Σ r₁·r₂ the variance Σ tr(P₁P₂), at most (K − f) for each point, P = 1 − ŵŵᵀ being
            the rest of the noise of K cameras when f fluxes have been fitted
Symbols     ŵ expected counts / errors, of unit length; p that of a normal deviate, for all pairs at once (Šidák)
Source      correlation of independent residuals: Fisher 1915, Biometrika 10, 507; many questions: Šidák 1967
Limits      Missing effects correlate as well, and are added to the noise: a pair is named only where ρ is more
            than its squared residuals let a common pattern make. Below ρ = 0.25 nothing is named. Parameters take a
            little of the noise of all exposures together, which makes ρ smaller. Exposures that share a flux are not
            looked at. Unlike `data.repeats`, which looks for counts that agree, it needs a fit, but not many exposures,
            and sees copies that were rescaled, interpolated or averaged.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.score import local_p
from walop_jax.io.text import some

LEAST = 0.25
"""Correlation below which a common pattern of the optics cannot be separated from common noise."""


def repeated_noise(design: Design) -> Iterator[str]:
    """Sentences on exposures that hold the same noise, by their number."""
    if pairs := pairs_alike(design):
        number = design.fit.calset.exposures.exposure
        listed = [f"{number[a]} and {number[b]} (correlation {alike:.2f})" for a, b, alike in pairs]
        listed = some(listed, thresholds.SHOWN, "; ")
        yield (
            f"exposures hold the same noise, as independent ones never do: {listed}: remove one of each pair, "
            "repeated data shrink the errors"
        )


def pairs_alike(design: Design) -> list[tuple[int, int, float]]:
    """Pairs of exposures whose residuals hang together as only those of the same measurement do, closest first.

    Their positions, and the correlation.
    """
    measured = design.measured
    if measured.shared.exposures is not None:
        return []
    residual, used = design.cube(design.projector(design.residual)), measured.used.astype(float)
    cameras, flux_known = residual.shape[-1], np.broadcast_to(measured.known, used.shape)[0]
    fluxes = 1 if measured.shared.cameras is None else np.linalg.matrix_rank(measured.shared.cameras)
    free = np.where(flux_known, cameras, cameras - fluxes)
    product = np.einsum("pek,pfk->ef", residual, residual, optimize=True)
    # Of two exposures the sums run over the points that both have.
    square = np.einsum("pek,pf->ef", residual**2, used, optimize=True)
    shared = used.T @ used
    expected = shared * np.minimum.outer(free, free)
    first, second = np.triu_indices(len(free), 1)
    keep = (expected[first, second] > 0) & (square[first, second] > 0) & (square[second, first] > 0)
    first, second = first[keep], second[keep]
    if not len(first):
        return []
    first_square, second_square = square[first, second], square[second, first]
    correlation = product[first, second] / np.sqrt(first_square * second_square)
    # The fit takes something of every exposure: the noise is measured by the residuals.
    deviate = correlation * np.sqrt(expected[first, second])
    limit = -special.ndtri(local_p(thresholds.ALARM, len(first)))
    excess = 0.5 * (first_square / free[first] + second_square / free[second]) / shared[first, second] - 1.0
    pattern = correlation / np.maximum(1.0 - correlation, 1e-12)
    alike = (deviate > limit) & (correlation > LEAST) & (excess < 0.5 * pattern)
    pairs = zip(first[alike].tolist(), second[alike].tolist(), correlation[alike].tolist(), strict=True)
    return sorted(pairs, key=lambda pair: -pair[2])

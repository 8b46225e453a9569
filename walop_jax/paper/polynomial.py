"""The calibration method of Paper II (Maharana et al. 2022), as it is written: a polynomial at every grid point.

    q_i = a₁ + b₁ q_m + c₁ u_m + d₁ q_m² + e₁ u_m²      u_i = a₂ + b₂ q_m + c₂ u_m + d₂ q_m² + e₂ u_m²
    q_m = (N0 − N1)/(N0 + N1)                            u_m = (N2 − N3)/(N2 + N3)

Step 1      Unweighted least squares on the states behind the calibration polariser, point by point.
Step 2      A transmission model T_k = s₁ + s₂ q + s₃ u (+ s₄ q² + s₅ u²) per camera predicts 100 stars with
            p ≤ 5 %; the mean differences Δq, Δu between what the polynomial makes of them and what they are
            are taken off; μ and σ of what remains characterise the point.

The squares of T_k: light is linear, so s₄ = s₅ = 0; behind a polariser q² + u² is constant and they cannot be told
from s₁. They are left out. The flux of an exposure is unknown (transparency 0.7 to 1) and eliminated.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.filters import DEFAULT_FILTER
from walop_jax.data.records import CalibrationSet
from walop_jax.io.errors import DataError
from walop_jax.model.conventions import EXTINCTION
from walop_jax.science.star_errors import QuPairs, sample_stars, transmitted

TERMS = ("1", "qm", "um", "qm^2", "um^2")
_ROUNDS = 300  # of alternating least squares for transmissions and fluxes; 40 are enough


def measured_qu(counts: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 2"]:
    """Measured (q_m, u_m) of four intensities."""
    n0, n1, n2, n3 = np.moveaxis(counts, -1, 0)
    return np.stack([(n0 - n1) / (n0 + n1), (n2 - n3) / (n2 + n3)], axis=-1)


def polynomial_terms(measured: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 5"]:
    """The terms of the polynomial (`TERMS`) at measured (q_m, u_m)."""
    q, u = measured[..., 0], measured[..., 1]
    return np.stack([np.ones_like(q), q, u, q**2, u**2], axis=-1)


@dataclasses.dataclass(frozen=True)
class PaperCalibration:
    """Paper II's calibration at grid points `x`, `y` (deg), for one filter with the calibration plate out.

    `coefficients` (point, q or u, term); `transmission` (point, camera, 1 q u) with mean 1 at unpolarised light;
    `delta` (Δq, Δu) as found with the transmissions; `spread` σ_q, σ_u of the test stars after it;
    `condition` of the design matrix with columns scaled to unit length.
    """

    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    coefficients: Float[np.ndarray, "p 2 5"]
    transmission: Float[np.ndarray, "p 4 3"]
    delta: Float[np.ndarray, "p 2"]
    spread: Float[np.ndarray, "p 2"]
    condition: Float[np.ndarray, " p"]

    def recover(self, measured: Float[np.ndarray, "p n 2"]) -> Float[np.ndarray, "p n 2"]:
        """(q_i, u_i) − (Δq, Δu) of measurements at the grid points."""
        return np.einsum("pnt,pct->pnc", polynomial_terms(measured), self.coefficients) - self.delta[:, None]

    def between(self, x: Float[np.ndarray, " m"], y: Float[np.ndarray, " m"]) -> PaperCalibration:
        """Coefficients and Δ interpolated bilinearly to other positions: what the paper says cannot be done.

        Raises ValueError where the points are no regular grid.
        """
        across, along = np.unique(self.x), np.unique(self.y)
        if len(across) * len(along) != len(self.x) or min(len(across), len(along)) < 2:
            raise ValueError("the points with polariser exposures are no regular grid: nothing between them")
        order = np.lexsort((self.x, self.y)).reshape(len(along), len(across))
        i = np.clip(np.searchsorted(across, x) - 1, 0, len(across) - 2)
        j = np.clip(np.searchsorted(along, y) - 1, 0, len(along) - 2)
        s = (x - across[i]) / (across[i + 1] - across[i])
        t = (y - along[j]) / (along[j + 1] - along[j])
        corners = [((1 - s) * (1 - t), 0, 0), (s * (1 - t), 0, 1), ((1 - s) * t, 1, 0), (s * t, 1, 1)]

        def mixed(values: np.ndarray) -> np.ndarray:
            shape = (-1,) + (1,) * (values.ndim - 1)
            parts = [w.reshape(shape) * values[order[j + b, i + a]] for w, b, a in corners]
            return np.sum(parts, axis=0)

        fields = ("coefficients", "transmission", "delta", "spread", "condition")
        return PaperCalibration(x, y, *(mixed(getattr(self, name)) for name in fields))


def polariser_exposures(calset: CalibrationSet, filter_name: str = DEFAULT_FILTER) -> Int[np.ndarray, " e"]:
    """Exposures through the polariser in a filter with the calibration plate out.

    Raises `DataError` if there are fewer than five: the polynomial has five coefficients.
    """
    e = calset.exposures
    rows = np.flatnonzero(e.clp_in & ~e.chwp_in & (e.filter == filter_name))
    angles = len(np.unique(np.round(np.mod(e.clp_angle[rows], 180.0), 6)))
    if angles < len(TERMS):
        raise DataError(
            f"EXPOSURES: {angles} polariser angles (modulo 180°) in {filter_name} with the calibration plate out; "
            f"the polynomial of Paper II needs {len(TERMS)}: observe more angles, or name another --filter"
        )
    return rows


def fit_paper(
    calset: CalibrationSet, filter_name: str = DEFAULT_FILTER, stars: QuPairs | None = None
) -> PaperCalibration:
    """Steps 1 and 2 of Paper II at all points that have all polariser exposures.

    Raises `DataError` if there are too few angles, or no such point.
    """
    rows = polariser_exposures(calset, filter_name)
    block = calset.intensities.block(0, len(calset.points))
    whole = np.flatnonzero(block.used[:, rows].all(axis=1))
    if whole.size == 0:
        raise DataError("INTENSITIES: no point has been measured at all polariser angles")
    counts = block.counts[whole][:, rows]
    states = polariser_states(calset.exposures.clp_angle[rows])
    coefficients, condition = fit_polynomials(measured_qu(counts), states)
    transmission = fit_transmissions(counts, states)
    return with_test_stars(block.x[whole], block.y[whole], coefficients, condition, transmission, stars)


def with_test_stars(
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
    coefficients: Float[np.ndarray, "p 2 5"],
    condition: Float[np.ndarray, " p"],
    transmission: Float[np.ndarray, "p 4 3"],
    stars: QuPairs | None = None,
) -> PaperCalibration:
    """Step 2: Δ and σ of the test stars (default: `sample_stars()`) seen through the transmissions."""
    stars = sample_stars() if stars is None else stars
    found = np.einsum(
        "pnt,pct->pnc", polynomial_terms(measured_qu(transmitted(transmission, stars))), coefficients
    )
    error = found - stars
    return PaperCalibration(
        x, y, coefficients, transmission, error.mean(axis=1), error.std(axis=1, ddof=1), condition
    )


def polariser_states(angle: Float[np.ndarray, " e"]) -> QuPairs:
    """(q, u) behind the polariser at `angle` (deg)."""
    c = (1.0 - EXTINCTION) / (1.0 + EXTINCTION)
    two = 2.0 * np.deg2rad(angle)
    return c * np.stack([np.cos(two), np.sin(two)], axis=1)


def fit_polynomials(
    measured: Float[np.ndarray, "p e 2"], states: QuPairs
) -> tuple[Float[np.ndarray, "p 2 5"], Float[np.ndarray, " p"]]:
    """Coefficients at every point by least squares, and the condition number of the scaled design matrix."""
    design = polynomial_terms(measured)
    scale = np.linalg.norm(design, axis=1)
    u, size, vt = np.linalg.svd(design / scale[:, None], full_matrices=False)
    solution = np.einsum("pst,ps,pes,ec->pct", vt, 1.0 / size, u, states, optimize=True)
    return solution / scale[:, None], size[:, 0] / size[:, -1]


def fit_transmissions(counts: Float[np.ndarray, "p e 4"], states: QuPairs) -> Float[np.ndarray, "p 4 3"]:
    """T_k at every point, with the flux of every exposure free: alternating least squares.

    Given the fluxes the transmissions are linear, and the other way round. Photon noise weighs 1/N; the mean of
    the four T_k of unpolarised light is 1.
    """
    s = np.concatenate([np.ones((len(states), 1)), states], axis=1)
    weight = 1.0 / np.maximum(counts, 0.01 * counts.mean(axis=(1, 2), keepdims=True))
    flux = counts.sum(axis=2)
    vectors = np.zeros((len(counts), 4, 3))
    for _ in range(_ROUNDS):
        left = np.einsum("pek,pe,ei,ej->pkij", weight, flux**2, s, s, optimize=True)
        right = np.einsum("pek,pe,pek,ei->pki", weight, flux, counts, s, optimize=True)
        vectors = np.linalg.solve(left, right[..., None])[..., 0]
        vectors /= vectors[..., 0].mean(axis=1)[:, None, None]
        model = np.einsum("pki,ei->pek", vectors, s)
        flux = np.sum(weight * model * counts, axis=2) / np.sum(weight * model**2, axis=2)
    return vectors

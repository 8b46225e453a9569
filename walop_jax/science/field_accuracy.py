"""How well a calibration knows the degree of polarisation over the field: what its covariance promises.

Stars with p ≤ 5 % at any angle, without photon noise. An error δm of the instrument matrix makes
δ(q, u) = −M⁻¹ (δm₁ + δM (q, u)), hence its variance along the polarisation, averaged over the stars, is the error of p.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.science.star_errors import GOAL, sample_stars

SIZE = 31  # points along each axis of the map


@dataclasses.dataclass(frozen=True)
class FieldAccuracy:
    """Standard error of p (a fraction) over the field, from the calibration alone: rms over stars with p ≤ 5 %.

    `extent` is left, right, bottom and top in degrees.
    """

    error: Float[np.ndarray, "y x"]
    extent: tuple[float, float, float, float]
    filter: str

    @property
    def share(self) -> float:
        """Share of the field in which the error is below 0.1 %."""
        return float(np.mean(self.error < GOAL))

    @property
    def median(self) -> float:
        """Median over the field."""
        return float(np.median(self.error))


def p_errors(
    matrix: Float[np.ndarray, "p 6"], covariance: Float[np.ndarray, "p 6 6"], stars: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " p"]:
    """Error of p for stars (q, u), rms over them, from the six elements of the matrix and their covariance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        (a, b), (c, d) = matrix[:, 1:3].T, matrix[:, 4:].T
        inverse = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], 1) / (a * d - b * c)[:, None, None]
        along = stars / np.hypot(*stars.T)[:, None]
        s = np.concatenate([np.ones((len(stars), 1)), stars], axis=1)
        # δp = −e · M⁻¹ · (δm s): a linear form of the six elements for every star.
        left = np.einsum("nc,pcr->pnr", along, inverse)
        form = np.einsum("pnr,ns->pnrs", left, s).reshape(len(matrix), len(stars), 6)
        variance = np.einsum("pni,pij,pnj->pn", form, covariance, form, optimize=True)
        return np.sqrt(np.mean(variance, axis=1))


def field_accuracy(calibration: Calibration, size: int = SIZE) -> FieldAccuracy | None:
    """The map for an instrument with two arms, in the usual settings; None for others: they need several exposures."""
    if len(calibration.model.template.arms) != 2:
        return None
    used = [str(name) for name in np.unique(calibration.exposures.filter)]
    settings = calibration.usual_settings()
    if str(settings.filter[0]) not in used:
        settings = calibration.usual_settings(filter_name=used[0])
    low_x, high_x, low_y, high_y = calibration.field
    x, y = np.meshgrid(np.linspace(low_x, high_x, size), np.linspace(low_y, high_y, size))
    matrix, covariance = calibration.matrix(x.ravel(), y.ravel(), settings)
    error = p_errors(matrix, covariance, sample_stars()).reshape(size, size)
    return FieldAccuracy(error, calibration.field, str(settings.filter[0]))

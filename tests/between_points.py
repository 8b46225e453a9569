"""How far a calibration is off between the grid points of a set whose true matrix is known there."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.io import fits

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.settings import Settings

EASY = 0.1  # determinant of the 2 × 2 matrix above which one exposure holds q and u
P, ANGLES = 0.05, 24  # of the sources that the errors are of
WORST = 3.3
"""Times its expected rms, an error may be this large with a probability below 0.1 %.

Its square is a weighted sum of squares of normal variables; the upper tail of such a sum is largest where a single
one has all the weight (Székely & Bakirov 2003, Probab. Theory Relat. Fields 126, 184): then it is χ² of one degree.
"""


class BetweenPoints(NamedTuple):
    """Rms errors of q and u (%) where one exposure holds both, and as the covariance of the calibration has them.

    `pulls` (point, element) of the matrix, and the share of points where one exposure holds both.
    """

    error: np.ndarray
    expected: np.ndarray
    pulls: np.ndarray
    easy: float


def sources() -> np.ndarray:
    """(q, u) of sources of polarisation `P` at all angles."""
    phase = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    return P * np.stack([np.cos(phase), np.sin(phase)])


def calibration_error(true: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Rms error of (q, u) over the sources, at each point.

    (q_m, u_m) are made with the true matrix and inverted with the fitted one.
    """
    light = sources()
    blocks, offsets = ([1, 2, 4, 5], [0, 3])
    measured = true[:, blocks].reshape(-1, 2, 2) @ light + true[:, offsets, None]
    found = np.linalg.solve(fitted[:, blocks].reshape(-1, 2, 2), measured - fitted[:, offsets, None])
    return np.sqrt(np.mean((found - light) ** 2, axis=2))


def expected_error(fitted: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The same to first order from the covariance (point, 6, 6) of the matrix: δs = −M⁻¹ (δo + δM s)."""
    inverse = np.linalg.inv(fitted[:, [1, 2, 4, 5]].reshape(-1, 2, 2))
    squares = np.zeros((len(fitted), 2))
    for s in sources().T:
        row = np.array([1.0, *s])
        gain = inverse @ np.kron(np.eye(2), row)
        squares += np.einsum("pij,pjk,pik->pi", gain, covariance, gain)
    return np.sqrt(squares / ANGLES)


def between_points(truth: Path, calibration: Calibration) -> BetweenPoints:
    """Hold a calibration against a table of true matrices."""
    with fits.open(truth) as hdus:
        table = hdus[1].data
        true = np.stack([table[m].astype(float) for m in ("M21", "M22", "M23", "M31", "M32", "M33")], axis=1)
        x, y = table["X"].astype(float), table["Y"].astype(float)
    settings = dataclasses.replace(Settings.default(len(x)), teff=np.full(len(x), 5772.0))
    fitted, covariance = calibration.matrix(x, y, settings)
    easy = np.abs(true[:, 1] * true[:, 5] - true[:, 2] * true[:, 4]) >= EASY
    error, expected = (
        100.0 * np.sqrt(np.mean(values[easy] ** 2, axis=0))
        for values in (calibration_error(true, fitted), expected_error(fitted, covariance))
    )
    pulls = (fitted - true) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return BetweenPoints(error, expected, pulls, float(easy.mean()))

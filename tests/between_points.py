"""How far a calibration is off between the grid points of a set whose true matrix is known there."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from astropy.io import fits

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import Settings

EASY = 0.1  # determinant of the 2 × 2 matrix above which one exposure holds q and u


def calibration_error(true: np.ndarray, fitted: np.ndarray, p: float = 0.05, angles: int = 24) -> np.ndarray:
    """Rms error of (q, u) over the angles of a source of polarisation p, at each point.

    (q_m, u_m) are made with the true matrix and inverted with the fitted one.
    """
    phase = 2.0 * np.pi * np.arange(angles) / angles
    light = p * np.stack([np.cos(phase), np.sin(phase)])
    blocks, offsets = ([1, 2, 4, 5], [0, 3])
    measured = true[:, blocks].reshape(-1, 2, 2) @ light + true[:, offsets, None]
    found = np.linalg.solve(fitted[:, blocks].reshape(-1, 2, 2), measured - fitted[:, offsets, None])
    return np.sqrt(np.mean((found - light) ** 2, axis=2))


def between_points(truth: Path, calibration: Calibration) -> tuple[np.ndarray, np.ndarray, float]:
    """Rms errors of q and u (%) where one exposure holds both, pulls of the matrix, share of such points."""
    with fits.open(truth) as hdus:
        table = hdus[1].data
        true = np.stack([table[m].astype(float) for m in ("M21", "M22", "M23", "M31", "M32", "M33")], axis=1)
        x, y = table["X"].astype(float), table["Y"].astype(float)
    settings = dataclasses.replace(Settings.default(len(x)), teff=np.full(len(x), 5772.0))
    fitted, covariance = calibration.matrix(x, y, settings)
    easy = np.abs(true[:, 1] * true[:, 5] - true[:, 2] * true[:, 4]) >= EASY
    error = 100.0 * np.sqrt(np.mean(calibration_error(true, fitted)[easy] ** 2, axis=0))
    pulls = (fitted - true) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return error, pulls, float(easy.mean())

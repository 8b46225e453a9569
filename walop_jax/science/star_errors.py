"""Errors of calibrated stars: of q, u and p over the field, true or promised.

Test stars with p ≤ 5 % are seen, noise-free, through *reference* analysis vectors and recovered with a calibration; the
error at a field point is the rms over the stars.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.calibration.accuracy import GOAL
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.data.settings import Settings
from walop_jax.io.shapes import OfPoints
from walop_jax.science.estimate import estimate

QUANTITIES = ("q", "u", "p")
_ELECTRONS = 1e6  # of the stars; their photon noise does not enter

RowVectors = Float[np.ndarray, "p *r k 3"]
"""Analysis vectors at field points, of one exposure or of several (r) in which a star is seen."""
QuPairs = Float[np.ndarray, "n 2"]
CameraPairs = tuple[tuple[int, int], ...]


def transmitted(vectors: RowVectors, stars: QuPairs) -> Float[np.ndarray, "p n *r k"]:
    """Counts (point, star, camera) of sources of unit flux."""
    s = np.concatenate([np.ones((len(stars), 1)), stars], axis=1)
    return np.einsum("p...ks,ns->pn...k", vectors, s)


class Truth(NamedTuple):
    """True instrument matrices (m21, m22, …) at field positions (deg), for the colour of the polariser's source."""

    x: OfPoints
    y: OfPoints
    matrix: Float[np.ndarray, "p m"]


Errors = Float[np.ndarray, "p 3"]


def star_errors(found: Float[np.ndarray, "p n 2"], stars: Float[np.ndarray, "n 2"]) -> Errors:
    """Errors of q, u and p at every point, rms over the stars."""
    degree = np.hypot(*np.moveaxis(found, -1, 0)) - np.hypot(*stars.T)
    return np.sqrt(np.stack([*np.mean((found - stars) ** 2, axis=1).T, np.mean(degree**2, axis=1)], axis=1))


def joint_errors(vectors: RowVectors, reference: RowVectors, stars: Float[np.ndarray, "n 2"]) -> Errors:
    """Errors of stars seen through `reference` and recovered, noise-free, with the vectors of a calibration."""
    counts = _ELECTRONS * transmitted(reference, stars)
    p, n, cameras = *counts.shape[:2], counts.shape[-1]
    rows = counts.reshape(-1, cameras)
    star = np.repeat(np.arange(p * n), len(rows) // (p * n))
    stokes = estimate(np.repeat(vectors, n, axis=0).reshape(-1, cameras, 3), rows, np.sqrt(rows), star)
    return star_errors(stokes.qu.reshape(p, n, 2), stars)


def promised_errors(
    analysis: AnalysisVectors, setting: Settings, x: OfPoints, y: OfPoints, stars: Float[np.ndarray, "n 2"]
) -> Errors:
    """Errors that the calibration promises, by its covariance and the structure of field points; rms over the stars."""
    vectors = analysis.coloured(setting, x, y)
    counts = _ELECTRONS * transmitted(vectors, stars)
    n, rows = len(stars), counts.reshape(-1, counts.shape[-1])
    repeated, star = np.repeat(vectors, n, axis=0), np.arange(len(rows))
    stokes = estimate(repeated, rows, np.sqrt(rows), star, analysis.instrument.cameras)
    local = analysis.derivatives(setting, x, y, np.full(len(x), np.nan))
    gain = stokes.gain.reshape(len(x), n, 2, -1)
    s = np.concatenate([np.ones((n, 1)), stars], axis=1)
    structure, degree = analysis.calibration.verdict.structure, np.hypot(*stars.T)
    of_point = (
        np.hypot(structure.gain, structure.response * degree)[:, None, None] * counts[:, :, None] / _ELECTRONS
    )
    total = np.zeros((len(x), 3))
    for k in range(n):
        plain, throughput = (gain[:, k] @ np.einsum("s,pksf->pkf", s[k], slopes) for slopes in local)
        root = analysis.to_parameters(plain, throughput, x, y) @ analysis.root
        root = np.concatenate([root, gain[:, k] * of_point[:, k]], axis=2)
        radial = np.einsum("c,pck->pk", stars[k] / degree[k], root)
        total += np.stack([*np.sum(root**2, axis=2).T, np.sum(radial**2, axis=1)], axis=1)
    return np.sqrt(total / n)


def plate_errors(
    analysis: AnalysisVectors, settings: Sequence[Settings], x: OfPoints, y: OfPoints
) -> OfPoints:
    """Photon error of (q, u) in the worse direction for an unpolarised star seen once through each setting.

    In units of the error of q that an ideal instrument would have with the same light: 1 for a single exposure of
    an ideal instrument, large where the settings carry almost no information on u.
    """
    r, n = len(settings), len(x)
    rows = np.stack([analysis.exact(s, x, y)[:, 0] for s in settings], axis=1)
    counts = _ELECTRONS * rows[..., 0]
    expected, star = counts.reshape(n * r, -1), np.repeat(np.arange(n), r)
    flat, cameras = rows.reshape(n * r, -1, 3), analysis.instrument.cameras
    stokes = estimate(flat, expected, np.sqrt(expected), star, cameras)
    worst = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(stokes.photon, nan=np.inf))[:, 1])
    # q from a normalised difference with half of the electrons: σ² = 2 / all electrons.
    return worst / np.sqrt(2.0 / counts.sum(axis=(1, 2)))


def determinant(vectors: RowVectors, pairs: CameraPairs | None = None) -> OfPoints:
    """Information of the exposures on (q, u) at every point: |m22 m33 − m23 m32| for one exposure of two arms.

    In general the root of det MᵀM, M having a row (m22, m23) for every arm and exposure: 0 where all see the same
    direction. `pairs` are the cameras of the arms; None takes them two by two.
    """
    first, second = (vectors[..., cameras, :] for cameras in np.array(pairs or _two_by_two(vectors)).T)
    rows = ((first - second)[..., 1:] / (first + second)[..., :1]).reshape(len(vectors), -1, 2)
    return np.sqrt(np.maximum(np.linalg.det(rows.swapaxes(1, 2) @ rows), 0.0))


def _two_by_two(vectors: RowVectors) -> CameraPairs:
    return tuple((k, k + 1) for k in range(0, vectors.shape[-2], 2))


def statistics(errors: Errors, chosen: Bool[np.ndarray, " p"] | None = None) -> dict[str, dict[str, float]]:
    """Median, rms, 95 % and maximum over the field of each error in per cent; fraction of the field under 0.1 %."""
    numbers = {}
    for name, values in zip(QUANTITIES, (errors if chosen is None else errors[chosen]).T, strict=True):
        sizes = np.median(values), np.sqrt(np.mean(values**2)), np.quantile(values, 0.95), np.max(values)
        percent = (100.0 * float(size) for size in sizes)
        numbers[name] = dict(zip(("median", "rms", "p95", "max"), percent, strict=True))
        numbers[name]["share_below_goal"] = float(np.mean(values < GOAL))
    return numbers


@dataclasses.dataclass(frozen=True)
class MethodErrors:
    """Errors of both methods at some field points; `zone` marks |m22 m33 − m23 m32| < 0.1."""

    x: OfPoints
    y: OfPoints
    paper: Errors
    joint: Errors
    zone: Bool[np.ndarray, " p"]

    def document(self) -> dict[str, Any]:
        """Statistics of both methods over all points and outside the zone without u."""
        out: dict[str, Any] = {"points": len(self.x), "in_zone": int(self.zone.sum())}
        for name, errors in (("paper", self.paper), ("joint", self.joint)):
            out[name] = {"all": statistics(errors), "outside_zone": statistics(errors, ~self.zone)}
        ratio = np.sqrt(np.mean(self.paper**2, axis=0) / np.mean(self.joint**2, axis=0))
        out["rms_ratio"] = dict(zip(QUANTITIES, ratio.tolist(), strict=True))
        return out


def truth_vectors(joint: RowVectors, matrix: Float[np.ndarray, "p m"]) -> RowVectors:
    """Analysis vectors with true matrices (m21, m22, …) and, what these do not hold, the sums of the joint model.

    a± = ½ (S ± S₀ m) with S the sum of a pair of cameras, which follow each other; an error of S is second order in p.
    """
    vectors = np.empty_like(joint)
    rows = matrix.reshape(len(matrix), -1, 3).swapaxes(0, 1)
    for (i, j), row in zip(_two_by_two(joint), rows, strict=True):
        total = joint[:, i] + joint[:, j]
        difference = total[:, :1] * row
        vectors[:, i], vectors[:, j] = 0.5 * (total + difference), 0.5 * (total - difference)
    return vectors

"""Maximum likelihood on intensities: from the counts of a star's rows to one (q, u) and its covariance.

    N_jk = F_j a_jk · s + noise of σ_jk,    s = (1, q, u)

Row j is an exposure with cameras k; its flux F_j is unknown, (q, u) is shared by all rows of a star.

Sufficient  With w = 1/σ² (0: camera not used), G_j = Σ_k w a aᵀ and b_j = Σ_k w a N are all that the likelihood
            needs: the best flux is F = b·s / sᵀG s, and χ²_j = Σ w N² − (b·s)² / sᵀG s.
Step        Gradient ½∂(−χ²)/∂s = F b − F² G s; information F² (G − G s sᵀ G / sᵀG s), both in (q, u), summed over
            rows: Gauss–Newton with the flux eliminated (variable projection, Golub & Pereyra 2003, Inverse
            Problems 19, R1). A single row has three linear unknowns F (1, q, u): its exact minimum is where
            the steps start.
Covariance  Photons: H = (Σ_j information)⁻¹. Calibration: δ(q, u) = −Σ_j c_j · (δa_j · s) with
            c_j = H J_jᵀ w F_j, J_j the derivative of F_j a_j·s with the flux eliminated. Rows share one
            calibration, so the sum is taken before it is squared: errors that rows have in common add up or
            cancel as they do in truth. (Terms of order residual / counts are left out.)
Bias        Of order 1/N, as for any ratio: below 1e-5 from 10⁵ electrons a camera. σ should not be √N of
            fewer than some hundred electrons: then low counts get too much weight.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.io.shapes import ByRowAndCamera, RowIndex
from walop_jax.likelihood.flux import project_flux
from walop_jax.model.cameras import Cameras

STEPS = 40
CONVERGED = 1e-13  # of the largest step in q, u, or 1e-9 σ
SINGULAR = 1e-13  # determinant over squared mean of an information matrix
_SETTLED = 1e-9

Rows3 = Float[np.ndarray, "r 3"]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """(q, u) of every star (s), NaN where its rows do not hold both.

    `photon` is the covariance from the noise of the counts; `condition` the square root of the condition number of the
    information (1: q and u equally well known); `chi2` and `dof` belong to the rows of a star, `flux` F (in counts of
    unpolarised light at unit throughput) to every row and camera, `gain` to every row: δ(q, u) = −Σ gain · δ(model /
    F).
    """

    qu: Float[np.ndarray, "s 2"]
    photon: Float[np.ndarray, "s 2 2"]
    condition: Float[np.ndarray, " s"]
    chi2: Float[np.ndarray, " s"]
    dof: Int[np.ndarray, " s"]
    flux: ByRowAndCamera
    gain: Float[np.ndarray, "r 2 k"]

    def relative(self, change: ByRowAndCamera) -> ByRowAndCamera:
        """Changes of counts over the flux, δ(model / F); 0 where there is no light."""
        return np.nan_to_num(change) / np.where(self.flux > 0, self.flux, np.inf)


def estimate(
    vectors: Float[np.ndarray, "r k 3"],
    counts: ByRowAndCamera,
    sigma: ByRowAndCamera,
    star: RowIndex,
    cameras: Cameras | None = None,
) -> Estimate:
    """Stokes parameters of stars from rows of intensities.

    A row of two cameras holds one combination of q and u: such a star needs several settings, or is NaN. Where the
    fractions of the arms in the light are not known (`cameras.split`), each arm has a flux of its own in every row.

    `vectors` (row, camera, Stokes) are the analysis vectors in the frame that (q, u) are wanted in; counts that
    are not finite, or whose `sigma` is not finite and above 0, are not used. `star` numbers the stars from 0
    in ascending order: the rows of a star follow each other.
    """
    if cameras is not None and cameras.split:
        count, arms = counts.shape[1], len(cameras.arms)
        mine = np.array([np.isin(np.arange(count), members) for members in cameras.arms])
        measured = np.where(mine, counts[:, None], np.nan).reshape(-1, count)
        row = np.repeat(np.arange(len(counts)), arms)
        of_arms = estimate(vectors[row], measured, sigma[row], star[row])
        flux = of_arms.flux.reshape(-1, arms, count)[:, mine.argmax(axis=0), np.arange(count)]
        gain = of_arms.gain.reshape(-1, arms, 2, count).sum(axis=1)
        return dataclasses.replace(of_arms, flux=flux, gain=gain)
    used = np.isfinite(counts) & np.isfinite(sigma) & (sigma > 0)
    weight = np.where(used, 1.0 / np.where(used, sigma, 1.0) ** 2, 0.0)
    data = np.where(used, counts, 0.0)
    gram = np.einsum("rk,rki,rkj->rij", weight, vectors, vectors, optimize=True)
    moment = np.einsum("rk,rki->ri", weight * data, vectors)
    first = np.flatnonzero(np.diff(star, prepend=-1))
    qu, settled = _minimise(gram, moment, star, first)
    flux, _, information = _expansion(gram, moment, qu[star])
    photon, condition = _inverse(np.add.reduceat(information, first))
    bad = ~settled | ~np.isfinite(condition)
    qu[bad], photon[bad] = np.nan, np.nan

    s = _stokes(qu[star])
    model = np.einsum("rki,ri->rk", vectors, s)
    root = np.sqrt(weight)
    tangent = project_flux(np.moveaxis(vectors[..., 1:], -1, 0) * root, model * root)
    # F cancels between c = H Jᵀ w F with J = F tangent, so gain times δa·s is the shift of (q, u).
    gain = np.einsum("rij,jrk,rk->rik", photon[star], tangent, root * flux[:, None] ** 2, optimize=True)
    residual = np.einsum("rk,rk->r", weight, (data - flux[:, None] * model) ** 2)
    chi2 = np.add.reduceat(residual, first)
    dof = np.add.reduceat(used.sum(axis=1) - used.any(axis=1), first) - 2
    flux = np.repeat(flux[:, None], counts.shape[1], axis=1)
    return Estimate(qu, photon, condition, chi2, dof, flux, gain)


def calibration_shift(
    gain: Float[np.ndarray, "r 2 k"], change: Float[np.ndarray, "r k m"], star: RowIndex
) -> Float[np.ndarray, "s 2 m"]:
    """Shift of every star's (q, u) when the model counts per unit flux of its rows change by `change`.

    The last axis counts alternatives (parameters, other spectra). First order in the change.
    """
    first = np.flatnonzero(np.diff(star, prepend=-1))
    return -np.add.reduceat(gain @ change, first)


def _stokes(qu: Float[np.ndarray, "r 2"]) -> Rows3:
    return np.concatenate([np.ones((len(qu), 1)), qu], axis=1)


def _expansion(
    gram: Float[np.ndarray, "r 3 3"], moment: Rows3, qu: Float[np.ndarray, "r 2"]
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r 2"], Float[np.ndarray, "r 2 2"]]:
    """Flux, half gradient of −χ² and information of every row at its star's (q, u)."""
    s = _stokes(qu)
    along = np.einsum("rij,rj->ri", gram, s)
    power = np.einsum("ri,ri->r", along, s)
    flux = np.einsum("ri,ri->r", moment, s) / np.where(power > 0, power, 1.0)
    gradient = flux[:, None] * (moment - flux[:, None] * along)[:, 1:]
    inner = along[:, 1:]
    share = inner[:, :, None] * inner[:, None, :] / np.where(power > 0, power, 1.0)[:, None, None]
    return flux, gradient, flux[:, None, None] ** 2 * (gram[:, 1:, 1:] - share)


def _inverse(
    matrix: Float[np.ndarray, "s 2 2"],
) -> tuple[Float[np.ndarray, "s 2 2"], Float[np.ndarray, " s"]]:
    """Inverse of symmetric 2 × 2 matrices and the square root of their condition numbers; NaN where singular."""
    a, b, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    mean, half = 0.5 * (a + d), np.hypot(0.5 * (a - d), b)
    determinant = a * d - b * b
    good = determinant > SINGULAR * mean**2
    safe = np.where(good, determinant, 1.0)
    adjoint = np.stack([np.stack([d, -b], axis=-1), np.stack([-b, a], axis=-1)], axis=-2)
    inverse = adjoint / safe[:, None, None]
    condition = np.where(good, (mean + half) / np.sqrt(safe), np.inf)
    return np.where(good[:, None, None], inverse, np.nan), condition


def _start(
    gram: Float[np.ndarray, "r 3 3"], moment: Rows3, star: RowIndex, first: Int[np.ndarray, " s"]
) -> Float[np.ndarray, "s 2"]:
    """The exact minimum F (1, q, u) = G⁻¹ b for stars of one row, (0, 0) for the others."""
    start = np.zeros((len(first), 2))
    single = first[np.diff(first, append=len(star)) == 1]
    scale = np.sqrt(np.maximum(np.einsum("rii->ri", gram[single]), 1e-300))
    scaled = gram[single] / (scale[:, :, None] * scale[:, None, :])
    regular = np.linalg.det(scaled) > SINGULAR
    single, scale, scaled = single[regular], scale[regular], scaled[regular]
    solution = np.linalg.solve(scaled, (moment[single] / scale)[..., None])[..., 0] / scale
    bright = solution[:, 0] > 0
    start[star[single[bright]]] = solution[bright, 1:] / solution[bright, :1]
    return start


def _minimise(
    gram: Float[np.ndarray, "r 3 3"], moment: Rows3, star: RowIndex, first: Int[np.ndarray, " s"]
) -> tuple[Float[np.ndarray, "s 2"], Bool[np.ndarray, " s"]]:
    """(q, u) of least χ², and for which stars the steps have settled at a flux above 0."""
    qu = _start(gram, moment, star, first)
    settled = np.zeros(len(qu), bool)
    going = np.ones(len(qu), bool)
    for _ in range(STEPS):
        rows = going[star]
        stars = np.flatnonzero(going)
        where = np.flatnonzero(np.diff(star[rows], prepend=-1))
        flux, gradient, information = _expansion(gram[rows], moment[rows], qu[star[rows]])
        covariance, _ = _inverse(np.add.reduceat(information, where))
        step = np.einsum("sij,sj->si", covariance, np.add.reduceat(gradient, where))
        finite = np.all(np.isfinite(step), axis=1)
        qu[stars[finite]] += step[finite]
        with np.errstate(invalid="ignore"):
            error = np.sqrt(np.einsum("sii->si", covariance))
            small = np.all(np.abs(step) <= np.maximum(CONVERGED, _SETTLED * error), axis=1)
        lit = np.maximum.reduceat(flux, where) > 0
        settled[stars] = small & lit & finite
        going[stars] = finite & ~small
        if not going.any():
            break
    return qu, settled

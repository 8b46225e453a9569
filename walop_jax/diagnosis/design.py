"""One fit laid out for linear algebra: residuals, Jacobian, priors as rows, and where every row comes from."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.diagnosis.freeform import Measured
from walop_jax.diagnosis.score import Projector, whitening
from walop_jax.fit.refit import FitResult

Vector = Float[np.ndarray, " _"]


@dataclasses.dataclass(frozen=True)
class Design:
    """Residuals r (data − model, whitened) and J = ∂r/∂θ of the free parameters at a fit; priors are the last rows.

    The rows of the data run over points, then exposures, then cameras, used ones only.
    """

    fit: FitResult
    measured: Measured
    residual: Vector
    jacobian: Float[np.ndarray, "_ _"]

    @classmethod
    def of(cls, fit: FitResult) -> Design:
        """Lay out a fit."""
        likelihood = fit.likelihood
        measured = Measured(likelihood, fit.values)
        scale = fit.noise_scale
        data = measured.residual[measured.used].reshape(-1) / scale
        slope = likelihood.jacobian(fit.values) / scale
        # Data − model: priors stand in for data, so their rows are mean − value.
        prior = -likelihood.priors.residuals(fit.values)
        prior_slope = -likelihood.priors.jacobian(fit.model.selection())
        return cls(fit, measured, np.concatenate([data, prior]), np.vstack([slope, prior_slope]))

    @property
    def rows(self) -> int:
        """Number of rows that are data."""
        return self.measured.cameras * int(self.measured.used.sum())

    @cached_property
    def exposure(self) -> Int[np.ndarray, " d"]:
        """Exposure (position) of every data row."""
        return np.repeat(np.nonzero(self.measured.used)[1], self.measured.cameras)

    @cached_property
    def point(self) -> Int[np.ndarray, " d"]:
        """Field point (position) of every data row."""
        return np.repeat(np.nonzero(self.measured.used)[0], self.measured.cameras)

    @cached_property
    def projector(self) -> Projector:
        """Removes from columns what the free parameters could absorb."""
        return Projector(self.jacobian, self.eliminated)

    @property
    def eliminated(self) -> int:
        """Rows that carry no noise: one for every flux that was solved for, one for every weak pull."""
        likelihood = self.fit.likelihood
        fluxes = round(float(self.measured.used.sum(axis=0) @ (likelihood.cameras - likelihood.data_per_row)))
        return fluxes + int((~self.fit.likelihood.priors.known).sum())

    def _columns_of(self, name: str) -> Bool[np.ndarray, " f"]:
        """Which columns of the Jacobian are those of an effect."""
        return np.isin(self.fit.model.free, self.fit.model.positions(name))

    def without(self, name: str) -> tuple[Projector, Float[np.ndarray, "_ _"]]:
        """What all parameters but those of one effect absorb, and an orthonormal basis of what these add to it."""
        of_effect = self._columns_of(name)
        rest = Projector(self.jacobian[:, ~of_effect], self.eliminated)
        own = rest(self.jacobian[:, of_effect])
        return rest, own @ whitening(own.T @ own)

    def stacked(self, columns: list[Float[np.ndarray, "_ _"]]) -> Float[np.ndarray, "_ _"]:
        """Columns of data rows side by side, with zeros for the priors; the list is emptied.

        Column by column in memory, and one piece after the other: of a large set there is room for one copy only.
        """
        count = sum(piece.shape[1] for piece in columns)
        whole = np.zeros((len(self.residual), count), order="F")
        first = 0
        while columns:
            piece = columns.pop(0)
            np.divide(piece, self.fit.noise_scale, out=whole[: self.rows, first : first + piece.shape[1]])
            first += piece.shape[1]
        return whole

    def cube(self, rows: Vector) -> Float[np.ndarray, "p e k"]:
        """Data rows put back into (point, exposure, camera); 0 where unused."""
        used = self.measured.used
        cube = np.zeros((*used.shape, self.measured.cameras))
        cube[used] = rows[: self.rows].reshape(-1, self.measured.cameras)
        return cube

    def subset_step(self, keep: Bool[np.ndarray, " _"]) -> Float[np.ndarray, " _"]:
        """Change of the free parameters when only the data rows in `keep` (and the priors) are fitted.

        One Gauss–Newton step from the joint minimum: the change is a fraction of the standard errors, where the
        model is linear to better than that fraction squared.
        """
        rows = np.concatenate([keep, np.ones(len(self.residual) - self.rows, bool)])
        j, r = self.jacobian[rows], self.residual[rows]
        norm = np.sqrt(np.sum(self.jacobian**2, axis=0))
        norm = np.where(norm > 0, norm, 1.0)
        scaled = j / norm
        return -np.linalg.solve(scaled.T @ scaled + 1e-12 * np.eye(len(norm)), scaled.T @ r) / norm

    def taken_up(self, columns: Float[np.ndarray, "_ k"]) -> Float[np.ndarray, "_ k"]:
        """By how much the free parameters change, at first order, when the data lack the amplitudes of `columns`.

        A column holds the derivative of the rows with respect to an amplitude; the data have it, the model has not.
        """
        norm = np.linalg.norm(self.jacobian, axis=0)
        norm = np.where(norm > 0, norm, 1.0)
        scaled = self.jacobian / norm
        return np.linalg.pinv(scaled.T @ scaled, hermitian=True) @ (scaled.T @ columns) / norm[:, None]

    def robust_ratio(self, name: str) -> float:
        """Largest ratio of robust to stated errors among the parameters of an effect; NaN when it has none.

        The robust ones let every exposure have a disturbance of its own: the "sandwich" H⁻¹ (Σ g_e g_eᵀ) H⁻¹ with
        H = JᵀJ and g_e the gradient of exposure e (White 1982, Econometrica 50, 1; Liang & Zeger 1986, Biometrika 73,
        13).
        """
        at = np.flatnonzero(self._columns_of(name))
        if not len(at):
            return float("nan")
        norm = np.sqrt(np.sum(self.jacobian**2, axis=0))
        scaled = self.jacobian / np.where(norm > 0, norm, 1.0)
        inverse = np.linalg.pinv(scaled.T @ scaled, hermitian=True)[at]
        pull = (scaled * self.residual[:, None])[: self.rows] @ inverse.T
        by_exposure = np.zeros((self.measured.used.shape[1], len(at)))
        np.add.at(by_exposure, self.exposure, pull)
        return float(np.sqrt(np.max(np.sum(by_exposure**2, axis=0) / np.diag(inverse[:, at]))))


HOLDOUT_FOLDS = 5


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Squared normalised residuals on data that took no part in the fit, fold by fold."""

    scheme: str
    squares: Float[np.ndarray, " folds"]
    counts: Int[np.ndarray, " folds"]

    @property
    def mean(self) -> float:
        """Mean squared normalised residual (noise alone gives 1 − 1/K with K cameras when the flux is free)."""
        return float(self.squares.sum() / self.counts.sum())


def exposure_folds(design: Design) -> Int[np.ndarray, " d"]:
    """Fold of every data row: exposures of each kind and setting dealt out in turn."""
    e = design.fit.calset.exposures
    fold = np.zeros(len(e), int)
    groups: dict[tuple[str, ...], int] = {}
    for i in range(len(e)):
        key = (str(e.kind[i]), str(e.filter[i]), str(e.chwp_in[i]), str(e.chwp_angle[i]))
        fold[i] = groups.get(key, 0) % HOLDOUT_FOLDS
        groups[key] = groups.get(key, 0) + 1
    return fold[design.exposure]


def field_folds(design: Design) -> Int[np.ndarray, " d"]:
    """Fold of every data row: the field cut into 5 × 5 blocks, dealt out so that neighbours differ."""
    points = design.fit.calset.points

    def cell(v: np.ndarray) -> np.ndarray:
        span = np.ptp(v) or 1.0
        return np.minimum((5 * (v - v.min()) / span).astype(int), 4)

    return ((cell(points.x) + 2 * cell(points.y)) % HOLDOUT_FOLDS)[design.point]


def held_out(design: Design, scheme: str) -> HeldOut:
    """Cross-validate a fit: each fold is predicted by a fit to the others."""
    fold = {"exposures": exposure_folds, "field blocks": field_folds}[scheme](design)
    squares, counts = np.zeros(HOLDOUT_FOLDS), np.zeros(HOLDOUT_FOLDS, int)
    for k in range(HOLDOUT_FOLDS):
        out = fold == k
        if not out.any():
            continue
        step = design.subset_step(~out)
        rows = np.flatnonzero(out)
        predicted = design.residual[rows] + design.jacobian[rows] @ step
        squares[k], counts[k] = predicted @ predicted * design.fit.noise_scale**2, len(rows)
    return HeldOut(scheme, squares, counts)

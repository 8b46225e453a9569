"""The efficient score: what each candidate would explain that the base parameters cannot. Plain linear algebra.

Symbols      r whitened residuals at the best fit, prior rows appended; J = ∂r/∂θ of the free base parameters;
             C_g = ∂r/∂ε of the amplitudes of candidate g at zero.
Projection   C̃ = (1 − QQᵀ) C with Q from the QR decomposition of J: what the base could have absorbed is removed.
Statistic    T_g = s ᵀ I⁺ s with s = C̃ᵀ r and I = C̃ᵀ C̃; χ² with rank(I) degrees of freedom under the base model.
             One-step amplitudes ε = −I⁺ s, covariance I⁺.
Noise scale  T is divided by the mean square of the residuals in the complement of base and candidates, so that
             errors that are stated a few per cent too small or too large raise no alarm (an F statistic; the
             complement has thousands of degrees of freedom, so χ² serves).
Global p     Under the base model the scores of all candidates together are N(0, C̃ᵀC̃): the smallest p of a draw is
             compared with the smallest p found, 10⁴ times, without a model call. Beyond the reach of the draws the
             tail is continued with the effective number of trials that the draws themselves give.
Sources      Rao 1948; Bera & Bilias 2001, J. Stat. Plan. Inference 97, 9 (score tests); Gross & Vitells 2010,
             Eur. Phys. J. C 70, 525 (trial factors).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

Vector = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "_ _"]

ABSORBED = 1e-6  # surviving share of a column's square below which the base has swallowed it
FAINTEST = 0.05  # standard deviations that a plausible amplitude must reach to be testable
RANK_TOLERANCE = 1e-8
COUNTED = 20  # draws below the smallest p found that make counting them precise enough
DRAWS = 10_000


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A named set of columns: the derivative of the residuals with respect to its amplitudes.

    `widths` are the prior standard deviations of the amplitudes, in their own units.
    """

    name: str
    columns: Matrix
    widths: Vector


@dataclasses.dataclass(frozen=True)
class Score:
    """The efficient score of one candidate.

    `statistic` T and `rank`; `p_value` local; `amplitudes` one step from zero with `covariance`; `log_bayes` the
    Laplace evidence against the base for the prior widths; `surviving` the largest share of a column's square that
    the base does not absorb; `testable` False when nothing survives.
    """

    name: str
    statistic: float
    rank: int
    p_value: float
    log_p: float
    amplitudes: Vector
    covariance: Float[np.ndarray, "k k"]
    log_bayes: float
    surviving: float
    testable: bool


class Projector:
    """Removes from columns everything that the base parameters could absorb."""

    def __init__(self, jacobian: Matrix) -> None:
        norm = np.linalg.norm(jacobian, axis=0)
        self._q, _ = np.linalg.qr(jacobian / np.where(norm > 0, norm, 1.0))
        self.free = jacobian.shape[0] - jacobian.shape[1]

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """Project columns (twice: the second pass removes the rounding of the first)."""
        for _ in range(2):
            columns = columns - self._q @ (self._q.T @ columns)
        return columns


@dataclasses.dataclass(frozen=True)
class ScoreTable:
    """Scores of all candidates against one fit, and the global significance of the best of them."""

    scores: tuple[Score, ...]
    projected: Mapping[str, Matrix]
    noise_scale: float
    p_global: float
    trials: float

    def __getitem__(self, name: str) -> Score:
        return next(score for score in self.scores if score.name == name)

    @property
    def ranked(self) -> tuple[Score, ...]:
        """Testable candidates, smallest local p first."""
        return tuple(sorted((s for s in self.scores if s.testable), key=lambda s: s.log_p))

    def corrected(self, score: Score) -> float:
        """p of a candidate corrected for the number of candidates tried."""
        return corrected_p(score.log_p, self.trials)

    def cosine(self, first: str, second: str) -> float:
        """Largest canonical correlation between the projected columns of two candidates."""
        return float(canonical_correlations(self.projected[first], self.projected[second]).max(initial=0.0))


def corrected_p(log_p: float, trials: float) -> float:
    """Šidák correction 1 − (1 − p)^n, from ln p."""
    p = np.exp(max(log_p, -700.0))
    return float(-np.expm1(trials * np.log1p(-min(p, 1.0 - 1e-16))))


def whitened(columns: Matrix) -> tuple[Matrix, Matrix]:
    """Orthonormal basis of the columns and the matrix W with basis = columns · W."""
    if columns.shape[1] == 0:
        return columns, np.zeros((0, 0))
    norm = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(norm > 0, norm, 1.0)
    value, vector = np.linalg.eigh(unit.T @ unit)
    keep = value > max(value.max(initial=0.0), 1e-300) * RANK_TOLERANCE
    keep &= norm.max(initial=0.0) > 0
    transform = (vector[:, keep] / np.sqrt(value[keep])) / np.where(norm > 0, norm, np.inf)[:, None]
    return columns @ transform, transform


def canonical_correlations(first: Matrix, second: Matrix) -> Vector:
    """Cosines of the principal angles between two column spaces (Björck & Golub 1973)."""
    a, b = whitened(first)[0], whitened(second)[0]
    if a.shape[1] == 0 or b.shape[1] == 0:
        return np.zeros(0)
    return np.clip(np.linalg.svd(a.T @ b, compute_uv=False), 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class _Prepared:
    """A candidate projected off the base: all of that which the data do not decide."""

    name: str
    widths: Vector
    columns: Matrix  # projected; amplitudes that the base absorbs are zero
    alive: Bool[np.ndarray, " k"]
    basis: Matrix  # orthonormal
    transform: Matrix  # basis = columns[:, alive] @ transform
    surviving: float


class Scorer:
    """Candidates made ready for one fit: projected, and with the distribution of the smallest p under the base.

    Nothing here depends on the residuals, so that many data sets of the same design can be scored in turn.
    """

    def __init__(
        self,
        projector: Projector,
        candidates: Sequence[Candidate],
        rng: np.random.Generator,
        draws: int = DRAWS,
    ) -> None:
        self._projector = projector
        self._prepared = [_prepare(projector, candidate) for candidate in candidates]
        testable = [p.basis for p in self._prepared if p.basis.shape[1]]
        rows = len(candidates[0].columns) if candidates else 0
        self._space = whitened(np.column_stack(testable))[0] if testable else np.zeros((rows, 0))
        self._smallest = _smallest_p([self._space.T @ b for b in testable], rng, draws)

    def __call__(self, residual: Vector) -> ScoreTable:
        """Score the residuals of a fit of this design."""
        r = self._projector(residual)
        rest = r - self._space @ (self._space.T @ r)
        noise = float(np.sqrt(rest @ rest / max(self._projector.free - self._space.shape[1], 1)))
        scores = tuple(_score(p, r, noise) for p in self._prepared)
        p_global, trials = self._global_p(scores)
        return ScoreTable(scores, {p.name: p.columns for p in self._prepared}, noise, p_global, trials)

    def _global_p(self, scores: Sequence[Score]) -> tuple[float, float]:
        found = min((score.log_p for score in scores if score.testable), default=0.0)
        if not len(self._smallest):
            return 1.0, 1.0
        # Effective number of trials where the draws still count well (their 1 % quantile).
        reference = float(np.quantile(self._smallest, 0.01))
        trials = max(1.0, float(np.log1p(-0.01) / np.log1p(-np.exp(reference))))
        below = int(np.sum(self._smallest <= found))
        if below >= COUNTED:
            return (1 + below) / (1 + len(self._smallest)), trials
        return corrected_p(found, trials), trials


def _prepare(projector: Projector, candidate: Candidate) -> _Prepared:
    columns = projector(candidate.columns)
    before = np.sum(candidate.columns**2, axis=0)
    after = np.sum(columns**2, axis=0)
    share = np.where(before > 0, after / np.where(before > 0, before, 1.0), 0.0)
    # An amplitude is testable when the base leaves something of it and a plausible one would stand out at all.
    alive = (share > ABSORBED) & (np.sqrt(after) * candidate.widths > FAINTEST)
    columns = np.where(alive, columns, 0.0)
    basis, transform = whitened(columns[:, alive])
    return _Prepared(
        candidate.name, candidate.widths, columns, alive, basis, transform, float(share.max(initial=0.0))
    )


def _score(prepared: _Prepared, r: Vector, noise: float) -> Score:
    z = prepared.basis.T @ r
    statistic, rank = float(z @ z) / noise**2, prepared.basis.shape[1]
    log_p = float(stats.chi2.logsf(statistic, rank)) if rank else 0.0
    alive = prepared.alive
    amplitudes, covariance = np.zeros(len(alive)), np.zeros((len(alive), len(alive)))
    if rank:
        amplitudes[alive] = -prepared.transform @ z
        covariance[np.ix_(alive, alive)] = prepared.transform @ prepared.transform.T * noise**2
    return Score(
        name=prepared.name, statistic=statistic, rank=rank, p_value=float(np.exp(log_p)), log_p=log_p,
        amplitudes=amplitudes, covariance=covariance,
        log_bayes=_log_bayes(prepared.columns / noise, r / noise, prepared.widths),
        surviving=prepared.surviving, testable=rank > 0,
    )  # fmt: skip


def _log_bayes(columns: Matrix, r: Vector, widths: Vector) -> float:
    """ln B = ½ sᵀ (I + Λ⁻¹)⁻¹ s − ½ ln det(1 + Λ^½ I Λ^½): evidence against the base, exact for a linear effect."""
    scaled = columns * widths
    information = scaled.T @ scaled + np.eye(len(widths))
    s = scaled.T @ r
    _, log_det = np.linalg.slogdet(information)
    return float(0.5 * s @ np.linalg.solve(information, s) - 0.5 * log_det)


def _log_survival(statistic: np.ndarray, rank: int) -> np.ndarray:
    """ln of the χ² survival function by interpolation: millions of values, 10⁻⁴ is plenty."""
    grid = np.linspace(0.0, rank + 12.0 * np.sqrt(2.0 * rank) + 60.0, 2000)
    return np.interp(statistic, grid, stats.chi2.logsf(grid, rank))


def _smallest_p(maps: Sequence[Matrix], rng: np.random.Generator, draws: int) -> Vector:
    """ln of the smallest p among all candidates, drawn under the base; `maps` take unit normals to whitened scores."""
    if not maps:
        return np.zeros(0)
    normal = rng.standard_normal((draws, maps[0].shape[0]))
    smallest = np.zeros(draws)
    for m in maps:
        statistic = np.sum((normal @ m) ** 2, axis=1)
        np.minimum(smallest, _log_survival(statistic, m.shape[1]), out=smallest)
    return smallest

"""What q and u of the stars themselves say: do they follow the instrument, or the sky? No sum of cameras shows that.

A camera of an arm that has become brighter at the cost of the other leaves the sum of the arm as it was: the residuals
of a row of four cameras (`star_residuals`) know nothing of it. But the raw q of every star is off then, and the
instrument matrix, which turns raw q and u into those of the star, differs over the field: the stars would have a
polarisation that follows the instrument. Interstellar light has no reason to. (Two cameras that are exchanged show in
the same way, and in the scatter of q and u: `catalogue_readings`.)

Equation    y = B β + A θ + c γ + own + noise       y = (q, u) of every star by a linear step from q = u = 0

Symbols     c  the question: shift of (q, u) of an unpolarised star by a unit change, exact to first order
               (`Estimate.gain`), of the balance of an arm: first camera brighter by half of it, second fainter by half
            B  interstellar polarisation of the field: means of q and u of each exposure group, polynomials of X and Y
            A  errors of the calibration and of unknown colours, θ ~ N(0, 1); finer interstellar structure, cosines of
               variance a k⁻ᵝ with k half waves over the field, a and β of the marginal likelihood
            own  scatter of the stars' own polarisation, of variance τ² in q and in u, such that χ² is its degrees of
               freedom (Paule & Mandel 1982, J. Res. NBS 87, 377)
Size        γ = c̃ᵀ W y / c̃ᵀ W c, W the inverse of noise + τ², c̃ what B and A leave of c
Error       the larger of two, each with its own Student t: by W; by the residuals of the stars (White 1980,
            Econometrica 48, 817), with the degrees of freedom of the number of stars that the information is worth,
            (Σ i)² / Σ i²
Limits      A change whose shift of q and u is the same all over the field (B holds it) is not seen, as long as the
            instrument has no cross-talk that differs. Of fewer than `FEWEST` stars nothing is asked.

Polarised light of the sky that is left in the counts is in no sum of cameras either, but grows as 1/flux:

Equation    (q, u) of a star = m + c log₁₀ L + b S/L + own; L its light, S the sky under it (electron, all cameras)
Symbols     b polarised light left over per unit of the sky's level, in the frame of (q, u); m, c what stars have in
            common: interstellar polarisation grows with distance, hence with faintness, but never as 1/flux
Method      as above, for q and u each; stars beyond `SKY_FAR` are left out
Limits      a sky of one polarisation in the whole catalogue; first order in S/L. Sky left over without polarisation
            lowers q and u by the same share of themselves, which nothing here shows.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, special

from walop_jax.fit.verdict import Quality
from walop_jax.io.shapes import OfStars
from walop_jax.io.text import some, with_error
from walop_jax.likelihood.inverses import whitening
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.star_columns import ALARM, MOST_LIKELY, RIVAL, threshold

if TYPE_CHECKING:
    from walop_jax.science.apply import Stars

FEWEST = 12  # stars, of which a sample is asked
FLOOR = 0.002
"""Of the counts, added to the errors: flat fields and calibrations differ by so much from place to place, and a few
bright stars shall not be all that is asked."""
LARGEST = 0.5
"""Change of the balance up to which the linear step holds. A question that needs a larger one to be answered is not
asked: of stars seen at ROTATOR 0° and 90° alike, a change cancels, and rounding would be told as a change of 280 %."""
FAR = 25.0  # χ² of q and u from which a star is left out
_ROUNDS = 5
_EFFECTIVE = 6.0  # stars that the information on a question is worth at least
_REGULAR = 1e-12  # determinant over squared trace of the information on q and u of a star
_SMALL_SHARE = 1e-6  # of its information that a question must have behind B and A
_STARS_OF_DEGREE = (0, 30, 100, 300)
"""Stars from which interstellar polarisation is a constant, a polynomial of degree 1, 2, 3 in X and Y, …"""
_STARS_OF_WAVE = 4  # … stars for each of the cosines of the finer structure, …
_MOST_WAVES = 10  # … which has so many half waves at most, …
_SURELY = 4.0  # of −2 ln L, two standard deviations
_SLOPES = (1.5, 2.5, 3.5, 4.5)  # … and the exponents β of its variance that are tried
_MOST_GROUPS = 20  # exposure groups with a mean of their own

ResponseColumns = Float[np.ndarray, "s 2 c"]
SKY_CHANCE = 1e-5  # probability that noise finds something in a sound catalogue
SKY_FEWEST = 50  # stars
SKY_MOST = 20_000  # that are looked at
SKY_FAR = 5.0  # standard deviations
_SKY_ROUNDS = 4


@dataclasses.dataclass(frozen=True)
class OwnLight:
    """q, u of stars, their noise, and what would move them: by `questions`, by errors of the calibration (`nuisances`).

    `x`, `y` in degrees; `group` numbers exposure groups. `cameras` are the shifts by a camera that is brighter by the
    whole of its light: those of any change of its gain over the field are shares of them.
    """

    qu: Float[np.ndarray, "s 2"]
    noise: Float[np.ndarray, "s 2 2"]
    x: OfStars
    y: OfStars
    group: Int[np.ndarray, " s"]
    questions: ResponseColumns
    nuisances: Float[np.ndarray, "s 2 n"]
    cameras: Float[np.ndarray, "s 2 k"]

    def without(self, shift: Float[np.ndarray, "s 2"]) -> OwnLight:
        """The same stars where a change had not shifted their q and u so."""
        return dataclasses.replace(self, qu=self.qu - shift)

    @classmethod
    def joined(cls, parts: list[OwnLight]) -> OwnLight:
        """Several lists of stars as one."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(cls)))

    def of(self, chosen: Bool[np.ndarray, " s"]) -> OwnLight:
        """The records of some of the stars."""
        return OwnLight(*(getattr(self, f.name)[chosen] for f in dataclasses.fields(self)))


class ArmChange(NamedTuple):
    """A change of the balance of an arm: the fraction by which its first camera is brighter against the second.

    `error` is inf where the stars hold nothing on it; `chance` is that of a size as large without the change.
    """

    cameras: tuple[str, str]
    size: float = 0.0
    error: float = np.inf
    chance: float = 1.0

    @property
    def sigma(self) -> float:
        """The size in standard deviations of a normal number that is as improbable."""
        return float(np.copysign(threshold(max(self.chance, 1e-300)), self.size))

    def words(self) -> str:
        """The change in words: which camera is brighter, by how much, and how sure that is."""
        first, second = self.cameras
        size = with_error(100 * abs(self.size), 100 * self.error)
        return f"{first} {('brighter', 'fainter')[self.size < 0]} by {size} % against {second}"

    def document(self) -> dict[str, Any]:
        """The change as plain data."""
        error = self.error if np.isfinite(self.error) else None
        about = {"cameras": list(self.cameras), "size": self.size, "error": error}
        return {**about, "sigma": self.sigma, "p_value": self.chance}


@dataclasses.dataclass(frozen=True)
class OwnLightCheck:
    """What the q and u of so many `stars` say of the arms, and the `scatter` of their own polarisation in q or u.

    `tests` are all questions, each alone; `alike` those that describe the stars as well as the best one, if one is
    found, best first, and `off` is by how much the best of these moves q or u of a star (median; None: none is found).
    """

    stars: int
    scatter: float
    tests: tuple[ArmChange, ...]
    alike: tuple[ArmChange, ...]
    off: float | None = None

    @property
    def found(self) -> bool:
        """True if the q and u of the stars follow the instrument."""
        return bool(self.alike)

    @property
    def smallest(self) -> float:
        """The change of the balance of the arm seen best that would be found in 99 % of such catalogues (nan: none)."""
        least = min((test.error for test in self.tests), default=np.inf)
        alarm = ALARM / max(len(self.tests), 1)
        return float((threshold(alarm) + MOST_LIKELY) * least) if np.isfinite(least) else np.nan

    def words(self) -> str:
        """The finding in a sentence."""
        best = self.alike[0]
        what = f"q and u of {self.stars} stars follow the pattern of the instrument over the field"
        return f"{what}, {abs(best.sigma):.0f} σ: as if {some([c.words() for c in self.alike], 4, ' or ')}"

    def document(self) -> dict[str, Any]:
        """The check as plain data."""
        return {
            "found": self.found,
            "stars": self.stars,
            "scatter": self.scatter,
            "smallest_balance_seen": self.smallest if np.isfinite(self.smallest) else None,
            "alike": [change.document() for change in self.alike],
            "tests": [change.document() for change in self.tests],
        }


class Unpolarised(NamedTuple):
    """(q, u) of stars by the linear step from q = u = 0, their `noise`, and their `shifts` by the balance of each arm.

    `cameras` are their shifts by the whole light of each camera.

    Noise, weights and shifts do not depend on the q and u that are found: nor does a choice of stars by them.
    """

    qu: Float[np.ndarray, "s 2"]
    noise: Float[np.ndarray, "s 2 2"]
    shifts: ResponseColumns
    cameras: Float[np.ndarray, "s 2 k"]


def unpolarised(
    vectors: Float[np.ndarray, "r k 3"],
    counts: Float[np.ndarray, "r k"],
    sigma: Float[np.ndarray, "r k"],
    first: Int[np.ndarray, " s"],
    arms: Sequence[Sequence[int]],
    *,
    split: bool = False,
) -> Unpolarised:
    """The linear step for stars whose rows begin at `first`, of which each of the `arms` has two cameras.

    The flux of a row is that of all its cameras, or that of an arm (`split`).
    """
    used = np.isfinite(counts) & np.isfinite(sigma) & (sigma > 0)
    variance = sigma**2 + (FLOOR * counts) ** 2
    weight = np.where(used, 1.0 / np.where(used, variance, 1.0), 0.0)
    data, dark = np.where(used, counts, 0.0), np.where(used, vectors[..., 0], 0.0)
    tangent, expected = np.zeros((*counts.shape, 2)), np.zeros_like(counts)
    for cameras in arms if split else [range(counts.shape[1])]:
        k = np.asarray(cameras)
        light = dark[:, k].sum(axis=1)
        flux = np.maximum(data[:, k].sum(axis=1) / np.where(light > 0, light, 1.0), 0.0)[:, None]
        power = (weight[:, k] * dark[:, k] ** 2).sum(axis=1)
        share = np.einsum("rk,rks->rs", weight[:, k] * dark[:, k], vectors[:, k, 1:])
        share /= np.where(power > 0, power, 1.0)[:, None]
        tangent[:, k] = flux[..., None] * (vectors[:, k, 1:] - dark[:, k, None] * share[:, None])
        expected[:, k] = flux * dark[:, k]
    pull = weight[..., None] * tangent
    information = np.add.reduceat(np.einsum("rki,rkj->rij", pull, tangent), first)
    regular = np.linalg.det(information) > _REGULAR * np.trace(information, axis1=1, axis2=2) ** 2
    noise = np.linalg.inv(np.where(regular[:, None, None], information, np.eye(2)))
    noise[~regular] = np.nan
    star = np.repeat(np.arange(len(first)), np.diff(first, append=len(counts)))
    gain = np.einsum("rij,rkj->rik", noise[star], pull)  # of (q, u), for counts
    qu = np.add.reduceat(np.einsum("rik,rk->ri", gain, data - expected), first)
    cameras = np.add.reduceat(gain * expected[:, None], first)
    shifts = np.stack([0.5 * (cameras[..., i] - cameras[..., j]) for i, j in arms], axis=-1)
    return Unpolarised(qu, noise, shifts, cameras)


def own_light_check(light: OwnLight, arms: Sequence[tuple[str, str]]) -> OwnLightCheck | None:
    """The balance of every arm, of which `arms` are the cameras; None of few stars."""
    if len(light.qu) < FEWEST:
        return None
    fitted = _fitted(light)
    if fitted is None:
        return None
    tests = tuple(_answer(fitted, question, ArmChange(arm)) for question, arm in enumerate(arms))
    alarm = ALARM / len(tests)
    best = max(tests, key=lambda test: abs(test.sigma))
    alike: list[ArmChange] = []
    if best.chance < alarm:
        least = best.sigma**2 - RIVAL
        alike = sorted((t for t in tests if t.sigma**2 > least), key=lambda t: -abs(t.sigma))
    off = None
    if alike:
        shift = light.questions[..., tests.index(best)] * best.size
        off = float(np.median(np.abs(shift).max(axis=1)))
    return OwnLightCheck(int(fitted.used.sum()), float(np.sqrt(fitted.scatter)), tests, tuple(alike), off)


class _Fitted(NamedTuple):
    """Stars whose polarisation is fitted by B and A: whitened q, u, what is `left`, questions, B and A; and τ²."""

    used: Bool[np.ndarray, " s"]
    qu: Float[np.ndarray, "s 2"]
    left: Float[np.ndarray, "s 2"]
    questions: ResponseColumns
    base: Float[np.ndarray, "s 2 m"]
    root: Float[np.ndarray, "m m"]
    scatter: float
    dof: float


def _of_both(scalar: Float[np.ndarray, "s m"]) -> Float[np.ndarray, "s 2 n"]:
    """ResponseColumns of q and of u, each with a scalar field."""
    both = np.zeros((len(scalar), 2, 2 * scalar.shape[1]))
    both[:, 0, ::2], both[:, 1, 1::2] = scalar, scalar
    return both


def _interstellar(
    light: OwnLight, x: OfStars, y: OfStars
) -> tuple[Float[np.ndarray, "s 2 b"], Float[np.ndarray, "s 2 w"], Float[np.ndarray, " w"]]:
    """Interstellar polarisation: B, and cosines of finer structure with their numbers k of half waves."""
    count = len(x)
    degree = int(np.searchsorted(_STARS_OF_DEGREE, count, side="right")) - 1
    powers = [(i, n - i) for n in range(1, degree + 1) for i in range(n + 1)]
    terms = [x**i * y**j for i, j in powers]
    _, group = np.unique(light.group, return_inverse=True)
    group = group.reshape(-1)
    means = np.eye(group.max() + 1)[group] if group.max() < _MOST_GROUPS else np.ones((count, 1))
    numbers = itertools.product(range(_MOST_WAVES + 1), repeat=2)
    waves = sorted((np.hypot(i, j), i, j) for i, j in numbers if 0 < np.hypot(i, j) <= _MOST_WAVES)
    waves = waves[: count // _STARS_OF_WAVE]
    half = 0.5 * np.pi
    cosines = [np.cos(half * i * (x + 1)) * np.cos(half * j * (y + 1)) for _, i, j in waves]
    fine = _of_both(np.column_stack([np.zeros((count, 0)), *cosines]))
    return (
        _of_both(np.column_stack([means, *terms])),
        fine,
        np.repeat([k for k, *_ in waves], 2).astype(float),
    )


def _fitted(light: OwnLight) -> _Fitted | None:
    """The stars behind B and A, far ones left out; None if too few are left."""
    edge = max(float(np.abs([light.x, light.y]).max()), 1e-9)
    smooth, fine, halves = _interstellar(light, light.x / edge, light.y / edge)
    flat, waves = smooth.shape[-1], fine.shape[-1]
    asked = np.concatenate([smooth, light.nuisances, light.questions, fine], axis=-1)
    first = asked.shape[-1] - waves
    prior = np.zeros(first)
    prior[flat : first - light.questions.shape[-1]] = 1.0
    square = np.einsum("sij->s", light.qu[:, :, None] ** 2)
    scatter, used, width = 0.5 * float(np.median(square)), np.ones(len(light.qu), bool), np.zeros(waves)
    for _ in range(_ROUNDS):
        if 2 * used.sum() - flat < FEWEST:
            return None
        white = np.linalg.inv(np.linalg.cholesky(light.noise + scatter * np.eye(2))) * used[:, None, None]
        full = (white @ asked).reshape(-1, asked.shape[-1])
        matrix, pull = full.T @ full, full.T @ (white @ light.qu[..., None]).reshape(-1)
        width, taken = _widths(matrix, pull, prior, halves)
        complete = np.concatenate([prior, np.ones(waves)])
        scale = np.concatenate([np.ones(first), width])
        root = whitening(matrix * scale * scale[:, None] + np.diag(complete), 1e-12)
        left = light.qu - asked @ (scale * (root @ (root.T @ (scale * pull))))
        chi2 = np.sum((white @ left[..., None]) ** 2, axis=(1, 2))
        dof = 2.0 * float(used.sum()) - flat - taken
        if dof < FEWEST:
            return None
        scatter = _scatter(left[used], light.noise[used], dof)
        variance = np.linalg.inv(light.noise + scatter * np.eye(2))
        chi2 = np.einsum("si,sij,sj->s", left, variance, left)
        used = chi2 < FAR * max(float(np.median(chi2)) / float(special.chdtri(2, 0.5)), 1.0)
    white = np.linalg.inv(np.linalg.cholesky(light.noise + scatter * np.eye(2))) * used[:, None, None]
    base = np.concatenate([smooth, light.nuisances, fine * width], axis=-1)
    columns = white @ base
    full = columns.reshape(-1, base.shape[-1])
    prior = np.ones(base.shape[-1])
    prior[:flat] = 0.0
    root = whitening(full.T @ full + np.diag(prior), 1e-12)
    qu = (white @ light.qu[..., None])[..., 0]
    left = qu - columns @ (root @ (root.T @ (full.T @ qu.reshape(-1))))
    return _Fitted(used, qu, left, white @ light.questions, columns, root, scatter, dof)  # pyright: ignore[reportPossiblyUnboundVariable]


def _widths(
    matrix: Float[np.ndarray, "m m"],
    pull: Float[np.ndarray, " m"],
    prior: Float[np.ndarray, " f"],
    halves: Float[np.ndarray, " w"],
) -> tuple[Float[np.ndarray, " w"], float]:
    """Standard deviations of the cosines, all columns ahead of them fitted, and how many numbers they take.

    The largest a, of the likeliest β, for which −2 ln L is no more than `_SURELY` above its minimum: faint stars hardly
    know a, and too small a one is an alarm. With Λ, t the eigenvalues of the matrix of the cosines of a = 1 and their
    pulls, −2 ln L = Σ ln(1 + aΛ) − Σ a t²/(1 + aΛ).
    """
    first = len(prior)
    if first == len(matrix):
        return np.zeros(0), 0.0
    root = whitening(matrix[:first, :first] + np.diag(prior), 1e-12)
    cross = matrix[first:, :first] @ root
    remaining, score = (
        matrix[first:, first:] - cross @ cross.T,
        pull[first:] - cross @ (root.T @ pull[:first]),
    )
    tried, found = np.append(0.0, np.geomspace(1e-9, 1.0, 91)), []
    for slope in _SLOPES:
        scale = halves ** (-0.5 * slope)
        values, axes = np.linalg.eigh(remaining * scale * scale[:, None])
        values, t = np.maximum(values, 0.0), axes.T @ (scale * score)
        power = tried[:, None] * values
        misfit = np.sum(np.log1p(power) - tried[:, None] * t**2 / (1.0 + power), axis=1)
        best = int(np.flatnonzero(misfit < misfit.min() + _SURELY).max())
        taken = float(np.sum(power[best] / (1.0 + power[best])))
        found.append((float(misfit.min()), np.sqrt(tried[best]) * scale, taken))
    _, width, taken = min(found, key=lambda entry: entry[0])
    return width, taken


def _scatter(left: Float[np.ndarray, "s m"], noise: Float[np.ndarray, "s m m"], dof: float) -> float:
    """τ², beside the noise, for which χ² of residuals is their degrees of freedom."""
    widths, axes = np.linalg.eigh(noise)
    square = np.einsum("sji,sj->si", axes, left) ** 2

    def excess(scatter: float) -> float:
        return float(np.sum(square / (widths + scatter))) - dof

    highest = 2.0 * float(square.sum()) / dof
    return float(optimize.brentq(excess, 0.0, highest)) if excess(0.0) > 0 else 0.0  # pyright: ignore[reportArgumentType]


def _answer(fitted: _Fitted, question: int, change: ArmChange) -> ArmChange:
    """Size, error and chance of one change, alone."""
    column = fitted.questions[:, :, question]
    full = fitted.base.reshape(-1, fitted.base.shape[-1])
    behind = column - fitted.base @ (fitted.root @ (fitted.root.T @ (full.T @ column.reshape(-1))))
    information, whole = float(np.sum(behind * column)), float(np.sum(column**2))
    if not information > _SMALL_SHARE * whole or whole == 0.0:
        return change
    size = float(np.sum(behind * fitted.qu)) / information
    pull = np.sum(behind * (fitted.left - size * behind), axis=1) / information
    worth = np.sum(behind**2, axis=1)
    number = float(worth.sum() ** 2 / max(float(np.sum(worth**2)), 1e-300))
    if number < _EFFECTIVE:
        return change
    spread = float(np.sqrt(np.sum(pull**2) * number / (number - 1.0)))
    errors = (information**-0.5, spread)
    if max(errors) * (threshold(ALARM) + MOST_LIKELY) > LARGEST:
        return change
    chances = (_student(size / errors[0], fitted.dof), _student(size / max(spread, 1e-300), number - 1.0))
    return change._replace(size=size, error=max(errors), chance=max(chances))


def _student(t: float, dof: float) -> float:
    """Probability of a number of Student's t as far from 0, to either side."""
    return float(2.0 * special.stdtr(dof, -abs(t)))


# ------------------------------------------------------------------------------- light of the sky left over


@dataclasses.dataclass(frozen=True)
class LeftOverSky:
    """Polarised light of the sky left over, `share` (q, u) of its level, with `errors`, from so many `stars`.

    `level` is that of the sky over the light of a star (median).
    """

    share: Float[np.ndarray, " 2"]
    errors: Float[np.ndarray, " 2"]
    stars: int
    level: float

    @property
    def p_value(self) -> float:
        """Chance of a share as large without any."""
        return float(np.exp(-0.5 * np.sum((self.share / self.errors) ** 2)))

    @property
    def found(self) -> bool:
        """True if there is some."""
        return self.p_value < SKY_CHANCE

    @property
    def off(self) -> float:
        """By how much it moves q, u of a star (median)."""
        return float(np.hypot(*self.share)) * self.level

    @property
    def bound(self) -> float:
        """The share that is not exceeded with a probability of 99 %."""
        return float(np.hypot(*self.share) + MOST_LIKELY * self.errors.max())

    def covariance(self, ratio: OfStars) -> Float[np.ndarray, "s 2 2"]:
        """Covariance of its shift of stars with a `ratio` of sky to light, 0 where none was found."""
        of_share = np.outer(self.share, self.share) + np.diag(self.errors**2)
        return np.where(self.found, ratio**2, 0.0)[:, None, None] * of_share

    def words(self) -> str:
        """The finding in a sentence."""
        size = with_error(100 * float(np.hypot(*self.share)), 100 * float(self.errors.mean()))
        angle = np.rad2deg(0.5 * np.arctan2(self.share[1], self.share[0])) % 180.0
        return (
            f"polarised light of the sky is left in the stars: {size} % of the level in SKY at {angle:.0f}°, as q and "
            "u grow with SKY over N. Its shift is in the errors; subtract the sky anew"
        )

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        document = {**dict(zip("qu", self.share.tolist(), strict=True)), "errors": self.errors.tolist()}
        return document | {n: getattr(self, n) for n in ("p_value", "found", "bound", "stars")}


def left_over_sky(
    qu: Float[np.ndarray, "s 2"], photon: Float[np.ndarray, "s 2 2"], light: OfStars, ratio: OfStars
) -> LeftOverSky | None:
    """The sky left in stars of such light (electron) and sky over light; None of few stars, or of one ratio."""
    good = np.isfinite(qu).all(axis=1) & np.isfinite(photon).all(axis=(1, 2))
    chosen = np.flatnonzero(good & (light > 0) & np.isfinite(ratio) & (ratio >= 0))
    chosen = chosen[np.mod(np.arange(len(chosen)) * 0.6180339887498949, 1.0) < SKY_MOST / max(len(chosen), 1)]
    if len(chosen) < SKY_FEWEST or np.ptp(ratio[chosen]) <= 0:
        return None
    columns = np.stack([np.ones(len(chosen)), np.log10(light[chosen]), ratio[chosen]], axis=1)
    columns[:, 1] -= columns[:, 1].mean()
    slopes = [_slope(columns, qu[chosen, k], photon[chosen, k, k]) for k in range(2)]
    share, errors = np.array(slopes).T
    measured = np.isfinite(slopes).all() and (errors > 0).all()
    level = float(np.median(ratio[chosen]))
    return LeftOverSky(share, errors, len(chosen), level) if measured else None


def _slope(columns: Float[np.ndarray, "s 3"], values: OfStars, variance: OfStars) -> tuple[float, float]:
    """Coefficient of the last column, and its error."""
    scatter, used = 0.0, np.ones(len(values), bool)
    beta, inverse, residual = np.zeros(3), np.eye(3), values
    for rounds_left in reversed(range(_SKY_ROUNDS + 1)):
        weight = np.where(used, 1.0 / (variance + scatter), 0.0)
        inverse = np.linalg.pinv(columns.T @ (weight[:, None] * columns), hermitian=True)
        beta = inverse @ (columns.T @ (weight * values))
        residual = values - columns @ beta
        if rounds_left:
            scatter = _scatter(residual[used, None], variance[used, None, None], float(used.sum()) - 3.0)
            used = np.abs(residual) < SKY_FAR * np.sqrt(variance + scatter)
    pull = np.where(used, residual / (variance + scatter), 0.0)[:, None] * columns
    robust = inverse @ (pull.T @ pull) @ inverse
    return float(beta[2]), float(np.sqrt(max(inverse[2, 2], robust[2, 2])))


def with_sky(stars: Stars, catalogue: Catalogue) -> Stars:
    """The stars with errors and bounds of the sky left in them, where the catalogue states its level."""
    if catalogue.sky is None:
        return stars
    stated = np.isfinite(catalogue.counts) & np.isfinite(catalogue.sky)
    sums = (np.where(stated, values, 0.0).sum(axis=1) for values in (catalogue.counts, catalogue.sky))
    light, level = (np.bincount(catalogue.star, values) for values in sums)
    ratio = np.where(light > 0, level / np.where(light > 0, light, 1.0), np.nan)
    leftover = left_over_sky(stars.qu, stars.photon, light, ratio)
    if leftover is None:
        return stars
    changed = stars.changed + np.nan_to_num(leftover.covariance(ratio))
    flag = stars.flag | (Quality.CATALOGUE if leftover.found else 0)
    check, bound = dataclasses.replace(stars.check, sky=leftover), leftover.bound * ratio
    return dataclasses.replace(stars, changed=changed, flag=flag, check=check, sky_bound=bound)

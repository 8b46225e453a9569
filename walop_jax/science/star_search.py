"""Do the stars of a catalogue, all together, still agree with the calibration and with their stated errors?

The residuals of `star_residuals` are tested for:

noise       Σ χ² against Σ ν, from both sides: N_ERR too small or too large
rows        the common part of the rows of one star: rows that are there twice, noise that is correlated
changes     every change of `star_columns` that acts in all rows: of cameras one by one, light added to all of them, all
            parameters of the optics. The strongest one is fitted with the errors of the calibration, and the others
            are tested again beside it, until none raises an alarm
places      stars that disagree together at one place of the field: dust on a camera, a ghost, a blemish

All tests share one correction: noise raises any alarm at all with the probability `ALARM`. Where analysers split the
light in two, stars of a single exposure can hardly tell the two cameras of an arm apart, or one arm that is brighter
from the other that is fainter: changes that describe the data as well (Δχ² < `RIVAL`) are reported together.

A column c is tested by itself, in a model that fits others (among them the errors of the calibration, with their
prior), by the score test of Rao 1948 (Proc. Camb. Phil. Soc. 44, 50), from Q and g of `star_residuals`:

    z = g/√Q,   size g/Q,   error Q^(−1/2), the Cramér–Rao bound

Places      A camera that is brighter by the share β g, g = exp(−d²/2s²) at distance d from a centre, leaves

                r = β g P c + noise,    c the counts of the model in that camera

            For every star and camera  z = cᵀr / √(v₀ cᵀPc)  is normal with unit variance, v₀ the variance of the
            residuals of the star, and α = √(cᵀPc / v₀) says how well the star sees the camera. With every star as a
            centre, for every size s and camera

                Z = Σ w ψ(z) / √(v Σ w²),    w = α g or w = g

            ψ cuts z at ±`CUT`, v = max(1, mean ψ²) of the catalogue: no star has more influence than `CUT`, so that
            four are needed, and stars that are off alone, however far, make no place. Z is normal, or has shorter
            tails; Bonferroni's bound over centres, sizes, cameras and weights keeps false alarms below `ALARM` a
            catalogue. A matched filter with a bounded score: Huber 1981, Robust Statistics, chapter 4. The watch of
            many nights (`watch`) looks for spots in this way, in the rows of each exposure group and all later ones.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, optimize, special

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.io.shapes import ColumnProducts, OfStars
from walop_jax.likelihood.inverses import whitening
from walop_jax.science import star_columns as alarms
from walop_jax.science import star_residuals as residuals
from walop_jax.science.star_columns import (
    ALARM,
    MOST_LIKELY,
    OF_CATALOGUES,
    RIVAL,
    UNNAMED,
    PossibleChange,
    SpotPlace,
    StarColumns,
    profile,
    rivals_of,
)
from walop_jax.science.star_light import OwnLight, own_light_check
from walop_jax.science.star_residuals import Residuals, Scale, StarResiduals, StarWeights, own_variance
from walop_jax.science.star_words import CatalogueCheck, DisagreeingPlace, FoundChange

_MOST_CHANGES = 6
_ROUNDS = 8
_SETTLED = 0.05  # standard errors
_FARTHEST = 5.0  # standard errors in every direction: no calibration is so far off by chance
_INFORMED = 1e-9  # least share of its square that a column must keep once all others are fitted
CUT = 3.0
SIZES = (1 / 32, 1 / 16, 1 / 8, 1 / 4)
"""Sizes s that are looked for, as shares of the largest |X|, |Y| of the stars: 0.009 to 0.07° of a WALOP."""
_CELLS = 3  # in a size, along a side
_TOGETHER = 1 / 64  # of the largest |X|, |Y|: rows of a star that lie closer are one
_BLIND = 1e-3  # cᵀPc over cᵀc below which a star does not see a camera
_MOST = 8  # places
_WIDER = 2.0  # a fitted place may be larger by this factor, and lie off by so many sizes

Sizes = Float[np.ndarray, " c"]  # of all columns


def scored(
    changes: Sequence[PossibleChange], matrix: ColumnProducts, score: Sizes, beside: Sequence[int] = ()
) -> list[PossibleChange]:
    """Changes with size and error, each tested by itself in a model that fits the changes number `beside`.

    The changes `beside` come back as they are. `matrix` and `score` are Q and g: first of the columns of all changes,
    then of the columns that are always fitted (priors included).
    """
    free = [n for n in range(len(changes)) if n not in beside]
    order = [*free, *beside, *range(len(changes), len(score))]
    remaining, along = residuals.eliminated(matrix[np.ix_(order, order)], score[order], len(free))
    sized = [*changes]
    for n, information, slope in zip(free, np.diag(remaining), along, strict=True):
        if information > _INFORMED * matrix[n, n]:
            error = float(information**-0.5)
            sized[n] = sized[n]._replace(size=float(slope * error**2), error=error)
    return sized


def is_near(errors: Float[np.ndarray, " n"]) -> bool:
    """True if errors of the calibration, in units of its root, are no larger than chance makes them."""
    return bool(errors @ errors <= _FARTHEST**2 * len(errors))


class StarSearch:
    """Stars, the columns that are asked of them, and the errors of the calibration, which raise no alarm.

    `vectors` are those of the calibration by which the residuals were made; `kinds` the columns of the cameras.
    """

    def __init__(self, stars: StarResiduals, vectors: AnalysisVectors, kinds: Sequence[str]) -> None:
        self.stars = stars
        self.columns = StarColumns(stars, vectors, kinds)
        self.cameras = self.columns.cameras
        self.variance = own_variance(stars)
        self.crowded = bool(np.median(self.variance) > residuals.CROWDED)
        self.photons = float(np.sqrt(0.5 * np.median(np.trace(stars.photon, axis1=1, axis2=2))))
        self.matters = np.abs(vectors.root).max(axis=0, initial=0.0) > 0
        self.root = vectors.root[:, self.matters]

    def off(self, alike: Sequence[PossibleChange]) -> float | None:
        """By how much the simplest of changes alike, that of a camera if there is one, moves q or u of stars.

        The median of the larger shift, of the stars that it acts on; None where it has no column, or moves no star.
        """
        change = next((entry for entry in alike if entry.camera), alike[0])
        if change.kind == UNNAMED:
            return None
        shifts = [part.shift(self.column(part, rows, change)) for _, rows, part in self.stars.blocks()]
        largest = np.abs(change.size * np.concatenate(shifts)).max(axis=1)
        return float(np.median(largest[largest > 0])) if largest.any() else None

    def column(self, part: StarResiduals, rows: slice, change: PossibleChange) -> Residuals:
        """The column of a change in some stars, of which these are the rows."""
        return self.columns.of(part, change)

    def errors(self, part: StarResiduals) -> Float[np.ndarray, "r k n"]:
        """Columns of the errors of the calibration and of unknown colours, of unit variance."""
        return np.concatenate([part.parameters() @ self.root, part.colour], axis=-1)


class CatalogueSearch(StarSearch):
    """The questions of a catalogue, then the errors of the calibration.

    `at` are the errors of the calibration, in units of its root, with which `stars` were computed (None: none).
    """

    def __init__(
        self,
        stars: StarResiduals,
        vectors: AnalysisVectors,
        at: Float[np.ndarray, " n"] | None = None,
    ) -> None:
        super().__init__(stars, vectors, OF_CATALOGUES)
        columns = self.columns
        pairs = itertools.product(columns.kinds, range(len(self.cameras)))
        asked = [columns.of_one(kind, (k,)) for kind, k in pairs]
        asked += [columns.of_one("light", range(len(self.cameras))), *columns.optics]
        self.questions = [question.change() for question in asked]
        self.asked = len(asked)
        self.mixing = np.zeros((columns.count + len(columns.optics), self.asked))
        for n, question in enumerate(asked):
            for column, weight in question.along.items():
                self.mixing[column, n] = weight
        self._alarm = ALARM / (self.asked + 2)
        nuisances = self.root.shape[1]
        self.prior = np.concatenate([np.zeros(self.asked), np.ones(nuisances + 2)])
        self.start = np.zeros(len(self.prior))
        if at is not None:
            self.start[self.asked : -2] = at[self.matters]
        self.nearest = self.start

    def _columns(self, part: StarResiduals, rows: slice) -> Float[np.ndarray, "r k c"]:
        return np.concatenate([self.columns.all_of(part) @ self.mixing, self.errors(part)], axis=-1)

    def _left(self, sizes: Sizes) -> Residuals:
        """The residuals less changes of all columns by these sizes."""
        if np.array_equal(sizes, self.start):
            return self.stars.residual
        amounts = sizes - self.start
        return self.stars.behind(self.stars.residual, lambda *part: self._columns(*part) @ amounts)

    def _looked(self, sizes: Sizes, *, stated: bool = False) -> _Look:
        """Scales, Q and g (priors included) of residuals less changes of these sizes; `stated`: N_ERR as it is."""
        stars, dof = self.stars, self.stars.dof.astype(float)

        def scale_of(residual: Residuals) -> Scale:
            return residuals.noise_scale(stars.chi2(residual) / self.variance, dof)

        residual = self._left(sizes)
        noise, rows = scale_of(residual), residuals.shared_by_rows(stars, residual, self.variance)

        def look(scale: Scale, heavier: float = 1.0) -> _Look:
            off = residuals.is_off(scale, self._alarm) and not self.crowded
            single = heavier * (scale.value if scale.value > 1 or off else 1.0)
            several = single
            if not stated and rows is not None and _chance_beside(rows, noise) < self._alarm:
                several = max(single, rows.value)
            variances = self.variance * np.where(stars.rows > 1, several, single)
            weights = StarWeights(scale.kept / variances, scale.share)
            matrix, score = residuals.normal_matrix(stars, residual, self._columns, weights)
            return _Look(noise, rows, matrix + np.diag(self.prior), score - self.prior * sizes)

        if stated:
            return look(noise._replace(value=1.0))
        weighted = look(noise)
        # A common shift of all stars is no noise: weights come from the scatter about the gains that fit them best.
        for _ in range(residuals.ABOUT_GAINS if residuals.is_off(noise, self._alarm) else 0):
            gains, fitted = self._gains(weighted)
            about = residuals.beside_fitted(scale_of(self._left(sizes + gains)), dof, fitted)
            if about.worth < residuals.FEW:
                break
            off = residuals.is_off(about, self._alarm)
            weighted = look(about, residuals.of_few(about, alarms.threshold(self._alarm)) if off else 1.0)
        return weighted

    def _gains(self, look: _Look) -> tuple[Sizes, int]:
        """The gains of the cameras that fit the stars best, among all sizes, and how many numbers these are."""
        cameras = len(self.cameras)
        order = [*range(cameras), *range(self.asked, len(look.score))]
        gains = np.zeros_like(look.score)
        matrix, score = residuals.eliminated(look.matrix[np.ix_(order, order)], look.score[order], cameras)
        root = whitening(matrix, residuals.SINGULAR)
        gains[:cameras] = root @ (root.T @ score)
        return gains, root.shape[1]

    def answer(self) -> CatalogueCheck:
        """All questions, then again behind the changes that were detected."""
        sizes = self.start
        chosen: list[int] = []
        look = self._looked(sizes)
        tests = scored(self.questions, look.matrix, look.score, chosen)
        if self._suspicious(look, tests):  # else one linear step is all there is to do
            # Errors of the calibration that explain the stars best with N_ERR as stated.
            _, explained = self._settled(self._looked(self.start, stated=True), self.start, [], stated=True)
            plausible = is_near(explained[self.asked : -2])
            # Scatter that they can explain is not held against N_ERR.
            if plausible and not residuals.is_off((by_errors := self._looked(explained)).noise, self._alarm):
                look, sizes = by_errors, explained
            look, sizes = self._settled(look, sizes, chosen)
            self.nearest = explained if plausible else sizes
            tests = scored(self.questions, look.matrix, look.score, chosen)
        # The gain change of one camera that raises the alarm in 99 % of cases.
        least = min((t.error for t in tests if t.kind == "gain"), default=np.inf)
        factor = alarms.threshold(self._alarm) + MOST_LIKELY
        smallest = factor * least if np.isfinite(least) else np.nan
        answers = tests
        while len(chosen) < _MOST_CHANGES:
            strongest = max(range(self.asked), key=lambda n: abs(answers[n].sigma), default=-1)
            new = strongest >= 0 and strongest not in chosen
            if not new or alarms.chance_of(answers[strongest].sigma) >= self._alarm:
                break
            chosen.append(strongest)
            look, sizes = self._settled(look, sizes, chosen)
            answers = scored(self.questions, look.matrix, look.score, chosen)
        changes = tuple(self._change(look, sizes, chosen, n) for n in chosen)
        noise, rows = look.noise, look.rows
        rows_p = 1.0 if rows is None or self.crowded else _chance_beside(rows, noise)
        check = CatalogueCheck(
            stars=len(self.stars.photon),
            rows_used=len(self.stars),
            asked=self.asked + 2,
            noise=noise.value,
            noise_p=1.0 if self.crowded else residuals.chance_of_scale(noise),
            rows=None if rows is None else rows.value,
            rows_p=rows_p,
            tests=tuple(tests),
            changes=changes,
            smallest=smallest,
            growth=self.columns.growth,
            photons=self.photons,
        )
        return dataclasses.replace(check, places=self._places(check, look, sizes, chosen))

    def _places(
        self, found: CatalogueCheck, look: _Look, sizes: Sizes, chosen: list[int]
    ) -> tuple[DisagreeingPlace, ...]:
        """Places where stars disagree together, behind the changes and the errors of the calibration."""
        single, several = (max(scale, found.noise, 1.0) for scale in found.scale)
        variance = self.variance * np.where(self.stars.rows > 1, several, single)
        for fitted in (False, True):  # the fit takes as long as all before it
            if fitted:
                sizes = self._settled(look, sizes, chosen)[1]
            places = places_of(self.stars, self.cameras, self._left(sizes), variance)
            if not places:
                break
        return tuple(dataclasses.replace(place, off=self.off(place.alike)) for place in places)

    def errors_of_calibration(self) -> Float[np.ndarray, " n"] | None:
        """Errors of the calibration, in units of `root`, that explain the stars best; None if implausibly large.

        To be called after `answer`. They are found with N_ERR as stated or, if that is implausible, with errors as
        large as the scatter.
        """
        errors = np.zeros(len(self.matters))
        errors[self.matters] = self.nearest[self.asked : -2]
        return errors if is_near(errors[self.matters]) else None

    def bend(self, errors: Float[np.ndarray, " n"], residual: Residuals) -> float:
        """What first order misses of errors of the calibration: mean square, per degree of freedom, median over stars.

        `residual` are the exact residuals with these errors; the residuals to first order are subtracted.
        """
        sizes = self.start.copy()
        sizes[self.asked : -2] = errors[self.matters]
        off = self.stars.chi2(residual - self._left(sizes)) / self.variance
        return float(np.median(off / np.maximum(self.stars.dof, 1)))

    def _suspicious(self, look: _Look, tests: list[PossibleChange]) -> bool:
        """True if anything comes near an alarm."""
        rows = 1.0 if look.rows is None else _chance_beside(look.rows, look.noise)
        strongest = max((abs(test.sigma) for test in tests), default=0.0)
        chances = rows, residuals.chance_of_scale(look.noise), alarms.chance_of(strongest)
        return min(chances) < 100.0 * self._alarm

    def _settled(
        self, look: _Look, sizes: Sizes, chosen: list[int], *, stated: bool = False
    ) -> tuple[_Look, Sizes]:
        """The look and the sizes once changes `chosen` and errors of the calibration are fitted together.

        Outliers are chosen anew in each step.
        """
        fitted = np.array([*chosen, *range(self.asked, len(sizes))])
        for _ in range(_ROUNDS):
            matrix = look.matrix[np.ix_(fitted, fitted)]
            root = whitening(matrix, residuals.SINGULAR)
            step = root @ (root.T @ look.score[fitted])
            if step @ matrix @ step < _SETTLED**2:
                break
            sizes = sizes.copy()
            sizes[fitted] += step
            look = self._looked(sizes, stated=stated)
        return look, sizes

    def _change(self, look: _Look, sizes: Sizes, chosen: list[int], asked: int) -> FoundChange:
        """A detected change, and its rivals."""
        away = np.zeros_like(sizes)
        away[asked] = sizes[asked]
        score = look.score + look.matrix @ away
        measured = scored(self.questions, look.matrix, score, [k for k in chosen if k != asked])
        best = max(measured, key=lambda entry: entry.sigma**2)
        alike = rivals_of(best, measured)
        # A gain is the simplest of what describes the stars alike.
        ranked = sorted(alike, key=lambda entry: (entry.kind != "gain", -abs(entry.sigma)))
        return FoundChange(ranked[0], tuple(ranked), off=self.off(ranked))


def with_own_light(
    check: CatalogueCheck, light: OwnLight, cameras: Sequence[str], arms: Sequence[tuple[int, int]]
) -> CatalogueCheck:
    """A check with what q and u of the stars say of the balance of the arms.

    A change of a camera moves q and u as well as the sums of the cameras. A change that both show is reported once: of
    the changes that describe the sums alike, those are kept that, once subtracted, leave nothing to find in q and u.
    """
    named = [(cameras[first], cameras[second]) for first, second in arms]
    own, changes = own_light_check(light, named), [*check.changes]
    undated = np.full(len(light.x), np.nan)
    for n, change in enumerate(check.changes if own is not None and own.found else ()):
        kept = []
        for entry in (entry for entry in change.alike if entry.relative):
            size = np.full(len(light.x), entry.size)
            share = check.growth.electrons(entry, light.x, light.y, undated, size)
            shift = sum(light.cameras[:, :, cameras.index(name)] for name in entry.members)
            beside = own_light_check(light.without(share[:, None] * shift), named)
            if beside is not None and not beside.found:
                kept.append((entry, beside))
        if kept:  # added light is no share of the counts, and cannot be tested by q and u
            alike = (*(entry for entry, _ in kept), *(entry for entry in change.alike if not entry.relative))
            changes[n], own = dataclasses.replace(change, best=alike[0], alike=alike), kept[0][1]
            break
    return dataclasses.replace(check, changes=tuple(changes), own=own)


class _Look(NamedTuple):
    noise: Scale
    rows: Scale | None
    matrix: ColumnProducts
    score: Sizes


def _chance_beside(rows: Scale, noise: Scale) -> float:
    """Probability that noise alone makes the common part of the rows of a star so large, beside the scatter of all."""
    if rows.worth <= 0 or noise.worth <= 0:
        return 1.0
    return float(special.fdtrc(rows.worth, noise.worth, rows.value / noise.value))


# ----------------------------------------------------------------------------------------------- places of the field


class Seen(NamedTuple):
    """Stars at places: positions, z and α of every camera, or of cameras together; χ² and its degrees of freedom."""

    x: OfStars
    y: OfStars
    z: Float[np.ndarray, "s k"]
    alpha: Float[np.ndarray, "s k"]
    chi2: OfStars
    dof: OfStars

    def of(self, chosen: Bool[np.ndarray, " s"]) -> Seen:
        """Some of the stars."""
        return Seen(*(values[chosen] for values in self))

    def near(self, place: SpotPlace) -> Seen:
        """The stars that a spot at a place would reach if it were `_WIDER` times as large."""
        return self.of(profile(self.x, self.y, (*place[:2], _WIDER * place[2])) > 0)


class Strongest(NamedTuple):
    """The place of the largest |Z|: its sign and size, the number of the camera, and the number of trials."""

    place: SpotPlace
    sigma: float
    camera: int
    trials: int


def places_of(
    stars: StarResiduals,
    cameras: Sequence[str],
    residual: Residuals | None = None,
    variance: OfStars | None = None,
    alarm: float = ALARM,
) -> tuple[DisagreeingPlace, ...]:
    """Places of the field where stars disagree together, the most significant first.

    Noise alone makes a place in a fraction `alarm` of all catalogues.

    `cameras` are names. `residual` is that of `stars`, with or without changes, `variance` that of the
    residuals of every star over that of its noise (None: `own_variance`).
    """
    residual = stars.residual if residual is None else residual
    seen = _seen(stars, residual, own_variance(stars) if variance is None else variance)
    extent = max(float(np.abs([seen.x, seen.y]).max(initial=0.0)), 1e-9)
    places: list[DisagreeingPlace] = []
    remaining = np.ones(len(seen.x), bool)
    while len(places) < _MOST and remaining.sum() > 1:
        subset = seen.of(remaining)
        largest = strongest(subset, extent)
        if largest.trials * alarms.chance_of(largest.sigma) >= alarm:
            break
        place = _described(subset, largest, cameras)
        places.append(place)
        remaining &= place.profile(seen.x, seen.y) == 0.0
    return tuple(places)


Sums = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""cᵀr; cᵀPc before q and u are fitted; the root of what q and u take of it; cᵀc. By row, or summed over a star."""


def _sums(stars: StarResiduals, residual: Residuals, members: Float[np.ndarray, "k c"]) -> Sums:
    """The sums of every row for cameras together: `members` are 1 for those."""
    columns = []
    for _, rows, part in stars.blocks():
        free, _ = part.projected(part.model[..., None] * members)
        half = np.linalg.cholesky(part.photon).swapaxes(1, 2)[part.star]
        along = half @ np.einsum("rik,crk->ric", part.tangent, free, optimize=True)
        score = (part.model * residual[rows]) @ members
        columns.append((score, np.sum(free**2, axis=-1).T, along, part.model**2 @ members))
    score, square, along, full = map(np.concatenate, zip(*columns, strict=True))
    return score, square, along, full


def _seeing(sums: Iterable[np.ndarray], spread: Float[np.ndarray, "s 1"]) -> tuple[np.ndarray, np.ndarray]:
    """z and α of stars with these sums; `spread` is the variance of their residuals."""
    score, square, along, full = sums
    information = square - np.sum(along**2, axis=1)
    sees = information > _BLIND * full
    root = np.sqrt(np.where(sees, information, 1.0) * spread)
    return np.where(sees, score / root, 0.0), np.where(sees, root / spread, 0.0)


def _seen(stars: StarResiduals, residual: Residuals, variance: OfStars) -> Seen:
    """z and α of the stars; rows of one star at different places are stars of their own."""
    extent = max(float(np.abs([stars.x, stars.y]).max(initial=0.0)), 1e-9)
    cell = np.round(np.stack([stars.x, stars.y], axis=1) / (_TOGETHER * extent)).astype(int)
    key = np.column_stack([stars.star, cell])
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)

    def summed(values: np.ndarray) -> np.ndarray:
        total = np.zeros((len(first), *values.shape[1:]))
        np.add.at(total, group.reshape(-1), values)
        return total

    star = stars.star[first]
    spread = variance[star]
    cameras = np.eye(stars.model.shape[1])
    z, alpha = _seeing(map(summed, _sums(stars, residual, cameras)), spread[:, None])
    chi2 = summed(np.sum(residual**2, axis=1)) / spread
    dof = np.maximum(stars.dof[star] / np.bincount(star)[star], 0.5)
    return Seen(stars.x[first], stars.y[first], z, alpha, chi2, dof)


def seen_from(
    stars: StarResiduals,
    group: Int[np.ndarray, " r"],
    members: Float[np.ndarray, "k c"],
    residual: Residuals,
    variance: OfStars,
) -> Iterator[Seen]:
    """The stars by their rows of each exposure group and of all that follow it; `members` as in `_sums`."""
    first, sums = stars.first, _sums(stars, residual, members)
    about = stars.chi2(residual) / variance, stars.dof.astype(float)
    for start in range(int(group.max()) + 1):
        on = (group >= start).astype(float)
        later = (np.add.reduceat((on * values.T).T, first) for values in sums)
        yield Seen(stars.x[first], stars.y[first], *_seeing(later, variance[:, None]), *about)


def strongest(seen: Seen, extent: float) -> Strongest:
    """The place of the largest |Z| of stars whose |X| and |Y| reach to `extent` (deg)."""
    best, trials = Strongest((0.0, 0.0, 0.0), 0.0, 0, 0), 0
    cut = np.clip(seen.z, -CUT, CUT)
    sees = (seen.alpha > 0).astype(float)
    variance = max(1.0, float(np.sum(cut**2) / max(sees.sum(), 1.0)))
    for share in SIZES:
        size = share * extent
        cell = size / _CELLS
        place = np.floor(np.stack([seen.x, seen.y]) / cell).astype(int)
        place -= place.min(axis=1, keepdims=True)
        shape = tuple(int(n) + 1 for n in place.max(axis=1))
        index = np.asarray(np.ravel_multi_index(tuple(place), shape))
        occupied = np.unique(index)
        for k in range(seen.z.shape[1]):
            for weight in (seen.alpha[:, k], sees[:, k]):
                top = _smoothed(index, weight * cut[:, k], shape, 1)[occupied]
                bottom = _smoothed(index, weight**2, shape, 2)[occupied]
                z = top / np.sqrt(variance * np.where(bottom > 0, bottom, np.inf))
                largest = int(np.argmax(np.abs(z)))
                if abs(z[largest]) > abs(best.sigma):
                    inside = index == occupied[largest]
                    centre = float(seen.x[inside].mean()), float(seen.y[inside].mean())
                    best = Strongest((*centre, size), float(z[largest]), k, 0)
                trials += len(occupied)
    return best._replace(trials=trials)


def _smoothed(
    index: Int[np.ndarray, " s"], values: OfStars, shape: tuple[int, ...], power: int
) -> Float[np.ndarray, " c"]:
    """Sums of values over cells with the weights g (`power` 1) or g² (2)."""
    reach = _CELLS * int(alarms.REACH)
    kernel = np.exp(-0.5 * power * (np.arange(-reach, reach + 1) / _CELLS) ** 2)
    sums = np.bincount(index, values, minlength=int(np.prod(shape))).reshape(shape)
    for axis in (0, 1):
        sums = ndimage.correlate1d(sums, kernel, axis=axis, mode="constant")
    return sums.ravel()


def _described(seen: Seen, found: Strongest, cameras: Sequence[str]) -> DisagreeingPlace:
    """The place about the strongest one, with the cameras that describe its stars as well as the best one."""
    subset = seen.near(found.place)
    fits: list[tuple[tuple[float, float, float], SpotPlace, int]] = []
    for k in range(len(cameras)):
        place = fitted(subset, k, found.place)
        fits.append((share_of(subset, k, profile(subset.x, subset.y, place)), place, k))
    fits.sort(key=lambda fit: -fit[0][2])
    (*_, best), place, _ = fits[0]
    scatter = (subset.chi2.sum() - best) / max(subset.dof.sum() - 4.0, 1.0)
    alike, numbers = [], []
    for (size, error, gain), _, k in fits:
        if gain > best - RIVAL * max(1.0, scatter):
            alike.append(PossibleChange(cameras[k], True, size=size, error=error, kind="spot", place=place))
            numbers.append(k)
    stars = int((profile(subset.x, subset.y, place) > np.exp(-2.0)).sum())
    x, y, size = place
    return DisagreeingPlace(x, y, size, found.sigma, stars, tuple(alike), tuple(numbers))


def fitted(seen: Seen, camera: int, start: SpotPlace) -> SpotPlace:
    """The place at which a camera describes the stars best, near the one that was looked for, its edge as sharp."""
    x, y, size, *edge = start

    def place(moved: Float[np.ndarray, " 3"]) -> SpotPlace:
        return (x + size * float(moved[0]), y + size * float(moved[1]), size * float(np.exp(moved[2])), *edge)

    def misfit(moved: Float[np.ndarray, " 3"]) -> float:
        return float(moved @ moved) - share_of(seen, camera, profile(seen.x, seen.y, place(moved)))[2]

    bounds = [(-_WIDER, _WIDER)] * 2 + [(-1.0, np.log(_WIDER))]
    first = np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    options = {"maxiter": 200, "xatol": 0.01, "fatol": 0.1, "initial_simplex": first}
    solution = optimize.minimize(misfit, np.zeros(3), method="Nelder-Mead", bounds=bounds, options=options)
    return place(solution.x)


def described(seen: Seen, camera: int, place: SpotPlace, size: float) -> Bool[np.ndarray, " s"]:
    """True for stars whose shift is the one that a spot of this `size` in a camera at a place predicts.

    Allowed are `CUT` standard errors plus half of the predicted shift: spots have edges, which the profile has not.
    """
    shift = size * seen.alpha[:, camera] * profile(seen.x, seen.y, place)
    return (shift != 0) & (np.abs(seen.z[:, camera] - shift) < CUT + 0.5 * np.abs(shift))


def share_of(seen: Seen, camera: int, g: OfStars) -> tuple[float, float, float]:
    """β of a camera, its standard error, and by how much it makes χ² smaller."""
    shape = seen.alpha[:, camera] * g
    square, score = float(shape @ shape), float(shape @ seen.z[:, camera])
    return (score / square, square**-0.5, score**2 / square) if square > 0 else (0.0, np.inf, 0.0)

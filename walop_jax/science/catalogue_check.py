"""Do the stars of a catalogue, all together, still agree with the calibration and with their stated errors?

Asked are, of the residuals of `star_residuals`:

noise       Σ χ² against Σ ν, from both sides: N_ERR too small or too large
rows        the common part of the rows of one star: rows that are there twice, noise that is correlated
places      stars that disagree together at one place of the field (`places`)
changes     the mean residual of every camera and how it grows with X, Y, time and flux, light that is added to every
            row, and all parameters of the optics; the strongest is fitted with the errors of the calibration and
            asked for again, until nothing is left

One correction for all of them: the chance is `ALARM` that noise raises any. Where analysers split the light in two,
stars of a single exposure can hardly tell the cameras of an arm, or one arm brighter from the other fainter: what
describes the data as well (Δχ² < `RIVAL`) is reported together.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.likelihood.inverses import whitening
from walop_jax.science import instrument_changes as alarms
from walop_jax.science import star_residuals as residuals
from walop_jax.science.catalogue_readings import DISAGREE, CatalogueReadings
from walop_jax.science.instrument_changes import InstrumentChange, PossibleChange, profile
from walop_jax.science.left_over_sky import LeftOverSky
from walop_jax.science.own_light import ArmChange, OwnLightCheck
from walop_jax.science.places import DisagreeingPlace, places_of
from walop_jax.science.star_residuals import Residuals, Scale, StarResiduals, Weights

NOISE_MATTERS = 1.1
"""Factor on χ² below which, and above the inverse of which, errors are left as they are (5 % of N_ERR)."""
_MOST_CHANGES = 6
_ROUNDS = 8
_SETTLED = 0.05  # standard errors
_FARTHEST = 5.0  # standard errors in every direction: no calibration is so far off by chance
_FAR_TOO_SMALL = 5.0  # factor on N_ERR that is likelier a fault of the counts
_REFERENCE = 1e6  # electron

Matrix = Float[np.ndarray, "c c"]
Vector = Float[np.ndarray, " r"]  # a number for each row
Sizes = Float[np.ndarray, " c"]  # of all columns
CAMERA_KINDS = ("gain", "x", "y", "time", "flux", "light")


class Growth(NamedTuple):
    """Units in which changes of a camera grow: `edge` of the field (deg), middle and half of the time covered (d)."""

    edge: float = 1.0
    middle: float = 0.0
    half: float = 0.0

    def electrons(self, change: PossibleChange, x: Vector, y: Vector, time: Vector, counts: Vector) -> Vector:
        """Electrons that a change of `CAMERA_KINDS`, or a spot, of unit size adds to `counts` of its camera."""
        if change.kind == "light":
            return np.ones_like(counts)
        if change.kind == "flux":
            return counts**2 / _REFERENCE
        if change.kind == "spot":
            return counts * profile(x, y, change.place)
        since = np.nan_to_num(time - self.middle) / (self.half or 1.0)
        return counts * {"x": x / self.edge, "y": y / self.edge, "time": since}.get(change.kind, 1.0)


IN_UNITS = Growth()


@dataclasses.dataclass(frozen=True)
class CatalogueCheck:
    """Findings from the stars of a catalogue together.

    `noise` is χ² per degree of freedom behind the changes (1 expected; without outliers) and `noise_p` its chance;
    `rows` the factor by which the common variance of the rows of a star exceeds N_ERR, None where every star has
    one row, and `rows_p` its chance beside `noise`. `tests` are the `asked` questions in their first answer;
    `smallest` is the gain change of the camera seen best that would be found in 99 % of cases (nan: none). `stars` and
    `rows_used` count the sample; `growth` holds the units of X, Y and time; stars of `places` disagree together; `sky`
    is the light of the sky left over (None: its level is not stated), `readings` are other readings of the rows, and
    `own` is what q and u of the stars say of the arms (None: of few stars).
    """

    stars: int
    rows_used: int
    asked: int
    noise: float
    noise_p: float
    rows: float | None
    rows_p: float
    tests: tuple[PossibleChange, ...]
    changes: tuple[InstrumentChange, ...]
    smallest: float
    growth: Growth = IN_UNITS
    places: tuple[DisagreeingPlace, ...] = ()
    sky: LeftOverSky | None = None
    readings: CatalogueReadings | None = None
    own: OwnLightCheck | None = None

    @property
    def unbalanced(self) -> tuple[ArmChange, ...]:
        """Changes of the balance of an arm that the stars' own q and u show, those alike."""
        return () if self.own is None else self.own.alike

    @property
    def misread(self) -> bool:
        """True if another reading of the catalogue mends it."""
        return self.readings is not None and self.readings.mended

    @property
    def doubtful(self) -> bool:
        """True where what the stars show is no plausible change of the instrument, or more than one explains."""
        unlike = any(change.best.implausible for change in self.changes)
        tried = self.readings is not None and self.readings.stands.disagree > DISAGREE
        odd = unlike or self.places or self.noise_is_off or len(self.changes) > 1
        return bool(odd) and not self.misread and not self.unbalanced and not tried

    @property
    def alarm(self) -> float:
        """The chance below which a single answer counts."""
        return alarms.ALARM / max(self.asked, 1)

    @property
    def noise_is_off(self) -> bool:
        """True if the counts do not scatter by N_ERR."""
        off = not 1.0 / NOISE_MATTERS < self.noise < NOISE_MATTERS
        return self.noise > residuals.NO_NOISE and self.noise_p < self.alarm and off and not self.rows_agree

    @property
    def rows_agree(self) -> bool:
        """True if rows of a star have more in common than light."""
        if self.rows is None or self.rows < residuals.NO_NOISE:
            return False
        return self.rows_p < self.alarm and self.rows > NOISE_MATTERS * self.noise

    @property
    def scale(self) -> tuple[float, float]:
        """Factors on the photon covariance of stars of one row and of several: 1 unless errors are off."""
        single = self.noise if self.noise_is_off else 1.0
        # χ² of rows that repeat each other does not test N_ERR: their common part does.
        return single, self.rows if self.rows is not None and self.rows_agree else single

    @property
    def holds(self) -> bool:
        """True if calibration and errors stand."""
        return self.holds_elsewhere and not self.places and not (self.sky is not None and self.sky.found)

    @property
    def holds_elsewhere(self) -> bool:
        """True if calibration and errors stand but for some places in the field."""
        off = self.changes or self.unbalanced or self.misread
        return not (off or self.noise_is_off or self.rows_agree)

    def warnings(self) -> tuple[str, ...]:
        """A sentence for each thing that does not hold."""
        if self.readings is not None and self.readings.mended:
            return (self.readings.words(),)
        texts = [place.words() for place in self.places]
        if self.own is not None and self.own.found:
            # Such a change moves the sums of the arms by second orders, which no change of its own explains.
            plausible = [change.words() for change in self.changes if not change.best.implausible]
            texts = [self.own.words(), *plausible, *texts]
        elif any(change.best.implausible for change in self.changes):
            what = "the counts contradict the calibration by more than an instrument changes"
            question = "of this instrument, of all cameras in one unit and aperture, and in their order?"
            texts = [f"{what}: are they {question}"]  # what follows from it is no dust
        else:
            texts = [*(change.words() for change in self.changes), *texts]
        if self.sky is not None and self.sky.found:
            texts.append(self.sky.words())
        if self.rows_agree:
            assert self.rows is not None
            texts.append(
                f"the rows of a star agree more than independent rows do: together their variance is {self.rows:.3g} "
                "times N_ERR. Are rows there twice, or is their noise correlated? Photon errors of stars of "
                f"several rows were multiplied by {np.sqrt(self.scale[1]):.3g}"
            )
        if self.noise_is_off:
            factor = np.sqrt(self.noise)
            word = f"{factor:.3g} times too small" if factor > 1 else f"{1 / factor:.3g} times too large"
            instead = "" if factor < _FAR_TOO_SMALL else "the counts contradict the calibration, or "
            text = f"{instead}N_ERR is {word}: χ²/dof of the stars together is {self.noise:.3g}. Photon errors were"
            texts.append(f"{text} multiplied by {factor:.3g}")
        return tuple(texts)

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""

        def entry(change: PossibleChange) -> dict[str, Any]:
            return {key: getattr(change, key) for key in ("kind", "name", "unit", "size", "error", "sigma")}

        return {
            "holds": self.holds,
            "stars": self.stars,
            "rows": self.rows_used,
            "asked": self.asked,
            "chi2_per_dof": self.noise,
            "chi2_p_value": self.noise_p,
            "shared_by_rows": self.rows,
            "shared_p_value": self.rows_p,
            "photon_error_factors": [float(np.sqrt(s)) for s in self.scale],
            "changes": [{"best": entry(c.best), "alike": [entry(e) for e in c.alike]} for c in self.changes],
            "places": [place.document() for place in self.places],
            "tests": [entry(test) for test in self.tests],
            "readings": None if self.readings is None else self.readings.document(),
            "own_light": None if self.own is None else self.own.document(),
            "sky": None if self.sky is None else self.sky.document(),
            "smallest_gain_seen": self.smallest if np.isfinite(self.smallest) else None,
            "warnings": list(self.warnings()),
        }


NOTHING_TO_SPARE = CatalogueCheck(0, 0, 0, 1.0, 1.0, None, 1.0, (), (), np.nan)
"""Of a catalogue in which no row has a camera to spare."""


class CatalogueSearch:
    """The columns of all questions, then of the errors of the calibration.

    `cameras` are names; `parameters` names and units of those of `stars.parameters()`, of which the first, as many as
    `stars.plain` has, are asked as well; `root` is a square root of their covariance, C = root rootᵀ. `at` are the
    errors of the calibration, in units of `root`, with which `stars` were computed (None: none). `widths` are those of
    the priors of the parameters (None: no prior; none given: not known).
    """

    def __init__(
        self,
        stars: StarResiduals,
        cameras: Sequence[str],
        parameters: Sequence[tuple[str, str]],
        root: Float[np.ndarray, "n n"],
        at: Float[np.ndarray, " n"] | None = None,
        widths: Sequence[float | None] = (),
    ) -> None:
        self.stars = stars
        self.variance = residuals.own_variance(stars)
        self.crowded = bool(np.median(self.variance) > residuals.CROWDED)
        self.matters = np.abs(root).max(axis=0, initial=0.0) > 0
        self.root = root[:, self.matters]
        self.growth = Growth(max(float(np.abs(np.concatenate([stars.x, stars.y])).max()), 1e-9))
        times = stars.time[np.isfinite(stars.time)]
        if times.size and np.ptp(times) > 0:
            middle, half = 0.5 * float(times.min() + times.max()), 0.5 * float(np.ptp(times))
            self.growth = self.growth._replace(middle=middle, half=half)
        kinds = [kind for kind in CAMERA_KINDS if kind != "time" or self.growth.half > 0]
        units = {"flux": "per 1e6 electron", "light": "electron"}
        self.cameras = tuple(cameras)
        pairs = itertools.product(kinds, cameras)
        self.of_cameras = [PossibleChange(n, True, kind=k, unit=units.get(k, "")) for k, n in pairs]
        plain = stars.plain.shape[-1]
        most = [alarms.FARTHEST * (width or np.inf) for width in (*widths, *[None] * plain)][:plain]
        optics = (
            PossibleChange(name, False, kind="optics", unit=unit, widest=widest)
            for (name, unit), widest in zip(parameters[:plain], most, strict=True)
        )
        self.questions = [*self.of_cameras, *optics]
        # Columns: those of the cameras, all parameters, two of the colours; from them questions and nuisances are made.
        count, shown, nuisances = len(self.of_cameras), len(root), self.root.shape[1]
        questions = self.asked = len(self.questions)
        self._alarm = alarms.ALARM / (questions + 2)
        self.mixing = np.zeros((count + shown + 2, questions + nuisances + 2))
        self.mixing[:questions, :questions] = np.eye(questions)
        self.mixing[count : count + shown, questions : questions + nuisances] = self.root
        self.mixing[-2:, -2:] = np.eye(2)
        self.prior = np.concatenate([np.zeros(questions), np.ones(nuisances + 2)])
        self.start = np.zeros(len(self.prior))
        if at is not None:
            self.start[questions : questions + nuisances] = at[self.matters]
        self.nearest = self.start

    def _columns(self, part: StarResiduals, rows: slice) -> Float[np.ndarray, "r k c"]:
        cameras = part.model.shape[1]
        values = np.zeros((*part.model.shape, len(self.mixing)))
        place = (part.x, part.y, part.time)
        relative = np.where(part.root > 0, part.model / np.where(part.root > 0, part.root, 1.0), 0.0)
        for column, change in enumerate(self.of_cameras):
            k = column % cameras
            grown = self.growth.electrons(change, *place, relative[:, k])
            values[:, k, column] = grown * part.root[:, k]
        values[..., len(self.of_cameras) : -2] = part.parameters()
        values[..., -2:] = part.colour
        return values

    def _left(self, sizes: Sizes) -> Residuals:
        """Residuals behind changes of all columns."""
        if np.array_equal(sizes, self.start):
            return self.stars.residual
        amounts = self.mixing @ (sizes - self.start)
        return self.stars.behind(self.stars.residual, lambda *part: self._columns(*part) @ amounts)

    def _looked(self, sizes: Sizes, *, stated: bool = False) -> _Look:
        """Scales, Q and g (priors included) with these changes taken away; with `stated` of N_ERR as it is."""
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
            weights = Weights(scale.kept / variances, scale.share)
            matrix, score = residuals.normal_matrix(stars, residual, self._columns, weights)
            matrix = self.mixing.T @ matrix @ self.mixing + np.diag(self.prior)
            return _Look(noise, rows, matrix, self.mixing.T @ score - self.prior * sizes)

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
        tests = self._beside(look.matrix, look.score, chosen)
        if self._suspicious(look, tests):  # else one linear step is all there is to do
            # Errors of the calibration that explain the stars best with N_ERR as stated.
            _, explained = self._settled(self._looked(self.start, stated=True), self.start, [], stated=True)
            plausible = self._is_near(explained[self.asked : -2])
            # Scatter that they can explain is not held against N_ERR.
            if plausible and not residuals.is_off((by_errors := self._looked(explained)).noise, self._alarm):
                look, sizes = by_errors, explained
            look, sizes = self._settled(look, sizes, chosen)
            self.nearest = explained if plausible else sizes
            tests = self._beside(look.matrix, look.score, chosen)
        # The gain change of one camera that raises the alarm in 99 % of cases.
        least = min((t.error for t in tests if t.kind == "gain"), default=np.inf)
        factor = alarms.threshold(self._alarm) + alarms.MOST_LIKELY
        smallest = factor * least if np.isfinite(least) else np.nan
        answers = tests
        while len(chosen) < _MOST_CHANGES:
            strongest = max(range(self.asked), key=lambda n: abs(answers[n].sigma), default=-1)
            new = strongest >= 0 and strongest not in chosen
            if not new or alarms.chance_of(answers[strongest].sigma) >= self._alarm:
                break
            chosen.append(strongest)
            look, sizes = self._settled(look, sizes, chosen)
            answers = self._beside(look.matrix, look.score, chosen)
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
            growth=self.growth,
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
        return places

    @staticmethod
    def _is_near(errors: Float[np.ndarray, " n"]) -> bool:
        return bool(errors @ errors <= _FARTHEST**2 * len(errors))

    def errors_of_calibration(self) -> Float[np.ndarray, " n"] | None:
        """Errors of the calibration, in units of `root`, that explain the stars best; None if they cannot be.

        Known once there is an `answer`: with N_ERR as stated, else with errors as large as the scatter.
        """
        errors = np.zeros(len(self.matters))
        errors[self.matters] = self.nearest[self.asked : -2]
        return errors if self._is_near(errors[self.matters]) else None

    def bend(self, errors: Float[np.ndarray, " n"], residual: Residuals) -> float:
        """Mean square, per degree of freedom, of the residuals with errors of the calibration less first order."""
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
        """Changes `chosen` and errors of the calibration fitted together, with the stars that this keeps."""
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

    def _beside(self, matrix: Matrix, score: Sizes, chosen: list[int]) -> list[PossibleChange]:
        """Every question, alone beside `chosen`, which have no answer here."""
        free = [n for n in range(self.asked) if n not in chosen]
        order = [*free, *chosen, *range(self.asked, len(score))]
        remaining, along = residuals.eliminated(matrix[np.ix_(order, order)], score[order], len(free))
        sizes = [*self.questions]
        for n, information, slope in zip(free, np.diag(remaining), along, strict=True):
            if information > 1e-9 * matrix[n, n]:
                error = float(information**-0.5)
                sizes[n] = sizes[n]._replace(size=float(slope * error**2), error=error)
        return sizes

    def _change(self, look: _Look, sizes: Sizes, chosen: list[int], asked: int) -> InstrumentChange:
        """A detected change, and its rivals."""
        away = np.zeros_like(sizes)
        away[asked] = sizes[asked]
        score = look.score + look.matrix @ away
        measured = self._beside(look.matrix, score, [k for k in chosen if k != asked])
        best = max(measured, key=lambda entry: entry.sigma**2)
        alike = alarms.rivals_of(best, measured)
        # A gain is the simplest of what describes the stars alike.
        ranked = sorted(alike, key=lambda entry: (entry.kind != "gain", -abs(entry.sigma)))
        return InstrumentChange(ranked[0], tuple(ranked))


class _Look(NamedTuple):
    noise: Scale
    rows: Scale | None
    matrix: Matrix
    score: Sizes


def _chance_beside(rows: Scale, noise: Scale) -> float:
    """Probability that noise alone makes what rows share as large beside the scatter of all."""
    if rows.worth <= 0 or noise.worth <= 0:
        return 1.0
    return float(special.fdtrc(rows.worth, noise.worth, rows.value / noise.value))

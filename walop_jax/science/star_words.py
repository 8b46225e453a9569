"""What stars say of a calibration, in words: changes, places, the check of a catalogue, the watch of a survey."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from walop_jax.fit.verdict import Doubt, Quality
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import some, two_digits, with_error, with_minus_sign
from walop_jax.science import star_residuals as residuals
from walop_jax.science.catalogue_readings import DISAGREE, CatalogueReadings
from walop_jax.science.star_columns import ALARM, IN_UNITS, UNNAMED, Growth, PossibleChange, profile
from walop_jax.science.star_light import ArmChange, LeftOverSky, OwnLightCheck
from walop_jax.sky.nights import FIRST_DATE

NOISE_MATTERS = 1.1
"""Factor on χ² below which, and above the inverse of which, errors are left as they are (5 % of N_ERR)."""
SCATTERED = 4.0
"""χ² per degree of freedom from which stars in which no change is found do not say that a calibration holds."""
CALIBRATE = "take a calibration set and ask it: walop-jax check RUN NEW.fits"
CORRECT = "correct the catalogue, and apply the calibration again"
ERRORS = "correct N_ERR, or leave out stars that are blended, variable or saturated"
DATE_IT = "walop-jax check RUN STARS... dates it; new calibration exposures measure it"
LOOK = "look for dust, a ghost or a bright neighbour at that place"
TIMES = "give MJD in every row"
_FAR_TOO_SMALL = 5.0  # factor on N_ERR that is likelier a fault of the counts
_UNEXPLAINED = "a change that no camera, arm or place of the field makes"
_WHERE = {
    "x": " at the edge of the field along +X",
    "y": " at the edge of the field along +Y",
    "time": " at the end of the catalogue than in its middle",
    "flux": " for every 10⁶ electrons",
}
_COURSES = {
    "step": "from {} on",
    "drift": "at the end, drifting since {}",
    "once": "in the exposures of {} only",
}


def in_words(change: PossibleChange) -> str:
    """A change and its size in words."""
    if change.kind == UNNAMED:
        return f"{_UNEXPLAINED}, nor a number of the optics within its range"
    lower, name = change.size < 0, " and ".join(change.members) or change.name
    if not change.camera:
        size = with_error(abs(change.size), change.error)
        return f"{name} {('larger', 'smaller')[lower]} by {size} {change.unit}".rstrip()
    if change.kind == "light":
        size = with_error(abs(change.size), change.error)
        return f"{size} electrons too {('many', 'few')[lower]} in every row of {name}"
    where = _WHERE.get(change.kind, "")
    if change.kind == "gradient":
        where = f" at the edge of the field {round(change.place[0]) % 360}° from X towards Y"
    elif change.kind == "spot":
        x, y = (with_minus_sign(f"{value:.3f}") for value in change.place[:2])
        where = f" in a spot at X = {x}°, Y = {y}°, within {2 * change.place[2]:.2g}°"
    size = with_error(100 * abs(change.size), 100 * change.error)
    return f"{name} {('brighter', 'fainter')[lower]} by {size} %{where}"


@dataclasses.dataclass(frozen=True)
class FoundChange:
    """A change since the calibration: the simplest description, and all that describe the stars alike (it included).

    In a survey it began at `time` (MJD, or the number of the group), or, as others describe the stars as well, at any
    time `between` the first and the last of theirs; in a catalogue it was there always, and these are NaN. `off` is
    by how much the simplest of `alike`, of a camera if there is one, moves q or u of stars (`StarSearch.off`).
    """

    best: PossibleChange
    alike: tuple[PossibleChange, ...]
    time: float = np.nan
    between: tuple[float, float] = (np.nan, np.nan)
    off: float | None = None

    @property
    def rivals(self) -> tuple[PossibleChange, ...]:
        """Descriptions of other cameras or numbers of the optics, each once."""
        return tuple({entry.thing: entry for entry in self.alike if entry.thing != self.best.thing}.values())

    @property
    def camera(self) -> str | None:
        """The camera, if it is one and no other, and not the optics."""
        names = {entry.name for entry in self.alike}
        single = len(names) == len(self.best.members) == 1 and self.best.kind != UNNAMED
        return self.best.name if single else None

    def words(self) -> str:
        """The change in a sentence."""
        if np.isnan(self.time):
            text = f"changed since the calibration, {abs(self.best.sigma):.0f} σ: {in_words(self.best)}"
            if not self.rivals:
                return text
            return (
                f"{text}. These rows cannot distinguish it from {some([in_words(e) for e in self.rivals], 4)}"
            )
        times = (self.time, *self.between)
        date, *ends = (f"MJD {t:.4f}" if t > FIRST_DATE else f"group {t:g}" for t in times)
        when = _COURSES[self.best.history.kind].format(date)
        spread = f"; it began between {ends[0]} and {ends[1]}" if ends[0] != ends[1] else ""
        significance = f"({abs(self.best.sigma):.0f} σ{spread})"
        if not self.rivals:
            return f"{in_words(self.best)} {when} {significance}"
        either = some([in_words(entry) for entry in (self.best, *self.rivals)], 5, " or ")
        return f"{when} {significance}, one of these, which the stars cannot separate: {either}"


@dataclasses.dataclass(frozen=True)
class DisagreeingPlace:
    """A place where stars disagree: centre, size (deg), σ, stars, causes (best first): spots of these `cameras`.

    `off` is by how much the best of them moves q or u of the stars there (`StarSearch.off`).
    """

    x: float
    y: float
    size: float
    sigma: float
    stars: int
    alike: tuple[PossibleChange, ...]
    cameras: tuple[int, ...]
    off: float | None = None

    def profile(self, x: Float[np.ndarray, " r"], y: Float[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
        """g at field positions: 1 in the centre, 0 beyond three sizes."""
        return profile(x, y, (self.x, self.y, self.size))

    def words(self) -> str:
        """The place in a sentence."""
        sizes = (with_error(100 * abs(c.size), 100 * c.error) for c in self.alike)
        words = (f"{c.name} {('brighter', 'fainter')[c.size < 0]}" for c in self.alike)
        details = [f"{word} by {size} %" for word, size in zip(words, sizes, strict=True)]
        return (
            f"{self.stars} stars near X {self.x:+.3f}°, Y {self.y:+.3f}° (within {2 * self.size:.2g}°) disagree with "
            f"the calibration together, {abs(self.sigma):.0f} σ: {some(details, 4, ' or ')} in the centre. Is there "
            "dust, a ghost, a bright neighbour? Their errors were enlarged"
        )

    def document(self) -> dict[str, Any]:
        """The place as plain data."""
        about = {name: getattr(self, name) for name in ("x", "y", "size", "sigma", "stars")}
        pairs = zip(self.cameras, self.alike, strict=True)
        alike = [{"camera": k, "name": c.name, "size": c.size, "error": c.error} for k, c in pairs]
        return about | {"alike": alike}


@dataclasses.dataclass(frozen=True)
class CatalogueCheck:
    """Findings from the stars of a catalogue together.

    `noise` is χ² per degree of freedom behind the changes (1 expected; without outliers) and `noise_p` its chance;
    `rows` the factor by which the common variance of the rows of a star exceeds N_ERR, None where every star has
    one row, and `rows_p` its chance beside `noise`. `tests` are the `asked` questions in their first answer;
    `smallest` is the gain change of the camera seen best that would be found in 99 % of cases (nan: none). `stars` and
    `rows_used` count the sample; `growth` holds the units of X, Y and time; stars of `places` disagree together; `sky`
    is the light of the sky left over (None: its level is not stated), `readings` are other readings of the rows, and
    `own` is what q and u of the stars say of the arms (None: of few stars). `photons` is the stated error of q and u of
    a star by noise alone (median; nan: not known).
    """

    stars: int
    rows_used: int
    asked: int
    noise: float
    noise_p: float
    rows: float | None
    rows_p: float
    tests: tuple[PossibleChange, ...]
    changes: tuple[FoundChange, ...]
    smallest: float
    growth: Growth = IN_UNITS
    places: tuple[DisagreeingPlace, ...] = ()
    sky: LeftOverSky | None = None
    readings: CatalogueReadings | None = None
    own: OwnLightCheck | None = None
    photons: float = np.nan

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
        return ALARM / max(self.asked, 1)

    @property
    def noise_is_off(self) -> bool:
        """True if the counts do not scatter by N_ERR."""
        known = self.noise > residuals.NO_NOISE and self.noise_p < self.alarm
        return known and _matters(self.noise) and not self.rows_agree

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

    @property
    def against(self) -> tuple[Doubt, ...]:
        """A reason for each thing that does not hold, with its remedy; places forbid nothing.

        `Doubt.off` is the shift of q or u by a change (the simplest of those alike), an arm, the sky or a place, median
        of the stars that it acts on; and the scatter that errors lack, √(s − 1) of that of the photons, s χ² per degree
        of freedom. It is not known, and so ranked ahead of all that is, where the counts are not those of the
        instrument.
        """
        if self.readings is not None and self.readings.mended:
            return (Doubt(Quality.CATALOGUE, self.readings.words(), remedy=CORRECT),)
        found: list[tuple[str, str, float | None]] = []
        odd = any(change.best.implausible for change in self.changes) and not self.unbalanced
        if self.own is not None and self.own.found:
            found.append((self.own.words(), DATE_IT, self.own.off))
        elif odd:
            what = "the counts contradict the calibration by more than an instrument changes"
            question = "of this instrument, of all cameras in one unit and aperture, and in their order?"
            found.append((f"{what}: are they {question}", CORRECT, None))
        if not odd:  # what follows from counts that are none of the instrument is no change, and no dust
            plausible = (change for change in self.changes if not change.best.implausible)
            found += [(change.words(), DATE_IT, change.off) for change in plausible]
        if self.sky is not None and self.sky.found:
            found.append((self.sky.words(), "subtract the sky anew", self.sky.off))
        if self.rows_agree:
            assert self.rows is not None
            what = "the rows of a star agree more than independent rows do: together their variance is "
            then = f"Photon errors of stars of several rows were multiplied by {np.sqrt(self.scale[1]):.3g}"
            question = "Are rows there twice, or is their noise correlated?"
            text = f"{what}{self.rows:.3g} times N_ERR. {question} {then}"
            found.append((text, CORRECT, _lacking(self.scale[1], self.photons)))
        if self.noise_is_off:
            found.append((_errors_are_off(self.noise), ERRORS, _lacking(self.noise, self.photons)))
        doubts = [Doubt(Quality.CATALOGUE, text, off=off, remedy=remedy) for text, remedy, off in found]
        for place in () if odd else self.places:
            doubts.append(Doubt(Quality.PLACE, place.words(), blocking=False, off=place.off, remedy=LOOK))
        return tuple(doubts)

    def warnings(self) -> tuple[str, ...]:
        """A sentence for each thing that does not hold."""
        return tuple(doubt.sentence for doubt in self.against)

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


def _errors_are_off(noise: float) -> str:
    """What χ² per degree of freedom says of N_ERR, in a sentence."""
    factor = np.sqrt(noise)
    word = f"{factor:.3g} times too small" if factor > 1 else f"{1 / factor:.3g} times too large"
    instead = "" if factor < _FAR_TOO_SMALL else "the counts contradict the calibration, or "
    text = f"{instead}N_ERR is {word}: χ²/dof of the stars together is {noise:.3g}. Photon errors were"
    return f"{text} multiplied by {factor:.3g}"


def _lacking(scale: float, photons: float) -> float | None:
    """Scatter of q and u that their errors lack where variances are so many times those of the `photons`."""
    return float(np.sqrt(max(scale - 1.0, 0.0))) * photons if np.isfinite(photons) else None


def _matters(noise: float) -> bool:
    """True where χ² per degree of freedom is not what errors that are right to 5 % leave."""
    return not 1.0 / NOISE_MATTERS < noise < NOISE_MATTERS


NOTHING_TO_SPARE = CatalogueCheck(0, 0, 0, 1.0, 1.0, None, 1.0, (), (), np.nan)
"""Of a catalogue in which no row has a camera to spare."""


@dataclasses.dataclass(frozen=True, repr=False)
class Watch(Displayed):
    """The history of a calibration as its stars tell it.

    By exposure group: `time` (MJD, or its number), `stars`, `chi2` per degree of freedom, `gain` of every camera
    (change since the calibration, that camera alone) with `error`, and `smallest`: the step of each camera from that
    group on that would be found in 99 % of cases. `tests` histories were asked; the alarm is at `alarm` standard
    errors. `noise` is χ² per degree of freedom of all stars behind the changes, 1 where it is that of N_ERR; `photons`
    as in `CatalogueCheck`. `remarks` are about rows left out, `odd` about stars that lie off alone; `misread` says of
    catalogues that they are not what they say: what their stars say of the instrument means nothing, and changes are
    not told where any is so. `of_catalogues` is what holds against single ones, by all that `apply` asks, where changes
    in their course do not explain the stars.
    """

    cameras: tuple[str, ...]
    time: Float[np.ndarray, " g"]
    stars: Int[np.ndarray, " g"]
    chi2: Float[np.ndarray, " g"]
    gain: Float[np.ndarray, "g k"]
    error: Float[np.ndarray, "g k"]
    smallest: Float[np.ndarray, "g k"]
    changes: tuple[FoundChange, ...]
    noise: float
    tests: int
    alarm: float
    remarks: tuple[str, ...] = ()
    misread: tuple[str, ...] = ()
    photons: float = np.nan
    of_catalogues: tuple[Doubt, ...] = ()
    odd: tuple[str, ...] = ()

    @property
    def noise_is_off(self) -> bool:
        """True if the counts do not scatter by N_ERR."""
        return _matters(self.noise)

    @property
    def holds(self) -> bool:
        """True if calibration and errors stand."""
        return not (self.changes or self.noise_is_off or self.misread or self.of_catalogues)

    @property
    def doubtful(self) -> bool:
        """True where what the stars show is no plausible change of the instrument, or more than one explains."""
        unlike = any(c.best.implausible or c.best.kind in ("spot", UNNAMED) for c in self.changes)
        return bool(unlike or len(self.changes) > 1 or self.noise >= SCATTERED)

    @property
    def against(self) -> tuple[Doubt, ...]:
        """A reason for each thing that does not hold, ranked as those of a catalogue (`CatalogueCheck.against`)."""
        of_rows = [(text, TIMES) for text in self.remarks] + [(text, ERRORS) for text in self.odd]
        remarks = [Doubt(Quality(0), text, blocking=False, remedy=cure) for text, cure in of_rows]
        if self.misread:
            misread = (Doubt(Quality.CATALOGUE, text, remedy=CORRECT) for text in self.misread)
            return (*misread, *remarks)
        # A single exposure group has no course, and all catalogues are asked for more that may make the scatter.
        changes = () if self.of_catalogues and len(self.time) == 1 else self.changes
        doubts = [
            Doubt(Quality.CATALOGUE, change.words(), off=change.off, remedy=CALIBRATE) for change in changes
        ]
        if self.noise_is_off and not self.of_catalogues:
            off = _lacking(self.noise, self.photons)
            doubts.append(Doubt(Quality.CATALOGUE, _errors_are_off(self.noise), off=off, remedy=ERRORS))
        return (*doubts, *self.of_catalogues, *remarks)

    @property
    def stars_in_words(self) -> str:
        """The smallest change of a camera that would have been seen, and what it does to stars, in words."""
        step = 100.0 * float(np.min(self.smallest))
        seen = f"a step of {two_digits(step)} % in one camera would be seen, q or u off by {two_digits(0.5 * step)} %"
        return f"{seen} (99 %)"

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each thing that does not hold."""
        return tuple(doubt.sentence for doubt in self.against)

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""

        def plain(entry: PossibleChange) -> dict[str, Any]:
            start = float(self.time[entry.history.start])
            return entry._asdict() | {"history": entry.history.kind, "start": start, "sigma": entry.sigma}

        entries = []
        for c in self.changes:
            entries.append({"camera": c.camera, "time": c.time, "between": list(c.between)})
            entries[-1] |= {"best": plain(c.best), "alike": [plain(e) for e in c.alike]}
        of_cameras = {"gain": self.gain, "error": self.error, "smallest_step_seen": self.smallest}
        groups = [
            {"time": float(self.time[g]), "stars": int(self.stars[g]), "chi2_per_dof": float(self.chi2[g])}
            | {key: dict(zip(self.cameras, v[g].tolist(), strict=True)) for key, v in of_cameras.items()}
            for g in range(len(self.time))
        ]
        return {
            "holds": self.holds,
            "changes": entries,
            "smallest_step_seen": float(np.min(self.smallest)),
            "chi2_per_dof": self.noise,
            "misread": list(self.misread),
            "of_catalogues": [doubt.sentence for doubt in self.of_catalogues],
            "tests": self.tests,
            "alarm_sigma": self.alarm,
            "groups": groups,
            "warnings": list(self.warnings),
        }

    def to_table(self) -> Any:
        """A row for each exposure group, as an astropy table."""
        columns = {
            "TIME": (self.time, "", "MJD, or number of the group"),
            "STARS": (self.stars, "", "stars seen in it"),
            "CHI2DOF": (self.chi2, "", "chi squared per degree of freedom of its stars"),
        }
        for k, name in enumerate(self.cameras):
            columns |= {
                f"GAIN_{name}": (self.gain[:, k], "", "change since the calibration, this camera alone"),
                f"ERROR_{name}": (self.error[:, k], "", "its standard error"),
                f"SEEN_{name}": (self.smallest[:, k], "", "smallest step from here on that is found in 99 %"),
            }
        return astropy_table(columns)

    def display(self) -> Display:
        """The verdict, the changes, the smallest step seen, and the groups."""
        rows = []
        for g, time in enumerate(self.time):
            percent = zip(100.0 * self.gain[g], 100.0 * self.error[g], strict=True)
            gains = [f"{with_minus_sign(f'{gain:+.3f}')} ± {error:.3f}" for gain, error in percent]
            when = f"{time:.4f}" if time > FIRST_DATE else f"{time:g}"
            seen = f"{100.0 * self.smallest[g].min():.2g}"
            rows.append((when, f"{self.stars[g]}", f"{self.chi2[g]:.2f}", *gains, seen))
        title = "The calibration is still valid"
        if self.misread or self.of_catalogues or (self.noise >= SCATTERED and not self.changes):
            title = "The stars DO NOT SHOW whether the calibration is still valid"
        elif self.changes:
            title = "The calibration IS NO LONGER VALID"
        smallest = two_digits(100.0 * float(np.min(self.smallest)))
        sensitivity = f"a {smallest} % step in one camera would be detected (99 % probability)"
        facts = (("exposure groups", f"{len(self.time)}"), ("sensitivity", sensitivity))
        when = "MJD" if np.min(self.time) > FIRST_DATE else "group"
        head = (when, ">stars", ">χ²/dof", *(f">{name} %" for name in self.cameras), ">sensitivity %")
        return Display(title, facts, head, tuple(rows), self.warnings)

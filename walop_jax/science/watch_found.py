"""Findings from watching a calibration: histories of cameras and of the optics, night by night (`watch`)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from walop_jax.fit.verdict import Doubt, Quality
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import some, two_digits, with_minus_sign
from walop_jax.science.catalogue_check import NOISE_MATTERS
from walop_jax.science.instrument_changes import UNNAMED, InstrumentChange, PossibleChange
from walop_jax.sky.nights import FIRST_DATE

SCATTERED = 4.0
"""χ² per degree of freedom from which stars in which no change is found do not say that a calibration holds."""
_NOISE = "χ²/dof of the stars is"
CALIBRATE = "take a calibration set and ask it: walop-jax check RUN NEW.fits"
ERRORS = "correct N_ERR, or leave out stars that are blended, variable or saturated"
TIMES = "give MJD in every row"
_COURSES = {
    "step": "from {} on",
    "drift": "at the end, drifting since {}",
    "once": "in the exposures of {} only",
}


@dataclasses.dataclass(frozen=True)
class WatchedChange(InstrumentChange):
    """A change and when it began (MJD, or the number of the group).

    That is at `time`, or, as others describe the stars as well, at any `between` the first and the last of theirs.
    """

    time: float = np.nan
    between: tuple[float, float] = (np.nan, np.nan)

    @property
    def camera(self) -> str | None:
        """The camera, if it is one and no other, and not the optics."""
        names = {entry.name for entry in self.alike}
        single = len(names) == len(self.best.members) == 1 and self.best.kind != UNNAMED
        return self.best.name if single else None

    def words(self) -> str:
        """The change in a sentence."""
        times = (self.time, *self.between)
        date, *ends = (f"MJD {t:.4f}" if t > FIRST_DATE else f"group {t:g}" for t in times)
        when = _COURSES[self.best.history.kind].format(date)
        spread = f"; it began between {ends[0]} and {ends[1]}" if ends[0] != ends[1] else ""
        significance = f"({abs(self.best.sigma):.0f} σ{spread})"
        if not self.rivals:
            return f"{self.best.words()} {when} {significance}"
        either = some([entry.words() for entry in (self.best, *self.rivals)], 5, " or ")
        return f"{when} {significance}, one of these, which the stars cannot separate: {either}"

    @property
    def off(self) -> float | None:
        """By how much q or u of stars are wrong (a fraction), about; None where it is not one camera.

        q = (N₀ − N₁)/(N₀ + N₁) of an arm, one camera of which is brighter by β, is wrong by (1 − q²) β/2.
        """
        best = self.best
        return 0.5 * abs(best.size) if len(best.members) == 1 and best.kind != UNNAMED else None


@dataclasses.dataclass(frozen=True, repr=False)
class Watch(Displayed):
    """The history of a calibration as its stars tell it.

    By exposure group: `time` (MJD, or its number), `stars`, `chi2` per degree of freedom, `gain` of every camera
    (change since the calibration, that camera alone) with `error`, and `smallest`: the step of each camera from that
    group on that would be found in 99 % of cases. `tests` histories were asked; the alarm is at `alarm` standard
    errors. `remarks` are about rows that were left out.
    """

    cameras: tuple[str, ...]
    time: Float[np.ndarray, " g"]
    stars: Int[np.ndarray, " g"]
    chi2: Float[np.ndarray, " g"]
    gain: Float[np.ndarray, "g k"]
    error: Float[np.ndarray, "g k"]
    smallest: Float[np.ndarray, "g k"]
    changes: tuple[WatchedChange, ...]
    noise: float
    tests: int
    alarm: float
    remarks: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """True if the calibration still holds: nothing has changed, and scatter is not beyond twice N_ERR."""
        return bool(not self.changes and self.noise < SCATTERED)

    @property
    def against(self) -> tuple[Doubt, ...]:
        """The reasons against using the calibration on, each with its effect on stars and its remedy."""
        doubts = [
            Doubt(Quality.CATALOGUE, change.words(), off=change.off, remedy=CALIBRATE)
            for change in self.changes
        ]
        noise = [text for text in self.warnings if text.startswith(_NOISE)]
        unclear = not self.holds and not self.changes
        told = [Doubt(Quality.CATALOGUE, text, blocking=unclear, remedy=ERRORS) for text in noise]
        remarks = [Doubt(Quality(0), text, blocking=False, remedy=TIMES) for text in self.remarks]
        return (*doubts, *told, *remarks)

    @property
    def stars_in_words(self) -> str:
        """The smallest change of a camera that would have been seen, and what it does to stars, in words."""
        step = 100.0 * float(np.min(self.smallest))
        seen = f"a step of {two_digits(step)} % in one camera would be seen, q or u off by {two_digits(0.5 * step)} %"
        return f"{seen} (99 %)"

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for every change, and one if the counts do not scatter by N_ERR."""
        texts = (*(change.words() for change in self.changes), *self.remarks)
        if 1.0 / NOISE_MATTERS < self.noise < NOISE_MATTERS:
            return texts
        factor = np.sqrt(self.noise)
        return (*texts, f"{_NOISE} {self.noise:.3g}: N_ERR was multiplied by {factor:.3g}")

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
        if not self.holds:
            unclear = "The stars DO NOT SHOW whether the calibration is still valid"
            title = "The calibration IS NO LONGER VALID" if self.changes else unclear
        smallest = two_digits(100.0 * float(np.min(self.smallest)))
        sensitivity = f"a {smallest} % step in one camera would be detected (99 % probability)"
        facts = (("exposure groups", f"{len(self.time)}"), ("sensitivity", sensitivity))
        when = "MJD" if np.min(self.time) > FIRST_DATE else "group"
        head = (when, ">stars", ">χ²/dof", *(f">{name} %" for name in self.cameras), ">sensitivity %")
        return Display(title, facts, head, tuple(rows), self.warnings)

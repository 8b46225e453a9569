"""Findings from watching a calibration: histories of cameras and of the optics, night by night (`watch`)."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import some, two_digits, with_minus_sign
from walop_jax.science.catalogue_check import NOISE_MATTERS, ChangeQuestion

SCATTERED = 4.0
"""χ² per degree of freedom from which stars in which no change is found do not say that a calibration holds."""
_DATE = 1e3  # times above are dates, not numbers of groups


class History(NamedTuple):
    """Course of a change: `kind` is step, drift or once; `start` the group it began in."""

    kind: str
    start: int

    def over(self, time: Float[np.ndarray, " g"]) -> Float[np.ndarray, " g"]:
        """Its size in every group, 1 at most."""
        number = np.arange(len(time))
        if self.kind == "once":
            return (number == self.start).astype(float)
        if self.kind == "step":
            return (number >= self.start).astype(float)
        return np.clip((time - time[self.start]) / max(time[-1] - time[self.start], 1e-300), 0.0, 1.0)


UNNAMED = "unnamed"
"""Kind and name of a change that nothing in its range describes."""


class Suspect(NamedTuple):
    """Possible change: of cameras or a number of the optics, by how much, and its significance.

    `kind` is gain (a camera), arm (its cameras together, NAME+NAME), gradient or spot (of a camera or an arm), optics,
    or `UNNAMED`. `place` is the direction of a gradient (deg, from X towards Y), whose size is that at the edge of the
    field, or centre and radius (deg) and the sharpness of the edge (`watch_spots`) of a spot, whose size is that at
    its centre.
    """

    name: str
    camera: bool
    history: History
    size: float
    error: float
    unit: str
    kind: str = "gain"
    place: tuple[float, ...] = ()

    @property
    def members(self) -> tuple[str, ...]:
        """The cameras that it is of."""
        return tuple(self.name.split("+")) if self.camera else ()

    @property
    def of_gain(self) -> bool:
        """True if cameras have changed as a whole."""
        return self.kind in ("gain", "arm")

    @property
    def thing(self) -> tuple[str, str, History]:
        """Kind and name of the change, and its course in time."""
        return self.kind, self.name, self.history

    @property
    def sigma(self) -> float:
        """Size in standard errors."""
        return self.size / self.error


@dataclasses.dataclass(frozen=True)
class WatchedChange:
    """A change: the best description, those that describe the stars as well, and when (MJD, or the group's number).

    It began at `time`, or, as others describe the stars as well, at any `between` the first and the last of theirs.
    """

    best: Suspect
    alike: tuple[Suspect, ...]
    time: float
    between: tuple[float, float]

    @property
    def camera(self) -> str | None:
        """The camera, if it is one and no other, and not the optics."""
        names = {entry.name for entry in self.alike}
        single = len(names) == len(self.best.members) == 1 and self.best.kind != UNNAMED
        return self.best.name if single else None

    def words(self) -> str:
        """The change in a sentence."""
        date, *ends = (
            f"MJD {time:.4f}" if time > _DATE else f"group {time:g}" for time in (self.time, *self.between)
        )
        how = {
            "step": "from {} on",
            "drift": "at the end, drifting since {}",
            "once": "in the exposures of {} only",
        }
        when = how[self.best.history.kind].format(date)
        spread = f"; it began between {ends[0]} and {ends[1]}" if ends[0] != ends[1] else ""
        significance = f"({abs(self.best.sigma):.0f} σ{spread})"
        rivals = {e.thing[:2]: e for e in self.alike if e.thing[:2] != self.best.thing[:2]}
        if not rivals:
            return f"{_words(self.best)} {when} {significance}"
        listed = some([_words(entry) for entry in (self.best, *rivals.values())], 5, " or ")
        return f"{when} {significance}, one of these, which the stars cannot tell apart: {listed}"


def _words(entry: Suspect) -> str:
    if entry.kind == UNNAMED:
        return "a change that no camera, arm or place of the field makes, nor a number of the optics within its range"
    size, error, where = entry.size, entry.error, ""
    if entry.kind == "gradient":
        where = f" at the edge of the field {round(entry.place[0]) % 360}° from X towards Y"
    elif entry.kind == "spot":
        x, y, radius = (with_minus_sign(f"{value:.3f}") for value in entry.place[:3])
        where = f" in a spot at X = {x}°, Y = {y}°, within {radius}°"
    kind, camera = ("gain", 0) if entry.camera else ("optics", -1)
    name = " and ".join(entry.members) or entry.name
    return ChangeQuestion(kind, name, entry.unit, camera).words(size, error) + where


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
    def warnings(self) -> tuple[str, ...]:
        """A sentence for every change, and one if N_ERR is not what the counts scatter by."""
        texts = (*(change.words() for change in self.changes), *self.remarks)
        if 1.0 / NOISE_MATTERS < self.noise < NOISE_MATTERS:
            return texts
        return (
            *texts,
            f"χ²/dof of the stars is {self.noise:.3g}: N_ERR was multiplied by {np.sqrt(self.noise):.3g}",
        )

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""

        def plain(entry: Suspect) -> dict[str, Any]:
            start = float(self.time[entry.history.start])
            return entry._asdict() | {"history": entry.history.kind, "start": start, "sigma": entry.sigma}

        entries = [
            {
                "camera": c.camera,
                "time": c.time,
                "between": list(c.between),
                "best": plain(c.best),
                "alike": [plain(e) for e in c.alike],
            }
            for c in self.changes
        ]
        groups = [
            {
                "time": float(self.time[g]),
                "stars": int(self.stars[g]),
                "chi2_per_dof": float(self.chi2[g]),
                "gain": dict(zip(self.cameras, self.gain[g].tolist(), strict=True)),
                "error": dict(zip(self.cameras, self.error[g].tolist(), strict=True)),
                "smallest_step_seen": dict(zip(self.cameras, self.smallest[g].tolist(), strict=True)),
            }
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
        """The verdict, what has changed, what would have been seen, and the groups."""
        percent = 100.0
        rows = tuple(
            (
                f"{self.time[g]:.4f}" if self.time[g] > _DATE else f"{self.time[g]:g}",
                f"{self.stars[g]}",
                f"{self.chi2[g]:.2f}",
                *(
                    with_minus_sign(f"{percent * self.gain[g, k]:+.3f}")
                    + f" ± {percent * self.error[g, k]:.3f}"
                    for k in range(len(self.cameras))
                ),
                f"{percent * self.smallest[g].min():.2g}",
            )
            for g in range(len(self.time))
        )
        smallest = two_digits(percent * float(np.min(self.smallest)))
        return Display(
            title="The calibration is still valid"
            if self.holds
            else "The calibration IS NO LONGER VALID"
            if self.changes
            else "The stars DO NOT SHOW whether the calibration is still valid",
            facts=(
                ("exposure groups", f"{len(self.time)}"),
                ("sensitivity", f"a {smallest} % step in one camera would be detected (99 % probability)"),
            ),
            head=("time", ">stars", ">χ²/dof", *(f">{name} %" for name in self.cameras), ">seen %"),
            rows=rows,
            notes=self.warnings,
        )

"""Factors with which a description may grow: those that the exposures of a set can tell apart."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.records import Exposures
from walop_jax.model.planning import hours_of
from walop_jax.sky.nights import first_of_nights

FEWEST_POINTS = 9  # in which a pattern over the field is looked for, or what refers to their median
STEPS, FEW = 16, 18  # times of a step that are looked at first; times of which all spells are
AFTER = 0.5  # hours behind the last exposure that a step ends
NEARLY_TIME = 0.999  # correlation of the order of exposures with time


def starts_of_steps(exposures: Exposures) -> Float[np.ndarray, " s"]:
    """Hours at which something may have changed: midway between exposures."""
    hours = np.unique(hours_of(exposures))
    return (hours[1:] + hours[:-1]) / 2.0


def evenly(times: Float[np.ndarray, " s"]) -> Float[np.ndarray, " t"]:
    """`STEPS` or fewer of them that part the others evenly; `retimed` has those between."""
    at = np.unique(((np.arange(STEPS) + 0.5) / STEPS * len(times)).astype(int))
    return times[at[: len(times)]]


def between(start: float, stop: float) -> str:
    """The factor that is 1 from one time to another (hours; to 0.4 s)."""
    return f"hours {round(float(start), 4)} to {round(float(stop), 4)}"


def end_of(exposures: Exposures) -> float:
    """Hours at which a step ends: `AFTER` the last exposure."""
    return float(hours_of(exposures).max()) + AFTER


@dataclasses.dataclass(frozen=True)
class Asked:
    """Factors that the exposures can tell apart."""

    exposures: Exposures
    over_field: bool
    colours: bool
    hours: bool
    kelvin: bool

    @classmethod
    def of(cls, exposures: Exposures, points: int) -> Asked:
        """Look for several filters, times and temperatures, and points enough for a pattern."""

        def varies(values: np.ndarray) -> bool:
            return bool(
                np.isfinite(values).all() and np.ptp(values) > 1e-9 * max(1.0, float(np.abs(values).max()))
            )

        return cls(
            exposures,
            points >= FEWEST_POINTS,
            len(np.unique(exposures.filter)) > 1,
            varies(exposures.mjd),
            varies(exposures.temp),
        )

    def harmonics(self, prefix: str, orders: Sequence[int]) -> Iterator[tuple[str, str]]:
        """Cosine and sine of the harmonics that the angles of a moving element can show."""
        position = self.exposures.position(prefix)
        angles = np.unique(np.round(np.mod(position.angle[position.inside], 360.0), 3))
        for order in orders:
            if len(angles) >= 2 * order + 1:
                yield f"cos {order} {prefix}", f"sin {order} {prefix}"

    def hour_angle(self) -> Iterator[str]:
        """The hour angle, where it is not the time."""
        angle, time = self.exposures.ha, self.exposures.mjd
        left = angle - angle.mean()
        if self.hours:
            time = time - time.mean()
            left = left - time * (time @ left) / (time @ time)
        if np.isfinite(angle).all() and np.ptp(left) > 1e-3 * np.ptp(angle):
            yield "hour angle"

    def single(self) -> Iterator[str]:
        """Exposure time, and the order of the exposures where that is not the time."""
        seconds = self.exposures.exptime
        if np.isfinite(seconds).all() and seconds.min() > 0 and np.ptp(seconds) > 1e-3 * seconds.max():
            yield "per EXPTIME"
        hours, order = hours_of(self.exposures), np.arange(len(self.exposures), dtype=float)
        if self.hours and len(order) > 2 and abs(np.corrcoef(hours, order)[0, 1]) < NEARLY_TIME:
            yield "order"

    def sides(self, prefix: str) -> Iterator[str]:
        """The side from which a moving element came, where it came from both."""
        angle, inside = (getattr(self.exposures.position(prefix), name) for name in ("angle", "inside"))
        turned = np.sin(np.deg2rad(np.diff(angle[inside])))
        if self.hours and min(np.sum(turned > 1e-9), np.sum(turned < -1e-9)) > 1:
            yield f"side {prefix}"

    def slow(self) -> Iterator[str]:
        """Time and temperature."""
        if self.hours:
            yield "hours"
        if self.kelvin:
            yield "kelvin"

    def moments(self, inside: Bool[np.ndarray, " e"] | None) -> Float[np.ndarray, " s"]:
        """Times at which something may have changed, of an element that it may have while it was `inside` the beam."""
        if not self.hours:
            return np.zeros(0)
        starts, hours = starts_of_steps(self.exposures), np.unique(hours_of(self.exposures)[inside])
        return starts[np.unique(np.searchsorted(starts, hours[1:]) - 1)]  # ahead of each but the first

    def steps(self, inside: Bool[np.ndarray, " e"] | None = None) -> Iterator[str]:
        """From a time until the end; not so near to an end that all but one or two exposures are alike."""
        yield from (between(time, end_of(self.exposures)) for time in evenly(self.moments(inside)[1:-1]))

    def spells(self, inside: Bool[np.ndarray, " e"]) -> Iterator[str]:
        """From a time until another: all of them, or of many exposures an eighth, a quarter or half of them."""
        times = self.moments(inside)
        some, lengths = evenly(times), (STEPS // 8, STEPS // 4, STEPS // 2)
        each = itertools.chain(*(zip(some, some[length:], strict=False) for length in lengths))
        yield from (between(*s) for s in (itertools.combinations(times, 2) if len(times) <= FEW else each))

    def kinds(self) -> Iterator[str]:
        """Kinds of exposures, but the most frequent."""
        names, counts = np.unique(self.exposures.kind, return_counts=True)
        yield from (f"kind {name}" for name in names[np.argsort(-counts, kind="stable")][1:])

    def nights(self) -> Iterator[str]:
        """Every night, where there are several."""
        if not self.hours:
            return
        hours = np.sort(hours_of(self.exposures))
        first = first_of_nights(hours / 24.0)
        if len(first) < 2:
            return
        for start, stop in itertools.pairwise([*first, len(hours)]):
            yield f"hours {max(hours[start] - 0.5, 0.0):.2f} to {hours[stop - 1] + 0.5:.2f}"

"""Dependences of descriptions that the exposures of a set can distinguish."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.records import Exposures
from walop_jax.diagnosis import thresholds
from walop_jax.likelihood import limits
from walop_jax.model.planning import hours_of
from walop_jax.sky.nights import first_of_nights

FEWEST_POINTS = 9  # in which a pattern over the field is looked for, or what refers to their median
STEPS, FEW = 16, 18  # times of a step in the first search; most times for which all spells are tried
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


PATTERNS: Mapping[str, tuple[str, ...]] = {
    "even": ("",),
    "tilt": ("x", "y"),
    "r2": ("r2",),
    "astigmatic": ("x2-y2", "xy"),
    "focus": ("", "r2"),
    "smooth": ("", "x", "y", "r2"),
    "rings": tuple(f"ring {degree}" for degree in thresholds.RINGS),
}
"""Patterns over the field (`Combinations.over`): factors that have an amplitude each."""


@dataclasses.dataclass(frozen=True)
class Dependences:
    """Factors that exposures can tell apart: groups by form (`Combinations.along`), each factor with an amplitude.

    `over_field` is True with enough points for a pattern; factors may depend on the angles of the elements
    `prefixes`, and are limited to the exposures `inside`.
    """

    exposures: Exposures
    over_field: bool
    prefixes: tuple[str, ...]
    inside: Bool[np.ndarray, " e"]

    def of(self, form: str) -> Iterator[tuple[str, ...]]:
        """The groups of one form."""
        name, _, limit = form.partition(" to ")
        if name not in _SHOWS:
            yield from getattr(self, f"_{name}")(*map(int, limit.split()))
        elif _SHOWS[name](self):
            yield (name.removeprefix("steady"),)

    def _harmonics(self, most: int) -> Iterator[tuple[str, ...]]:
        """Cosine and sine of the harmonics that the angles of a moving element can show."""
        for prefix in self.prefixes:
            position = self.exposures.position(prefix)
            angles = np.unique(np.round(np.mod(position.angle[position.inside], 360.0), 3))
            for order in range(1, most + 1):
                if len(angles) >= 2 * order + 1:
                    yield f"cos {order} {prefix}", f"sin {order} {prefix}"

    def _shows_hour_angle(self) -> bool:
        """True where the hour angle is not degenerate with time."""
        angle, time = self.exposures.ha, self.exposures.mjd
        remainder = angle - angle.mean()
        if varies(time):
            time = time - time.mean()
            remainder = remainder - time * (time @ remainder) / (time @ time)
        return bool(np.isfinite(angle).all() and np.ptp(remainder) > 1e-3 * np.ptp(angle))

    def _shows_exptime(self) -> bool:
        seconds = self.exposures.exptime
        return bool(
            np.isfinite(seconds).all() and seconds.min() > 0 and np.ptp(seconds) > 1e-3 * seconds.max()
        )

    def _shows_order(self) -> bool:
        """True where the order of the exposures is not degenerate with time."""
        hours, order = hours_of(self.exposures), np.arange(len(self.exposures), dtype=float)
        timed = varies(self.exposures.mjd) and len(order) > 2
        return bool(timed and abs(np.corrcoef(hours, order)[0, 1]) < NEARLY_TIME)

    def _side(self) -> Iterator[tuple[str, ...]]:
        """The side from which a moving element came, where it came from both."""
        for prefix in self.prefixes:
            angle, inside = (getattr(self.exposures.position(prefix), name) for name in ("angle", "inside"))
            turned = np.sin(np.deg2rad(np.diff(angle[inside])))
            if varies(self.exposures.mjd) and min(np.sum(turned > 1e-9), np.sum(turned < -1e-9)) > 1:
                yield (f"side {prefix}",)

    def _moments(self) -> Float[np.ndarray, " s"]:
        """Times at which something may have changed, of an element that it may have while it was inside the beam."""
        if not varies(self.exposures.mjd):
            return np.zeros(0)
        starts, hours = starts_of_steps(self.exposures), np.unique(hours_of(self.exposures)[self.inside])
        return starts[np.unique(np.searchsorted(starts, hours[1:]) - 1)]  # ahead of each but the first

    def _step(self) -> Iterator[tuple[str, ...]]:
        """From a time until the end; not so near to an end that all but one or two exposures are alike."""
        for time in evenly(self._moments()[1:-1]):
            yield (between(time, end_of(self.exposures)),)

    def _spell(self) -> Iterator[tuple[str, ...]]:
        """From a time until another: all of them, or of many exposures an eighth, a quarter or half of them."""
        times = self._moments()
        starts, lengths = evenly(times), (STEPS // 8, STEPS // 4, STEPS // 2)
        spells = itertools.chain(*(zip(starts, starts[length:], strict=False) for length in lengths))
        for spell in itertools.combinations(times, 2) if len(times) <= FEW else spells:
            yield (between(*spell),)

    def _night(self) -> Iterator[tuple[str, ...]]:
        """Every night, where there are several."""
        for start, stop in self._nights():
            yield (f"hours {max(start - 0.5, 0.0):.2f} to {stop + 0.5:.2f}",)

    def _nights(self) -> list[tuple[float, float]]:
        """Hours of the first and the last exposure of every night; empty unless there are several."""
        if not varies(self.exposures.mjd):
            return []
        hours = np.sort(hours_of(self.exposures))
        first = first_of_nights(hours / 24.0)
        nights = itertools.pairwise([*first, len(hours)]) if len(first) > 1 else ()
        return [(hours[start], hours[stop - 1]) for start, stop in nights]

    def _kind(self) -> Iterator[tuple[str, ...]]:
        """Kinds of exposures, but the most frequent."""
        names, counts = np.unique(self.exposures.kind[self.inside], return_counts=True)
        yield from ((f"kind {name}",) for name in names[np.argsort(-counts, kind="stable")][1:])

    def _exposure(self) -> Iterator[tuple[str, ...]]:
        """Every single exposure, where there are enough field points."""
        if self.over_field and len(self.exposures) <= limits.FREE_EXPOSURES:
            yield from ((f"exposure {number}",) for number in np.flatnonzero(self.inside))

    def _patch(self) -> Iterator[tuple[str, ...]]:
        """Every patch of the Moon sky, which is an exposure, and all of them."""
        patches = [f"exposure {number}" for number in np.flatnonzero(self.exposures.direct("moon"))]
        if 0 < len(patches) <= limits.FREE_EXPOSURES:
            yield from zip(patches)
            if len(patches) > 1:
                yield tuple(patches)


_SHOWS: Mapping[str, Callable[[Dependences], bool]] = {
    "steady": lambda of: True,
    "colour": lambda of: len(np.unique(of.exposures.filter)) > 1,
    "hours": lambda of: varies(of.exposures.mjd),
    "kelvin": lambda of: varies(of.exposures.temp),
    "counts": lambda of: True,
    "hour angle": Dependences._shows_hour_angle,
    "per EXPTIME": Dependences._shows_exptime,
    "order": Dependences._shows_order,
    "night hours": lambda of: bool(of._nights()),
}
"""Forms of a single factor of that name, and whether exposures show it."""


def varies(values: np.ndarray) -> bool:
    """True if all numbers are known and not the same."""
    return bool(np.isfinite(values).all() and np.ptp(values) > 1e-9 * max(1.0, float(np.abs(values).max())))

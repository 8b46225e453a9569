"""Changes of an instrument since it was calibrated, as its stars show them: of cameras or optics, and since when.

A check of one catalogue (`catalogue_check`) and the watch of many nights (`watch`) describe changes by these records,
and raise their alarms by these numbers. Changes within Δχ² < `RIVAL` of the best describe the stars as well as it: they
are given together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.io.text import some, with_error, with_minus_sign

ALARM = 1e-4  # probability that noise raises any alarm in a catalogue, or in all that are watched together
RIVAL = 11.0
LARGEST = 0.1  # relative change of a camera beyond which the counts are not those of the instrument
FARTHEST = 10.0
"""Widths of its prior by which a number of the optics may change: no optics moves farther, nor do first-order columns
describe it there."""
MOST_LIKELY = 2.33  # standard deviations above the alarm from which 99 % are detected (one-sided)
REACH = 3.0  # sizes from the centre of a spot beyond which nothing is left of it
Place = tuple[float, ...]  # centre (X, Y) and size of a spot, in degrees, and the sharpness of its edge
UNNAMED = "unnamed"  # kind and name of a change that nothing in its range describes
_UNEXPLAINED = "a change that no camera, arm or place of the field makes"
_ONE_CATALOGUE = {
    "x": " at the edge of the field along +X",
    "y": " at the edge of the field along +Y",
    "time": " at the end of the catalogue than in its middle",
    "flux": " for every 10⁶ electrons",
}


def threshold(chance: float) -> float:
    """Standard deviations that a normal number exceeds, to either side, with this probability."""
    return float(-special.ndtri(0.5 * chance))


def chance_of(sigma: float) -> float:
    """Probability that a normal number is as far from 0, to either side."""
    return float(2.0 * special.ndtr(-abs(sigma)))


def profile(x: Float[np.ndarray, " r"], y: Float[np.ndarray, " r"], place: Place) -> Float[np.ndarray, " r"]:
    """A spot at positions (deg): exp(−(d/s)ᵐ/2), 0 beyond `REACH` sizes s; m = 2 where a place does not say."""
    far = ((x - place[0]) ** 2 + (y - place[1]) ** 2) / place[2] ** 2
    power = 0.5 * place[3] if len(place) > 3 else 1.0
    return np.where(far < REACH**2, np.exp(-0.5 * np.minimum(far, REACH**2) ** power), 0.0)


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


ALL_ALONG = History("step", 0)


class PossibleChange(NamedTuple):
    """A possible change: of cameras or of a number of the optics, by how much, and since when.

    `kind` is gain (a camera), arm (its cameras together, NAME+NAME), gradient or spot (of a camera or an arm), optics,
    or `UNNAMED`; within one catalogue also x, y, time, flux and light of a camera. `place` is the direction of a
    gradient (deg, from X towards Y), whose size is that at the edge of the field, or centre, size (deg) and sharpness
    of a spot (`profile`), whose size is that at its centre. No number of the optics changes by more than `widest`.
    """

    name: str
    camera: bool
    history: History = ALL_ALONG
    size: float = 0.0
    error: float = np.inf
    unit: str = ""
    kind: str = "gain"
    place: tuple[float, ...] = ()
    widest: float = np.inf

    @property
    def members(self) -> tuple[str, ...]:
        """The cameras that it is of."""
        return tuple(self.name.split("+")) if self.camera else ()

    @property
    def thing(self) -> tuple[str, str]:
        """Kind and name of the change, whatever its course in time."""
        return self.kind, self.name

    @property
    def sigma(self) -> float:
        """Size in standard errors."""
        return self.size / self.error

    @property
    def implausible(self) -> bool:
        """True for a change by more than cameras, or numbers of the optics, change."""
        relative = self.camera and self.kind in ("gain", "arm", "gradient", "x", "y", "time")
        return abs(self.size) > (LARGEST if relative else self.widest)

    def words(self) -> str:
        """The change and its size in words."""
        if self.kind == UNNAMED:
            return f"{_UNEXPLAINED}, nor a number of the optics within its range"
        lower, name = self.size < 0, " and ".join(self.members) or self.name
        if not self.camera:
            size = with_error(abs(self.size), self.error)
            return f"{name} {('larger', 'smaller')[lower]} by {size} {self.unit}".rstrip()
        if self.kind == "light":
            size = with_error(abs(self.size), self.error)
            return f"{size} electrons too {('many', 'few')[lower]} in every row of {name}"
        where = _ONE_CATALOGUE.get(self.kind, "")
        if self.kind == "gradient":
            where = f" at the edge of the field {round(self.place[0]) % 360}° from X towards Y"
        elif self.kind == "spot":
            x, y = (with_minus_sign(f"{value:.3f}") for value in self.place[:2])
            where = f" in a spot at X = {x}°, Y = {y}°, within {2 * self.place[2]:.2g}°"
        size = with_error(100 * abs(self.size), 100 * self.error)
        return f"{name} {('brighter', 'fainter')[lower]} by {size} %{where}"


def rivals_of(best: PossibleChange, others: Iterable[PossibleChange]) -> list[PossibleChange]:
    """Changes that describe the stars as well as the best, it included."""
    return [entry for entry in others if entry.sigma**2 > best.sigma**2 - RIVAL]


@dataclasses.dataclass(frozen=True)
class InstrumentChange:
    """A change since the calibration: the simplest description, and all that describe the stars alike (it included)."""

    best: PossibleChange
    alike: tuple[PossibleChange, ...]

    @property
    def rivals(self) -> tuple[PossibleChange, ...]:
        """Descriptions of other cameras or numbers of the optics, each once."""
        return tuple({entry.thing: entry for entry in self.alike if entry.thing != self.best.thing}.values())

    def words(self) -> str:
        """The change in a sentence."""
        text = f"changed since the calibration, {abs(self.best.sigma):.0f} σ: {self.best.words()}"
        if not self.rivals:
            return text
        return f"{text}. These rows cannot distinguish it from {some([entry.words() for entry in self.rivals], 4)}"

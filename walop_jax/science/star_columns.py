"""What may have changed in an instrument since its calibration, as its stars show it: columns times histories.

A column is what a change of unit size adds to the counts c of a camera,

    gain c    x, y  c X/e, c Y/e    time  c t    flux  c · c/10⁶    light 1    spot  c g    optics  ∂c/∂p

e the edge of the field, t from −1 to 1 over a catalogue, g the profile of a spot, p a number of the optics or of the
pointing; a history says when: always, from one exposure group on (step), growing from there (drift), once. An arm is
the sum over its cameras, since what lies ahead of an analyser dims both of its beams; the sum over all cameras is flux.
A gradient has two columns, and any direction φ in the field:

    c' = cos φ · x c + sin φ · y c

φ is that in which z² is largest, which is then χ² of two numbers; it counts as `DIRECTIONS` questions.

A catalogue is asked for all columns that were there always (`star_search`), a survey for those of cameras, arms, spots
and optics in every history (`star_history`). Both describe what they find by `PossibleChange`, and raise their alarms
by these numbers: changes within Δχ² < `RIVAL` of the best describe the stars as well as it, and are given together.
Columns are of first order: a relative change β of a camera makes them wrong by β of themselves, and χ² by 2β at most,
which counts as well from `BENT` on.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.science.star_residuals import StarResiduals

ALARM = 1e-4  # probability that noise raises any alarm in a catalogue, or in all that are watched together
RIVAL = 11.0
BENT = 0.03  # relative change of a camera from which its second order may decide between rivals
LARGEST = 0.1  # relative change of a camera beyond which the counts are not those of the instrument
FARTHEST = 10.0
"""Widths of its prior by which a number of the optics may change: no optics moves farther, nor do first-order columns
describe it there."""
MOST_LIKELY = 2.33  # standard deviations above the alarm from which 99 % are detected (one-sided)
REACH = 3.0  # sizes from the centre of a spot beyond which nothing is left of it
DIRECTIONS = 8
"""u √(π/2), by which χ² of two exceeds u² more often than one number does, at the highest alarm, u = 6.4."""
UNNAMED = "unnamed"  # kind and name of a change that nothing in its range describes
RELATIVE = ("gain", "arm", "gradient", "spot", "x", "y", "time")
"""Kinds of changes whose size is a share of the counts."""
OF_CATALOGUES = ("gain", "x", "y", "time", "flux", "light")
OF_SURVEYS = ("gain", "x", "y")
"""Columns of each camera, in their order."""
_UNITS = {"flux": "per 1e6 electron", "light": "electron"}
_REFERENCE = 1e6  # electron

SpotPlace = tuple[float, ...]  # centre (X, Y) and size of a spot, in degrees, and the sharpness of its edge
RowValues = Float[np.ndarray, " r"]  # a number for each row
WeightedColumns = dict[int, float]  # weights of columns by their numbers


def threshold(chance: float) -> float:
    """Standard deviations that a normal number exceeds, to either side, with this probability."""
    return float(-special.ndtri(0.5 * chance))


def chance_of(sigma: float) -> float:
    """Probability that a normal number is as far from 0, to either side."""
    return float(2.0 * special.ndtr(-abs(sigma)))


def profile(x: RowValues, y: RowValues, place: SpotPlace) -> RowValues:
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


ALWAYS = History("step", 0)


class PossibleChange(NamedTuple):
    """A possible change: of cameras or of a number of the optics, by how much, and since when.

    `kind` is a column of a camera (gain, x, y, time, flux, light), arm (its cameras together, NAME+NAME), gradient or
    spot (of a camera or an arm), optics, or `UNNAMED`. `place` is the direction of a gradient (deg, from X towards Y),
    whose size is that at the edge of the field, or centre, size (deg) and sharpness of a spot (`profile`), whose size
    is that at its centre. No number of the optics changes by more than `widest`.
    """

    name: str
    camera: bool
    history: History = ALWAYS
    size: float = 0.0
    error: float = np.inf
    unit: str = ""
    kind: str = "gain"
    place: SpotPlace = ()
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
    def relative(self) -> float:
        """Its size as a share of the counts; 0 where it is none."""
        return abs(self.size) if self.camera and self.kind in RELATIVE else 0.0

    @property
    def possible(self) -> bool:
        """True unless a number of the optics, or the depth of a spot, would be larger than it can be."""
        return abs(self.size) <= (1.0 if self.kind == "spot" else self.widest)

    @property
    def implausible(self) -> bool:
        """True for a change by more than cameras, or numbers of the optics, change."""
        if self.camera:
            return self.kind != "spot" and self.relative > LARGEST
        return abs(self.size) > self.widest


def rivals_of(best: PossibleChange, others: Iterable[PossibleChange]) -> list[PossibleChange]:
    """Changes that describe the stars as well as the best, it included."""
    second = 2.0 * min(best.relative, 0.5) if best.relative > BENT else 0.0
    least = best.sigma**2 * (1.0 - second) - RIVAL
    return [entry for entry in others if entry.sigma**2 > least]


class Growth(NamedTuple):
    """Units in which changes of a camera grow: `edge` of the field (deg), middle and half of the time covered (d)."""

    edge: float = 1.0
    middle: float = 0.0
    half: float = 0.0

    @classmethod
    def of(cls, stars: StarResiduals) -> Growth:
        """That of some stars."""
        growth = cls(max(float(np.abs(np.concatenate([stars.x, stars.y])).max()), 1e-9))
        times = stars.time[np.isfinite(stars.time)]
        if not times.size or np.ptp(times) == 0:
            return growth
        return growth._replace(middle=0.5 * float(times.min() + times.max()), half=0.5 * float(np.ptp(times)))

    def electrons(
        self, change: PossibleChange, x: RowValues, y: RowValues, time: RowValues, counts: RowValues
    ) -> RowValues:
        """Electrons that a change of unit size adds to `counts` of a camera of its own."""
        if change.kind == "light":
            return np.ones_like(counts)
        if change.kind == "flux":
            return counts**2 / _REFERENCE
        if change.kind == "spot":
            return counts * profile(x, y, change.place)
        if change.kind == "gradient":
            angle = np.deg2rad(change.place[0])
            return counts * (np.cos(angle) * x + np.sin(angle) * y) / self.edge
        since = np.nan_to_num(time - self.middle) / (self.half or 1.0)
        return counts * {"x": x / self.edge, "y": y / self.edge, "time": since}.get(change.kind, 1.0)


IN_UNITS = Growth()


class Question(NamedTuple):
    """A change that is asked for: sums of `StarColumns` (`across`: along Y, of a gradient), by `widest` at most."""

    kind: str
    name: str
    unit: str
    along: WeightedColumns
    across: WeightedColumns | None = None
    widest: float = np.inf

    @property
    def number(self) -> int:
        """The questions that it counts as."""
        return 1 if self.across is None else DIRECTIONS

    def change(self, *sized: float, **others: float) -> PossibleChange:
        """The change, without a size or of the `size` and `error` that are given."""
        size, error = sized or (0.0, np.inf)
        camera = self.kind != "optics"
        found = PossibleChange(self.name, camera, ALWAYS, size, error, self.unit, self.kind)
        return found._replace(widest=self.widest, **others)


class StarColumns:
    """Columns of some stars: for each of `kinds` those of all cameras, then the numbers of the optics that show."""

    def __init__(self, stars: StarResiduals, vectors: AnalysisVectors, kinds: Sequence[str]) -> None:
        self.cameras = tuple(vectors.instrument.cameras.names)
        self.growth = Growth.of(stars)
        self.kinds = tuple(kind for kind in kinds if kind != "time" or self.growth.half > 0)
        self.count = len(self.kinds) * len(self.cameras)
        self.arms = [tuple(arm) for arm in vectors.instrument.cameras.arms if len(arm) > 1]
        self.seen = np.flatnonzero(np.abs(stars.plain).max(axis=(0, 1), initial=0.0) > 0)
        self.optics: list[Question] = []
        for column, p in enumerate(self.seen.tolist(), start=self.count):
            name, unit = vectors.named[p]
            parameter = vectors.calibration.model[name]
            width = parameter.width or parameter.loose or np.inf
            self.optics.append(Question("optics", name, unit, {column: 1.0}, widest=FARTHEST * width))

    def number(self, kind: str, camera: int) -> int:
        """The number of a column."""
        return self.kinds.index(kind) * len(self.cameras) + camera

    def of_one(self, kind: str, cameras: Sequence[int]) -> Question:
        """A question about cameras together."""
        name = "+".join(self.cameras[k] for k in cameras)
        of = "arm" if kind == "gain" and len(cameras) > 1 else kind
        return Question(of, name, _UNITS.get(kind, ""), {self.number(kind, k): 1.0 for k in cameras})

    def of_cameras(self, part: StarResiduals) -> Float[np.ndarray, "r k c"]:
        """The columns of the cameras, over σ."""
        number = len(self.cameras)
        values = np.zeros((*part.model.shape, self.count))
        place = (part.x, part.y, part.time)
        lit = part.root > 0
        counts = np.where(lit, part.model / np.where(lit, part.root, 1.0), 0.0)
        for n, kind in enumerate(self.kinds):
            change = PossibleChange("", True, kind=kind)
            for k in range(number):
                grown = self.growth.electrons(change, *place, counts[:, k])
                values[:, k, n * number + k] = grown * part.root[:, k]
        return values

    def all_of(self, part: StarResiduals) -> Float[np.ndarray, "r k c"]:
        """All columns, over σ."""
        return np.concatenate([self.of_cameras(part), part.plain[..., self.seen]], axis=-1)

    def of(self, part: StarResiduals, change: PossibleChange) -> Float[np.ndarray, "r k"]:
        """The column of any change, over σ, where it is largest in time."""
        if not change.camera:
            names = [question.name for question in self.optics]
            return part.plain[..., self.seen[names.index(change.name)]]
        lit = part.root > 0
        counts = np.where(lit, part.model / np.where(lit, part.root, 1.0), 0.0)
        values = np.zeros_like(part.model)
        for k in (self.cameras.index(name) for name in change.members):
            grown = self.growth.electrons(change, part.x, part.y, part.time, counts[:, k])
            values[:, k] = grown * part.root[:, k]
        return values

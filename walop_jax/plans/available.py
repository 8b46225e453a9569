"""Possible observations and their costs: filters, plates, exposure times, visibility, overheads.

Their file (docs: files) is the file of an observing plan with a few more entries; its polariser angles are ignored.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.records import Exposures
from walop_jax.io.errors import errors_naming, fail
from walop_jax.io.text import parse_toml, read_text
from walop_jax.model.parameters import check_names
from walop_jax.simulation.observing_plan import EXPOSED, OUT, ObservingPlan, Stop, is_plan, plan_of
from walop_jax.sky.directions import separation
from walop_jax.sky.moon import altitude, body_direction

DARK = -12.0  # altitude of the Sun (deg) below which the sky is dark enough for Moon and stars
MOST_ANGLES = 24  # of a moving element, where a plan takes them from a calibration
_FULL = 120.0  # distance of Moon and Sun (deg) from which the Moon is as good as full
_SEARCHED, _STEP = 60.0, 1.0 / 24.0  # days in which a better time is looked for, and its steps


@dataclasses.dataclass(frozen=True)
class Costs:
    """Time (s) beside exposing: of each exposure by its kind, and of changes between exposures (see the module)."""

    clp: float = 20.0
    lamp: float = 15.0
    moon: float = 60.0
    standard: float = 90.0
    filter: float = 60.0
    position: float = 30.0
    slew: float = 1.0

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not (isinstance(value, int | float) and np.isfinite(value) and value >= 0):
                raise ValueError(f"costs: {name} = {value}; give a time in seconds, 0 or more")

    def of(self, kind: str) -> float:
        """Time beside an exposure of a kind."""
        return float(getattr(self, kind))


ANY = "any"  # angle of the calibration plate
PLATE_TURN = 180.0  # deg after which the plate repeats itself
STEP, PLATE_STEP = 1.5, 7.5
"""Steps (deg) of the grid: angles of the polariser, and of the plate where it may stand at any.

Both hold 22.5, 45 and 90, at which cameras are dark and the information of an exposure varies quickest."""


class CandidateExposure(NamedTuple):
    """Exposures that differ in the angle of the polariser alone, or in the Moon patch or standard: one for each of
    `stops`.

    Angles of the polariser repeat themselves after `turn` (deg): half a turn, or a whole one where it is not ideal.
    """

    kind: str
    filter: str
    positions: Mapping[str, float | None]
    seconds: float
    stops: tuple[Stop, ...]
    turn: float = 180.0

    @property
    def setting(self) -> tuple[Any, ...]:
        """What has to be changed for another choice: filter and positions of the moving elements."""
        return (self.filter, *self.positions.values())

    def number(self, angle: float) -> int:
        """The stop that is nearest to an angle (deg) of the polariser."""
        return round(angle % self.turn / STEP) % len(self.stops)

    def over(self, turn: float) -> CandidateExposure:
        """These exposures with the polariser on the grid over a turn (deg)."""
        if self.kind != "clp":
            return self
        angles = (STEP * np.arange(round(turn / STEP))).tolist()
        stops = tuple(dataclasses.replace(self.stops[0], polariser_angle=angle) for angle in angles)
        return self._replace(stops=stops, turn=turn)

    def in_words(self, reading_in_words: Callable[[str, float], str]) -> str:
        """The choice in a few words: clp, SDSS-r, CHWP 45°, 30 s; by `Instrument.reading_in_words`."""
        readings = (
            f"{p} {'out' if a is None else reading_in_words(p, a)}" for p, a in self.positions.items()
        )
        return ", ".join([self.kind, self.filter, *readings, f"{self.seconds:g} s"])


def with_stops(plan: ObservingPlan, stops: Iterable[Stop], **changes: Any) -> ObservingPlan:
    """An observing plan of these exposures alone."""
    return dataclasses.replace(plan, stops=tuple(stops), patches=(), stars=(), **changes)


@dataclasses.dataclass(frozen=True)
class Available:
    """Exposures that could be taken: those of an observing plan, the polariser at any angle of a grid; costs, limits.

    `seconds` are exposure times to choose from, by kind; pointings lower than `altitude` (deg) are left out; `places`
    takes standards at single places of their raster, not at all of them for the cost of one. With `any_plate` the
    calibration plate may stand at any angle of a grid behind the polariser, besides its settings in the plan. Targets
    must be up in the dark when the sky is first observed, and for `throughout` minutes from then on. Raises ValueError
    for values that contradict each other.
    """

    plan: ObservingPlan
    costs: Costs = Costs()
    seconds: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    altitude: float = 20.0
    places: bool = False
    any_plate: bool = False
    throughout: float = 0.0

    def __post_init__(self) -> None:
        check_names("kind of exposure", self.seconds, EXPOSED)
        for kind, times in self.seconds.items():
            if not times or min(times) <= 0:
                raise ValueError(f"seconds: {kind} = {list(times)}; give exposure times above 0")
        if not -90.0 <= self.altitude < 90.0:
            raise ValueError(f"altitude = {self.altitude}: give degrees above the horizon, below 90")
        design = self.plan.design
        if self.any_plate and (design.polariser is None or CALIBRATION_PLATE not in design.moving()):
            raise ValueError(f'plate = "{ANY}": {self.plan.name} has no polariser with a calibration plate')

    @classmethod
    def of(cls, given: Available | ObservingPlan | str | os.PathLike[str]) -> Available:
        """From a file, an observing plan, or the name or description of an instrument."""
        if isinstance(given, Available):
            return given
        if isinstance(given, ObservingPlan):
            return cls(given)
        if not is_plan(given):
            plain = cls(ObservingPlan(str(given)))
            return dataclasses.replace(plain, any_plate=CALIBRATION_PLATE in plain.plan.design.moving())
        with errors_naming(given):
            return cls.read(parse_toml(read_text(given)), Path(given).parent)

    @classmethod
    def read(cls, content: Mapping[str, Any], folder: Path) -> Available:
        """From the entries of a file; raises ValueError for unknown or impossible ones."""
        content, options = dict(content), {}
        for name in ("altitude", "places"):
            if name in content:
                options[name] = content.pop(name)
        costs = dict(content.pop("costs", {}))
        check_names("cost", costs, Costs.__dataclass_fields__)
        plate = content.get("plate", ())
        if options.setdefault("any_plate", ANY in plate if isinstance(plate, list) else plate == ANY):
            listed = [angle for angle in plate if angle != ANY] if isinstance(plate, list) else []
            content["plate"] = plate = listed or [OUT]
        check_names("angle of the plate", (a for a in plate if isinstance(a, str) and a != OUT), (OUT, ANY))
        seconds = {kind: tuple(np.atleast_1d(v).tolist()) for kind, v in content.pop("seconds", {}).items()}
        return cls(plan_of(content, folder), Costs(**costs), seconds, **options)

    def choices(self) -> tuple[tuple[CandidateExposure, ...], tuple[str, ...]]:
        """All choices, and remarks on those left out, with a remedy."""
        plan, notes = self.plan, []
        up: dict[str, tuple[int, ...]] = {}
        for kind, total in (("moon", plan.moon_patches), ("standard", len(plan.star_names))):
            up[kind], remarks = self._up(kind, total)
            notes += remarks
        candidates, plates = [], tuple(plan.plate)
        if self.any_plate:
            grid = (PLATE_STEP * np.arange(round(PLATE_TURN / PLATE_STEP))).tolist()
            plates += tuple(angle for angle in grid if angle not in plates)
        positions = {CALIBRATION_PLATE: plates, **plan.moving}
        for name, stops in itertools.product(plan.filter_names, itertools.product(*positions.values())):
            where = dict(zip(positions, stops, strict=True))
            moving = {prefix: a for prefix, a in where.items() if prefix != CALIBRATION_PLATE}
            for kind in EXPOSED:
                if kind == "clp" and plan.design.polariser is None:
                    continue
                if kind != "clp" and stops[0] not in plan.plate:
                    continue  # any angle of the plate is for light behind the polariser
                for seconds in self.seconds.get(kind, (EXPOSED[kind],)):
                    angle = 0.0 if kind == "clp" else None
                    blank = Stop(angle, name, stops[0], moving, kind=kind, seconds=seconds)
                    no_sky = kind == "clp" or (kind == "lamp" and plan.lamps)
                    members = (blank,) if no_sky else tuple(self._members(blank, up.get(kind, ())))
                    if members:
                        one = CandidateExposure(kind, name, where, seconds, members)
                        candidates.append(one.over(one.turn))
        return tuple(candidates), tuple(notes)

    def _members(self, blank: Stop, numbers: tuple[int, ...]) -> Iterator[Stop]:
        for number in numbers:
            single = self.places and blank.kind == "standard" and number < self.plan.standards
            for place in range(self.plan.standard_grid**2) if single else (None,):
                yield dataclasses.replace(blank, number=number, place=place)

    def _up(self, kind: str, total: int) -> tuple[tuple[int, ...], list[str]]:
        """Numbers of the targets that are up in the dark, and remarks on the others."""
        if not total:
            return (), []
        plan, what = self.plan, "Moon patches" if kind == "moon" else "standards"
        if not plan.site.known:
            advice = "the site is not known; give it in the description, under [site]"
            return (), [f"{what} are left out: {advice}"]
        e = self.targets[kind]
        visible, why = self._visible(e)
        if self.throughout and visible.any():
            # Standards are chosen when their time has come: only the Moon has a place.
            last = dataclasses.replace(e, mjd=np.full(total, plan.start + self.throughout / 1440.0))
            high, dark = self._high_and_dark(last)
            visible &= dark & (high | (kind == "standard"))
            why = f"they cannot be observed for all of the {self.throughout:g} minutes"
        lost = total - int(visible.sum())
        notes = [f"{lost} of {total} {what} are left out: {why}{self._better()}"] if lost else []
        return tuple(np.flatnonzero(visible).tolist()), notes

    @functools.cached_property
    def targets(self) -> Mapping[str, Exposures]:
        """The Moon patches and the standards, by kind: an exposure of each in the order of their numbers."""
        plan, name = self.plan, self.plan.filter_names[0]
        totals = {"moon": plan.moon_patches, "standard": len(plan.star_names)}
        stops = {
            kind: [Stop(None, name, kind=kind, number=i) for i in range(n)] for kind, n in totals.items() if n
        }
        return {kind: with_stops(plan, each).exposures() for kind, each in stops.items()}

    def _visible(self, exposures: Exposures) -> tuple[Bool[np.ndarray, " e"], str]:
        """Exposures of the sky that are high enough, in the dark; and why others are not."""
        high, dark = self._high_and_dark(exposures)
        return high & dark, "it is not dark" if not dark.all() else f"they are below {self.altitude:g}°"

    def _high_and_dark(self, exposures: Exposures) -> tuple[Bool[np.ndarray, " e"], Bool[np.ndarray, " e"]]:
        """Exposures with a target that is high enough, and those in the dark."""
        mjd, site = exposures.mjd, self.plan.site
        high = altitude(mjd, exposures.ra, exposures.dec, site) >= self.altitude
        return high, altitude(mjd, *body_direction("sun", mjd, site), site) < DARK

    def doubts(self, plan: ObservingPlan) -> tuple[str, ...]:
        """Sentences on exposures of a plan that cannot be taken at the times that it gives them."""
        exposures = plan.exposures()
        exposures = exposures[exposures.direct("moon", "standard")]
        if not len(exposures) or not plan.site.known:
            return ()
        visible, why = self._visible(exposures)
        lost = len(exposures) - int(visible.sum())
        text = f"{lost} of {len(exposures)} exposures of the sky come too late in this order: {why}"
        return (text,) if lost else ()

    def in_whole_seconds(self) -> Available:
        """These observations with exposure times of whole seconds, which schedules need."""
        rounded = {k: [max(1.0, float(round(t))) for t in ts] for k, ts in self.seconds.items()}
        return dataclasses.replace(self, seconds={k: tuple(dict.fromkeys(ts)) for k, ts in rounded.items()})

    def _better(self) -> str:
        """The next time at which the Moon is full, high and the sky dark."""
        mjd = self.plan.start + np.arange(0.0, _SEARCHED, _STEP)
        site = self.plan.site
        moon, sun = body_direction("moon", mjd, site), body_direction("sun", mjd, site)
        high = altitude(mjd, *moon, site) >= self.altitude + self.plan.separations[1]
        good = np.flatnonzero(high & (altitude(mjd, *sun, site) < DARK) & (separation(*moon, *sun) > _FULL))
        return f"; mjd = {mjd[good[0]]:.2f} would do" if len(good) else "; choose another night (mjd)"


def plan_beside(prior: Calibration) -> ObservingPlan:
    """A plan of the instrument of a calibration, whose moving elements stand where they stood in its exposures.

    Raises `DataError` for one that stood at too many angles; the calibration plate is left to the plan.
    """
    others = (prefix for prefix in prior.design.moving() if prefix != CALIBRATION_PLATE)
    moving = {prefix: _stood_at(prior, prefix) for prefix in others}
    design = prior.design if prior.design.description else prior.instrument
    return ObservingPlan(design, moving=moving)


def _stood_at(prior: Calibration, prefix: str) -> tuple[float | None, ...]:
    """Readings (angles in deg; None: out) of a moving element in the exposures of a calibration."""
    position = prior.exposures.position(prefix)
    reading = prior.design.within_period(prefix, position.angle).round(3)
    stood = np.unique(np.where(position.inside, reading, np.nan))
    if len(stood) > MOST_ANGLES:
        advice = f"say moving = {{ {prefix} = [0, 22.5, 45] }} in a plan, and give --candidates PLAN.toml"
        raise fail(f"{prefix} stood at {len(stood)} angles, more than could be tried", advice=advice)
    return tuple(float(angle) if np.isfinite(angle) else None for angle in stood)

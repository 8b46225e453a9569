"""The plan of a calibration run: points, exposures, standards and filters, without any light yet.

Its TOML file (docs: files) has what `ObservingPlan` has, by the same names, and nothing else.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from jaxtyping import Bool, Float

from walop_jax.data.checks import checked_curve
from walop_jax.data.kinds import CALIBRATION_PLATE, KINDS, POLARISER
from walop_jax.data.records import Exposures, FilterCurve, Points, Position, Site, StatedErrors
from walop_jax.data.settings import BUILTIN_FILTERS, DEFAULT_FILTER, builtin_filter, single_wavelength
from walop_jax.data.units import Place
from walop_jax.instruments.description import default_name, described, shipped
from walop_jax.io.errors import PathLike, errors_naming, nearest
from walop_jax.io.text import parse_toml, read_text
from walop_jax.io.toml import OUT, Reader
from walop_jax.model.effects.base import Context
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.elements.registry import defined_elements
from walop_jax.model.instrument import Instrument, as_designed, nominal_instrument
from walop_jax.model.parameters import check_names, unknown_name
from walop_jax.simulation.polariser_angles import USUAL_ANGLES, angles_of
from walop_jax.simulation.polariser_angles import polariser_turn as polariser_turn
from walop_jax.sky.moon import body_direction, local_sidereal_time, offset_direction

NAN = float("nan")
_SOME_NIGHT = 61041.9  # MJD
NARROW_BANDS: Mapping[str, float] = {"NB-580": 0.580, "NB-660": 0.660}  # centre, µm
_MINUTES_A_DAY = 1440.0
_GOLDEN = 0.5 * (3.0 - np.sqrt(5.0))  # of a turn: spreads any number of angles evenly
_ZERO_EDGE = 0.9  # of the field
_SPREAD = 1.0 / 1.324717957244746 ** np.array([1.0, 2.0])  # Roberts 2018: evenly in two dimensions
_STANDARD_EDGE = 0.8  # of the field: 5 × 5 centres of boxes that fill it
EXPOSED: Mapping[str, float] = {
    name: kind.seconds for name, kind in KINDS.items() if kind.seconds is not None
}
"""The usual exposure time (s) of each kind, in which a camera sees `ObservingPlan.electrons`."""
_MOON_ROTATOR, _STAR_ROTATOR = (0.0, 40.0, 90.0, 135.0), (0.0, 30.0, 75.0, 120.0)


NO_SKY: Mapping[str, Any] = {"moon_patches": 0, "standards": 0, "unpolarised": 0, "throughput_degree": 0}
"""Of a plan on a bench."""


@dataclasses.dataclass(frozen=True)
class Stop:
    """One exposure, taken `times` times: through the polariser at an angle (deg), or of another `kind`.

    `plate` is the angle of the calibration plate, `moving` those of further moving elements (deg, None: out);
    `turn` the angle (deg) by which the calibration plate turns during the exposure, about `plate`;
    `seconds` the exposure time (None: the usual one; electrons grow with it). `number`, from 0, is that of the Moon
    patch or standard, `place` the place of a standard among those of the raster (None: all of them, one after the
    other).
    """

    polariser_angle: float | None = None
    filter: str = DEFAULT_FILTER
    plate: float | None = None
    moving: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    times: int = 1
    kind: str = "clp"
    number: int = 0
    place: int | None = None
    seconds: float | None = None
    turn: float = 0.0

    def __post_init__(self) -> None:
        check_names("kind of a stop", [self.kind], EXPOSED)
        if (self.polariser_angle is None) == (self.kind == "clp"):
            raise ValueError(
                f"a stop of kind {self.kind} {'needs' if self.kind == 'clp' else 'has no'} polariser_angle"
            )
        if self.times < 1:
            raise ValueError(f"a stop is taken {self.times} times; leave it out, or take it once")
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"an exposure of {self.seconds} s: give a time above 0, or leave it out")

        if self.turn and self.plate is None:
            raise ValueError(
                f"turn = {self.turn:g} deg: the calibration plate is out; give its angle, plate = 0"
            )

    def document(self) -> dict[str, Any]:
        """The stop as plain data, usual values left out from `kind` on."""
        later = {"kind": "clp", "number": 0, "place": None, "seconds": None, "turn": 0.0}
        return {k: v for k, v in dataclasses.asdict(self).items() if k not in later or v != later[k]}


@dataclasses.dataclass(frozen=True, repr=False)
class ObservingPlan:
    """A calibration run: where, when, through what.

    Field points are a `grid` × `grid` raster over ±`field` degrees, on which polariser and Moon sky are measured, and
    `standard_grid` × `standard_grid` places of the standards out to 4/5 of it; where the instrument's raster is a line
    the points are `grid` steps of X from 0 to `field` (the tilts of a plate on a bench). NaN: as far out as its
    description says.
    The polariser goes through `polariser_angles` (deg; a number: so many, evenly over half a turn, with `full_turn`
    over a full one) for each of `filters` and each setting of the calibration
    plate in `plate` (deg, None: out); Moon patches and standards take the settings in turn, in the first filter.
    `filters` are names of those that are built in, and `FilterCurve`s; also a dict of curves by name. The Moon is
    observed from `mjd` (UTC) on, at `separations` (deg), the polariser before and the standards after; exposures are
    `spacing` minutes apart.
    `star_lmax` are the wavelengths (µm) of largest polarisation of the polarised standards, in turn: these are then
    observed in every filter, and the catalogue has their values in the first one; none: they are observed in that one,
    unless stops say, and have 0.55 µm. After them come `zero_exposures` of a field of `zero_stars` stars that are all
    measured at once: their mean q and u are 0 with an error of `zero_error`, they scatter by `zero_scatter` around it;
    among stops it is the standard that follows the last one. `electrons` is the level of a camera in unpolarised light
    of full transparency, ahead of reflections. N_ERR holds the noise of photons and `read_noise` (electrons); counts
    scatter by `noise_scale` times that, and by `noise_fraction` of the counts in quadrature (`model.noise`), so that a
    set may have errors that are stated too small.

    `instrument` is one that comes with the package, by name, or any other; None: the first of the family. `moving`
    holds the positions (deg, None: out) of further moving elements by the prefix of their columns: the polariser goes
    through its angles for every combination of them, and `lamps` exposures of KIND `lamp` without it follow each
    time. An instrument without a polariser has no exposures through one.

    A plan may also say each exposure: `stops` in place of all combinations, in order; `patches` and `stars` are the
    numbers, from 0, of the Moon patches and standards that are taken after them (None: each once, unless stops say).
    `stated_errors` are those of positions, times and all other numbers of the set that are not the usual ones
    (`records.StatedErrors`).

    >>> walop.ObservingPlan(grid=4)
    ObservingPlan('WALOP-SOUTH', grid=4, field=0.29, moving={})
    """

    instrument: str | Instrument | None = None
    grid: int = 12
    field: float = NAN
    standard_grid: int = 5
    polariser_angles: Sequence[float] | Float[np.ndarray, " a"] | int = USUAL_ANGLES
    moon_patches: int = 8
    separations: tuple[float, float] = (8.0, 20.0)
    standards: int = 8
    unpolarised: int = 2
    catalogue_error: float = 2e-4
    star_lmax: tuple[float, ...] = ()
    zero_stars: int = 0
    zero_exposures: int = 1
    zero_error: float = 1e-4
    zero_scatter: float = 5e-4
    filters: Sequence[str | FilterCurve] | Mapping[str, Any] = (DEFAULT_FILTER,)
    plate: tuple[float | None, ...] = (None,)
    electrons: float = 1e6
    read_noise: float = 30.0
    noise_scale: float = 1.0
    noise_fraction: float = 0.0
    teff: float = 5772.0
    temperature: tuple[float, float] = (12.0, 8.0)
    mjd: float | None = None
    spacing: float = 5.76
    throughput_degree: int | None = None
    moving: Mapping[str, tuple[float | None, ...]] = dataclasses.field(default_factory=dict)
    lamps: int = 0
    stops: tuple[Stop, ...] = ()
    patches: tuple[int, ...] | None = None
    stars: tuple[int, ...] | None = None
    full_turn: dataclasses.InitVar[bool | None] = None
    stated_errors: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __repr__(self) -> str:
        text = (
            f"{field.name}={getattr(self, field.name)!r}"
            for field in dataclasses.fields(self)
            if field.name != "instrument" and getattr(self, field.name) != field.default
            if field.name != "stated_errors" or self.stated_errors
        )
        return f"ObservingPlan({', '.join([repr(self.name), *text])})"

    def __post_init__(self, full_turn: bool | None) -> None:
        object.__setattr__(self, "polariser_angles", angles_of(self.polariser_angles, full_turn))
        if isinstance(self.instrument, str):
            described(self.instrument)  # an unknown name is an error here
        if np.isnan(self.field):
            object.__setattr__(self, "field", self._raster[1])
        moving = self.design.moving()
        check_names("moving element", self.moving, moving)
        for prefix in self.moving:
            if not self.moving[prefix]:
                raise ValueError(f"moving: {prefix} has no positions; list its angles (deg), or leave it out")
        for name in ("grid", "standard_grid"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)} must be at least 1")
        limit = self.design.field_limit
        if not 0.0 <= self.field <= limit:
            raise ValueError(
                f"field = {self.field:g} deg must be between 0 and {limit:g}, the field of {self.name}"
            )
        if min(self.moon_patches, self.standards, self.unpolarised) < 0:
            raise ValueError("numbers of Moon patches and standards cannot be negative")
        if any(not 0.3 <= lmax <= 1.0 for lmax in self.star_lmax):
            raise ValueError(f"star_lmax = {list(self.star_lmax)}: give wavelengths from 0.3 to 1.0 um")
        if not 0 < self.spacing < np.inf:
            raise ValueError(f"spacing = {self.spacing}: give minutes above 0")
        if not self.electrons > 0:
            raise ValueError(f"{self.electrons} electrons: a camera needs some light")
        if not (self.filters and self.plate):
            raise ValueError("at least a filter and a setting of the calibration plate are needed")
        if self.design.polariser is not None:
            if not self.polariser_angles:
                raise ValueError("at least one polariser angle is needed")
        elif self.polariser_angles != USUAL_ANGLES:
            raise ValueError(f"polariser_angles: {self.name} has no polariser")
        elif not (self.lamps or self.stops or self.moon_patches or self.standards):
            raise ValueError("no exposures: give lamps, Moon patches or standards")
        StatedErrors.of(self.stated_errors)  # a name or a number that is none is an error here
        if isinstance(self.filters, Mapping):
            object.__setattr__(self, "filters", tuple(_own_filter(*item) for item in self.filters.items()))
        if len(self.curves()) < len(self.filters):
            raise ValueError("filters: one is there twice; give each a name of its own")
        for stop in self.stops:
            check_names("filter of a stop", [stop.filter], self.filter_names)
            check_names("moving element of a stop", stop.moving, moving)
            for prefix in stop.moving:
                if prefix not in self.moving:
                    raise ValueError(
                        f"a stop has a position of {prefix}: list all of them in the plan as well, "
                        f"moving = {{ {prefix} = [0, 22.5, 45] }}"
                    )
            total = {"moon": self.moon_patches, "standard": len(self.star_names)}.get(stop.kind, 1)
            if not 0 <= stop.number < total:
                raise ValueError(
                    f"a stop: there is no {stop.kind} {stop.number}; they go from 0 to {total - 1}"
                )
            if stop.place is not None and not 0 <= stop.place < self.standard_grid**2:
                raise ValueError(f"a stop: places of standards go from 0 to {self.standard_grid**2 - 1}")
        for name, total in (("patches", self.moon_patches), ("stars", self.standards)):
            for number in getattr(self, name) or ():
                if not 0 <= number < total:
                    raise ValueError(f"{name}: there is no number {number}; they go from 0 to {total - 1}")

    @classmethod
    def bench(cls, tilts: int = 11) -> ObservingPlan:
        """The laboratory bench: plate tilts from 0 to 20°, no sky."""
        bench = next(name for name in shipped() if described(name).raster == "line")
        return cls(bench, tilts, **NO_SKY)

    @classmethod
    def usual(cls, instrument: Instrument) -> ObservingPlan:
        """The usual plan for an instrument; without sky where its field points lie on a line, as on a bench."""
        return cls(instrument, **(NO_SKY if instrument.raster[0] == "line" else {}))

    @functools.cached_property
    def design(self) -> Instrument:
        """The instrument as designed."""
        if isinstance(self.instrument, Instrument):
            return as_designed(self.instrument)
        return nominal_instrument(self.instrument)

    @property
    def _raster(self) -> tuple[str, float]:
        """Layout of the field points and its half-width (deg); found without making the instrument."""
        if isinstance(self.instrument, Instrument):
            return self.instrument.raster
        described_as = described(self.instrument or default_name())
        return described_as.raster, described_as.edge

    @property
    def name(self) -> str:
        """Name of the instrument."""
        return self.design.name

    def document(self) -> dict[str, Any]:
        """The plan as plain data."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        degree = self.design.throughput.degree if self.throughput_degree is None else self.throughput_degree
        fields |= {"instrument": self.name, "throughput_degree": degree, "moving": dict(self.moving)}
        if any(isinstance(entry, FilterCurve) for entry in self.filters):
            fields["filters"] = {_name_of(entry): _curve_document(entry) for entry in self.filters}
        # Named only where there are any: plans of other instruments read as they always did.
        fields["stops"] = [stop.document() for stop in self.stops]
        later = {"moving": {}, "lamps": 0, "stops": [], "patches": None, "stars": None, "star_lmax": ()}
        later |= {"spacing": type(self).spacing, "stated_errors": {}}
        later |= {name: getattr(type(self), name) for name in fields if name.startswith("zero_")}
        return {key: value for key, value in fields.items() if key not in later or value != later[key]}

    @property
    def site(self) -> Site:
        """Place of the telescope."""
        return Site(*self.design.site[:4])

    @property
    def start(self) -> float:
        """MJD (UTC) of the first Moon exposure."""
        night = self.design.site[4]
        if self.mjd is None and not np.isfinite(night):
            return _SOME_NIGHT
        return night if self.mjd is None else self.mjd

    @property
    def star_names(self) -> tuple[str, ...]:
        """Names of the standards, a field of zero polarisation last."""
        return (*(f"STD{i:02d}" for i in range(self.standards)), *(("ZERO",) if self.zero_stars else ()))

    def points(self) -> Points:
        """Grid points first, then the places of the standards (if there are any), then the stars of a field."""
        if self._raster[0] == "line":
            x = np.linspace(0.0, self.field, self.grid)
            y = np.zeros_like(x)
        else:
            x, y = _square(self.field, self.grid)
        if self.standards:
            star_x, star_y = _square(round(_STANDARD_EDGE * self.field, 9), self.standard_grid)
            x, y = np.append(x, star_x), np.append(y, star_y)
        if self.zero_stars:
            spread = np.mod(np.arange(1, self.zero_stars + 1)[:, None] * _SPREAD, 1.0)
            zero_x, zero_y = (_ZERO_EDGE * self.field * (2.0 * spread - 1.0)).T
            x, y = np.append(x, zero_x), np.append(y, zero_y)
        return Points(point=np.arange(len(x)), x=x, y=y)

    @property
    def filter_names(self) -> tuple[str, ...]:
        """Names of the filters in their order."""
        return tuple(map(_name_of, self.filters))

    def curves(self) -> dict[str, FilterCurve]:
        """The filters with their curves. Raises ValueError for a name that is not known and a curve that is none."""
        return {_name_of(entry): filter_curve(entry) for entry in self.filters}

    @functools.cached_property
    def _taken(self) -> tuple[Stop, ...]:
        """Every exposure, in the order in which they are taken."""
        further = [dict(zip(self.moving, m, strict=True)) for m in itertools.product(*self.moving.values())]
        of_polariser: Any = () if self.design.polariser is None else self.polariser_angles
        angles = (*of_polariser, *[None] * self.lamps)
        through_polariser = [
            dataclasses.replace(stop, times=1) for stop in self.stops for _ in range(stop.times)
        ] or [
            Stop(a, f, p, m, kind="lamp" if a is None else "clp")
            for f in self.filter_names
            for p in self.plate
            for m in further
            for a in angles
        ]
        # Where every exposure is said, those of the sky are taken with the plate at its first setting.
        plates = self.plate[:1] if self.stops else self.plate
        kinds = {stop.kind for stop in self.stops}
        sky = [
            Stop(None, name, plates[i % len(plates)], further[0], kind=kind, number=number)
            for kind, numbers, total in (
                ("moon", self.patches, self.moon_patches),
                ("standard", self.stars, self.standards),
            )
            for name in self.filter_names[: None if kind == "standard" and self.star_lmax else 1]
            for i, number in enumerate(
                numbers if numbers is not None else () if kind in kinds else range(total)
            )
        ]
        if self.zero_stars and self.stars is None and "standard" not in kinds:
            name, plate = self.filter_names[0], plates[0]
            field = Stop(None, name, plate, further[0], kind="standard", number=self.standards)
            sky += [field] * self.zero_exposures
        return (*through_polariser, *sky)

    def exposures(self) -> Exposures:
        """All exposures in the order in which they are taken."""
        stops = self._taken
        n = len(stops)
        kind = np.array([stop.kind for stop in stops])
        number = np.array([stop.number for stop in stops])
        moon, star = np.flatnonzero(kind == "moon"), np.flatnonzero(kind == "standard")
        sky = np.append(moon, star)
        mjd = self.start + self.spacing / _MINUTES_A_DAY * (np.arange(n) - (sky.min() if len(sky) else n))
        ra, dec, rotator = np.full((3, n), NAN)
        if len(moon):
            # Around the Moon: separations and position angles spread evenly.
            (near, far), turns = self.separations, number[moon] * _GOLDEN
            away = near + (far - near) * np.mod(0.5 + turns, 1.0)
            direction = body_direction("moon", mjd[moon], self.site)
            ra[moon], dec[moon] = offset_direction(*direction, 360.0 * _GOLDEN * number[moon], away)
        rotator[moon] = np.array(_MOON_ROTATOR)[number[moon] % 4]
        rotator[star] = np.array(_STAR_ROTATOR)[number[star] % 4]
        # Pointings that the plan does not fix are spread over ±3 h, out of step with the polariser.
        ha = 6.0 * np.mod(np.arange(n) * _GOLDEN, 1.0) - 3.0
        if len(sky):
            sidereal = local_sidereal_time(mjd, self.site.longitude)
            ra[star] = np.mod(sidereal[star] - 15.0 * ha[star], 360.0)
            dec[star] = np.clip(self.site.latitude + 5.0, -85.0, 85.0)
            ha[moon] = (np.mod(sidereal[moon] - ra[moon] + 180.0, 360.0) - 180.0) / 15.0
        return Exposures(
            exposure=np.arange(n),
            kind=kind,
            mjd=mjd,
            exptime=np.array([EXPOSED[s.kind] if s.seconds is None else s.seconds for s in stops]),
            filter=np.array([stop.filter for stop in stops]),
            temp=np.linspace(*self.temperature, n),
            ha=ha,
            ra=ra,
            dec=dec,
            rotator=rotator,
            teff=np.full(n, self.teff),
            positions={
                POLARISER: Position.at(stop.polariser_angle for stop in stops),
                CALIBRATION_PLATE: dataclasses.replace(
                    Position.at(stop.plate for stop in stops), turn=np.array([stop.turn for stop in stops])
                ),
                **{prefix: Position.at(stop.moving.get(prefix) for stop in stops) for prefix in self.moving},
            },
        )

    def layout(self) -> tuple[Bool[np.ndarray, "p e"], np.ndarray]:
        """True for the (point, exposure) pairs that are measured, and the row of the star in each (−1: none)."""
        stops, points = self._taken, self.points()
        raster = self.standard_grid**2 if self.standards else 0
        place = np.arange(len(points)) - (len(points) - raster - self.zero_stars)
        star = np.array([stop.number if stop.kind == "standard" else -1 for stop in stops])
        # Points of the grid, of the raster of standards, of a field of stars; and the exposures that see them.
        used = np.digitize(place, (0, raster))[:, None] == np.digitize(star, (0, self.standards))
        for e, stop in enumerate(stops):
            if stop.place is not None and stop.kind == "standard":
                used[:, e] &= place == stop.place
        return used, np.where(used, star, -1)

    def context(self) -> Context:
        """What effects that grow with the data need to know of the run."""
        return effect_context(self.design, self.exposures())._replace(sources=self.star_names)


def _square(edge: float, count: int) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Places of a square raster out to ± edge, or its centre; X runs fastest."""
    side = np.linspace(-edge, edge, count) if count > 1 else np.zeros(1)
    return np.tile(side, count), np.repeat(side, count)


def filter_curve(curve: str | FilterCurve) -> FilterCurve:
    """A built-in filter, one of the narrow bands of `NARROW_BANDS` (flat-topped, 15 nm wide), or a curve, checked."""
    if isinstance(curve, FilterCurve):
        curve = _own_filter(curve.name, curve)
    if isinstance(curve, FilterCurve):
        return curve
    if curve in NARROW_BANDS:
        offset = np.linspace(-0.015, 0.015, 61)
        throughput = np.exp(-np.log(2.0) * (offset / 0.0075) ** 6)
        return FilterCurve(curve, NARROW_BANDS[curve] + offset, throughput)
    if curve in BUILTIN_FILTERS or single_wavelength(curve) is not None:
        return builtin_filter(curve)
    suggestion = nearest(curve, (*BUILTIN_FILTERS, *NARROW_BANDS, "MONO-6500"))
    raise ValueError(
        f"filters: there is no filter {curve!r}; {suggestion}; a filter of your own is a table [filters.{curve}] with "
        "wavelength (um) and throughput, in Python a FilterCurve"
    )


def _own_filter(name: str, given: Any) -> str | FilterCurve:
    """The curve of a table with wavelength and throughput, or of a `FilterCurve`; of an empty table the name."""
    place = Place("", f"filters.{name}")
    table = _curve_document(given) if isinstance(given, FilterCurve) else given
    if not isinstance(table, Mapping) or table.keys() not in ({"wavelength", "throughput"}, set()):
        raise place.fail("needs wavelength (um) and throughput; nothing at all for a filter that is built in")
    if not table:
        return name
    try:
        wavelength, throughput = (
            np.atleast_1d(np.asarray(table[key], float)) for key in ("wavelength", "throughput")
        )
    except (TypeError, ValueError):
        raise place.fail("wavelength and throughput are lists of numbers") from None
    if wavelength.shape != throughput.shape:
        raise place.fail(f"has {throughput.size} values of throughput for {wavelength.size} of wavelength")
    return checked_curve(name, wavelength, throughput, place)


def _name_of(given: str | FilterCurve) -> str:
    return given.name if isinstance(given, FilterCurve) else given


def _curve_document(given: str | FilterCurve) -> dict[str, Any]:
    """The table of a filter in a plan: nothing for one that is built in."""
    if isinstance(given, str):
        return {}
    return {
        "wavelength": np.asarray(given.wavelength).tolist(),
        "throughput": np.asarray(given.throughput).tolist(),
    }


# ------------------------------------------------------------------------------------------------------- plans as files


def is_plan(path: PathLike) -> bool:
    """True for a file that is a plan by its name."""
    return Path(path).suffix.lower() == ".toml"


def read_plan(path: PathLike, instrument: PathLike | None = None) -> ObservingPlan:
    """The plan of a file; `instrument`, a name or a description file, goes before its own.

    Raises `DataError` for a file that cannot be read, for names and values that a plan does not have.
    """
    with errors_naming(path):
        return plan_of(parse_toml(read_text(path)), Path(path).parent, instrument)


def plan_of(
    content: dict[str, Any], folder: Path, instrument: PathLike | Instrument | None = None
) -> ObservingPlan:
    """The plan that the entries of a file in `folder` describe; `instrument` and errors as for `read_plan`."""
    content = dict(content)
    hints, of_stops, read = typing.get_type_hints(ObservingPlan), typing.get_type_hints(Stop), Reader("")
    check_names("entry of a plan", content, hints)
    angles, full_turn = content.get("polariser_angles", USUAL_ANGLES), content.pop("full_turn", None)
    if full_turn is not None or not isinstance(angles, list | tuple):
        content["polariser_angles"] = list(angles_of(angles, full_turn))
    hints["polariser_angles"] = tuple[float, ...]
    named = instrument_named(content, folder)
    content.pop("instrument", None)
    instrument = named if instrument is None else instrument
    stops, filters = content.pop("stops", []), content.pop("filters", None)
    values = read.values(hints, content, "")
    if filters is not None:
        if not isinstance(filters, list | dict) or any(not isinstance(entry, str) for entry in filters):
            raise read.fault("", f"filters = {filters!r} must be a list of names, or tables [filters.NAME]")
        values["filters"] = tuple(filters) if isinstance(filters, list) else filters
    for stop in stops:
        for name in stop:
            if name not in of_stops:
                position = "; where an element stands is moving = { HWP = 22.5 }" if name.isupper() else ""
                raise ValueError(f"{unknown_name('entry of a stop', name, of_stops)}{position}")
    values["stops"] = tuple(Stop(**read.values(of_stops, stop, "stops")) for stop in stops)
    if isinstance(instrument, str | os.PathLike):
        instrument = Instrument.read(instrument, elements=defined_elements())
    return ObservingPlan(instrument, **values)


def plan_of_document(document: Mapping[str, Any], instrument: Instrument) -> ObservingPlan:
    """The plan whose `document` was written, for an instrument as designed."""
    return plan_of(_entries(document), Path(), instrument)


def instrument_named(content: Mapping[str, Any], folder: Path) -> str | Path | None:
    """The instrument that a plan in `folder` names: one of the package, or the description file beside it."""
    if (name := content.get("instrument")) is None:
        return None
    beside = folder / str(name)
    return beside if beside.suffix == ".toml" else str(name)


def plan_text(plan: ObservingPlan, described: str | None = None) -> str:
    """A plan as the text of a file that `read_plan` reads.

    An instrument of one's own goes by its name, or by the file beside the plan in which it is `described`.
    """
    return tomlkit.dumps(_entries(plan.document() | ({"instrument": described} if described else {})))


def _entries(document: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of the file of a plan."""
    unused = {"polariser_angles"} if document.get("stops") else set()  # every exposure says its own
    return {
        name: _written(value) for name, value in document.items() if value is not None and name not in unused
    }


def _written(value: Any) -> Any:
    """Lists and tables as TOML has them, OUT for elements that are out."""
    if isinstance(value, Mapping):
        return {name: _written(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_written(entry) for entry in value]
    return OUT if value is None else value

"""The plain records that a calibration set becomes once it has been read and checked."""

from __future__ import annotations

import dataclasses
import enum
import functools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from walop_jax.data.kinds import CALIBRATION_PLATE, KINDS, POLARISER, PREFIX
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import nearest
from walop_jax.io.plain_tables import astropy_table

SAMPLED_TOGETHER = 64  # neighbouring field points that a sample takes together
SPOT = 8.0  # standard errors from which a patch of the field holds structure of its own
ROUNDING = 1e-10  # mean square gain of the rounding of numbers without noise
FINE = 4.0  # standard errors from which the whole field holds structure


class DataFlag(enum.IntFlag):
    """Bits of FLAG of an intensity: any of them keeps it from being used."""

    SATURATED = 1
    BAD_PIXEL = 2
    EDGE_OR_VIGNETTED = 4
    BLENDED = 8
    GHOST = 16

    @property
    def meaning(self) -> str:
        """The name of a bit in words."""
        return str(self.name).lower().replace("_", " ")


@dataclasses.dataclass(frozen=True)
class Site:
    """Place of the telescope. `latitude` and `longitude` in degrees (east positive), `elevation` in metres."""

    telescope: str
    latitude: float
    longitude: float
    elevation: float

    @property
    def known(self) -> bool:
        """True if all three numbers are finite."""
        return bool(np.isfinite([self.latitude, self.longitude, self.elevation]).all())


class ErrorWord(NamedTuple):
    """One number of `StatedErrors`: its word in a primary header, its unit, its usual size, and what it is the error
    of.
    """

    word: str
    unit: str
    usual: float
    about: str


ERROR_WORDS: Mapping[str, ErrorWord] = {
    "position": ErrorWord("POS_ERR", "arcsec", 1.0, "X and of Y, common to all field points"),
    "scale": ErrorWord("SCAL_ERR", "", 1e-3, "the scale of X and Y, a fraction"),
    "turn": ErrorWord("TURN_ERR", "rad", 1e-3, "the angle by which the field is turned"),
    "wavelength": ErrorWord(
        "WAVE_ERR", "um", 3e-3, "the wavelengths of a filter curve, common to all of them"
    ),
    "teff": ErrorWord("TEFF_ERR", "", 0.05, "TEFF, a fraction, common to all exposures of a KIND"),
    "pointing": ErrorWord("RA_ERR", "arcsec", 60.0, "RA and of DEC of sky exposures, common to all of them"),
    "time": ErrorWord("MJD_ERR", "s", 1.0, "MJD of sky exposures, common to all of them"),
    "site": ErrorWord("SITE_ERR", "deg", 0.01, "SITELAT and of SITELONG"),
    "rotator": ErrorWord("ROT_ERR", "deg", 0.1, "ROTATOR, common to all exposures of a KIND"),
    "sky": ErrorWord("SKY_ERR", "", 0.02, "SKY, a fraction, common to all intensities"),
    "linearity": ErrorWord(
        "LIN_ERR", "", 0.02, "N of one camera, a fraction at 10⁶ electrons that grows with N"
    ),
    "scattered": ErrorWord(
        "SCAT_ERR", "", 3e-3, "N of one camera, a fraction of its median counts in every exposure"
    ),
    "pedestal": ErrorWord(
        "BIAS_ERR", "", 3e-3, "N of one camera, a fraction of the usual counts, the same everywhere"
    ),
    "leakage": ErrorWord("LEAK_ERR", "", 0.02, "N of one camera, a fraction of the light of another camera"),
}
"""The words of a primary header by the fields of `StatedErrors`."""


def _usual(name: str) -> Any:
    return dataclasses.field(default=ERROR_WORDS[name].usual)


@dataclasses.dataclass(frozen=True)
class StatedErrors:
    """Standard errors of the numbers that a set states, each of a systematic error that all of them have in common.

    They say which errors to reckon with where the data would not show them. The search for an error is not limited
    by them: one that is far larger is found all the same. Units and usual sizes are those of `ERROR_WORDS`: what is
    left of an astrometric solution, of the clock of a computer, of a measured filter curve. 0: known exactly.

    Raises ValueError for a number that is no error.
    """

    position: float = _usual("position")
    scale: float = _usual("scale")
    turn: float = _usual("turn")
    wavelength: float = _usual("wavelength")
    teff: float = _usual("teff")
    pointing: float = _usual("pointing")
    time: float = _usual("time")
    site: float = _usual("site")
    rotator: float = _usual("rotator")
    sky: float = _usual("sky")
    linearity: float = _usual("linearity")
    scattered: float = _usual("scattered")
    pedestal: float = _usual("pedestal")
    leakage: float = _usual("leakage")

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                word = ERROR_WORDS[name]
                what = f"stated_errors: {name} = {value:g}, the error of {word.about}, is to be 0 or more"
                raise ValueError(f"{what}{f', in {word.unit}' if word.unit else ''}")

    def __repr__(self) -> str:
        told = ", ".join(f"{name}={value:g}" for name, value in self.stated.items())
        return f"{type(self).__name__}({told})"

    @property
    def stated(self) -> dict[str, float]:
        """The errors that differ from the usual ones, by name."""
        return {n: v for n, v in dataclasses.asdict(self).items() if v != ERROR_WORDS[n].usual}

    @classmethod
    def of(cls, given: Mapping[str, float]) -> StatedErrors:
        """The usual errors with some replaced; ValueError, with the nearest names, for a name that does not exist."""
        for name in given:
            if name not in ERROR_WORDS:
                raise ValueError(f"stated_errors: there is none of {name!r}; {nearest(name, ERROR_WORDS)}")
        return cls(**given)

    @classmethod
    def largest(cls, given: Iterable[StatedErrors]) -> StatedErrors:
        """For each number the largest of the errors given."""
        columns = zip(*(dataclasses.astuple(entry) for entry in given), strict=True)
        return cls(*map(max, columns))


@dataclasses.dataclass(frozen=True)
class FilterCurve:
    """Throughput of a filter against wavelength (µm, ascending); one wavelength means monochromatic.

    >>> walop.FilterCurve("V", np.array([0.50, 0.55, 0.60]), np.array([0.1, 0.8, 0.1]))
    FilterCurve('V', 0.5 to 0.6 µm)
    """

    name: str
    wavelength: Float[np.ndarray, " n"]
    throughput: Float[np.ndarray, " n"]

    def __repr__(self) -> str:
        return f"FilterCurve({self.name!r}, {np.min(self.wavelength):g} to {np.max(self.wavelength):g} µm)"


@dataclasses.dataclass(frozen=True)
class Position:
    """What a moving element does in every exposure (e): whether it is in the beam, and at what angle.

    `angle` is the encoder reading in degrees at mid-exposure, NaN where the element is out; `turn` is the angle (deg)
    by which it turns during the exposure, evenly in time (0, or None for all exposures: it stands still).
    """

    inside: Bool[np.ndarray, " e"]
    angle: Float[np.ndarray, " e"]
    turn: Any = None

    def __post_init__(self) -> None:
        turn = 0.0 if self.turn is None else np.abs(self.turn)
        object.__setattr__(self, "turn", np.where(self.inside, turn, 0.0))

    def __len__(self) -> int:
        return len(self.inside)

    def __getitem__(self, rows: slice | Int[np.ndarray, " r"] | Bool[np.ndarray, " e"]) -> Position:
        return Position(self.inside[rows], self.angle[rows], self.turn[rows])

    @classmethod
    def at(cls, angles: Iterable[float | None]) -> Position:
        """An element in the beam at these angles (deg), out of it where they are NaN or None."""
        angle = np.array([np.nan if a is None else a for a in angles], float)
        return cls(np.isfinite(angle), angle)

    @classmethod
    def out(cls, exposures: int) -> Position:
        """An element that is out of the beam throughout."""
        return cls(np.zeros(exposures, dtype=bool), np.full(exposures, np.nan))


@dataclasses.dataclass(frozen=True)
class Exposures:
    """One entry per exposure; angles in degrees, NaN where a quantity has no meaning.

    `mjd` UTC days at mid-exposure, `exptime` s, `temp` Celsius, `ha` hours, `teff` K (NaN: flat photon
    spectrum), `rotator` the position angle of ICS +X (north through east). `positions` holds the moving elements by
    column prefix; polariser and calibration plate come first, out of the beam where they are not given.

    Raises ValueError for a prefix that cannot be one, an element with another number of exposures, and one that
    is in the beam without an angle.
    """

    exposure: Int[np.ndarray, " e"]
    kind: Shaped[np.ndarray, " e"]
    mjd: Float[np.ndarray, " e"]
    exptime: Float[np.ndarray, " e"]
    filter: Shaped[np.ndarray, " e"]
    temp: Float[np.ndarray, " e"]
    ha: Float[np.ndarray, " e"]
    ra: Float[np.ndarray, " e"]
    dec: Float[np.ndarray, " e"]
    rotator: Float[np.ndarray, " e"]
    teff: Float[np.ndarray, " e"]
    positions: Mapping[str, Position] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        everywhere = {prefix: Position.out(len(self)) for prefix in (POLARISER, CALIBRATION_PLATE)}
        object.__setattr__(self, "positions", {**everywhere, **self.positions})
        for prefix, position in self.positions.items():
            if not PREFIX.fullmatch(prefix):
                form = "capital letters, digits and _, a letter first"
                raise ValueError(f"{prefix!r} cannot be the prefix of a moving element: {form}")
            if len(position) != len(self):
                raise ValueError(f"{prefix} has {len(position)} positions for {len(self)} exposures")
            if not np.all(np.isfinite(position.angle[position.inside])):
                raise ValueError(f"{prefix} is in the beam without an angle")

    def __len__(self) -> int:
        return len(self.exposure)

    def __repr__(self) -> str:
        kinds, counts = np.unique(self.kind, return_counts=True)
        of_kinds = ", ".join(f"{count} {kind}" for kind, count in zip(kinds, counts, strict=True))
        dated = self.mjd[np.isfinite(self.mjd)]
        time = f", MJD {dated.min():.2f} to {dated.max():.2f}" if dated.size else ""
        moving = ", ".join(prefix for prefix, at in self.positions.items() if at.inside.any())
        filters = ", ".join(map(str, np.unique(self.filter)))
        return f"Exposures: {of_kinds or 'none'}; {filters}{time}; in the beam: {moving or 'nothing'}"

    def __getitem__(self, rows: slice | Int[np.ndarray, " r"] | Bool[np.ndarray, " e"]) -> Exposures:
        return Exposures(
            **{name: values[rows] for name, values in self._plain().items()},
            positions={prefix: position[rows] for prefix, position in self.positions.items()},
        )

    @property
    def clp_in(self) -> Bool[np.ndarray, " e"]:
        """True where the polariser is in the beam."""
        return self.positions[POLARISER].inside

    @property
    def clp_angle(self) -> Float[np.ndarray, " e"]:
        """Angle of the polariser (deg), NaN where it is out."""
        return self.positions[POLARISER].angle

    @property
    def further(self) -> dict[str, Position]:
        """The moving elements beyond polariser and calibration plate."""
        return {p: at for p, at in self.positions.items() if p not in (POLARISER, CALIBRATION_PLATE)}

    @property
    def flux_known(self) -> Bool[np.ndarray, " e"]:
        """True in exposures of a KIND of known flux."""
        return np.isin(self.kind, [name for name, kind in KINDS.items() if kind.flux_known])

    def direct(self, *kinds: str) -> Bool[np.ndarray, " e"]:
        """True in exposures of some KINDs that are not taken through the polariser."""
        return np.isin(self.kind, kinds) & ~self.clp_in

    def position(self, prefix: str) -> Position:
        """The moving element of a column prefix; ValueError with the nearest names for one that is not there."""
        if prefix in self.positions:
            return self.positions[prefix]
        advice = f"give {prefix}_IN and {prefix}_ANGLE, in an observing plan moving = {{ {prefix} = [0, 22.5, 45] }}"
        like = f"; {nearest(prefix, self.further)}" if self.further else ""
        raise ValueError(f"the exposures have no moving element {prefix!r}: {advice}{like}")

    def placed(self, **positions: Position) -> Exposures:
        """The exposures with moving elements, by column prefix, at other positions."""
        return dataclasses.replace(self, positions={**self.positions, **positions})

    def columns(self) -> dict[str, np.ndarray]:
        """All columns by their names in EXPOSURES, those of moving elements last."""
        columns = {name.upper(): values for name, values in self._plain().items()}
        for prefix, entry in self.positions.items():
            columns |= {f"{prefix}_IN": entry.inside, f"{prefix}_ANGLE": entry.angle}
            if entry.turn.any():
                columns[f"{prefix}_TURN"] = entry.turn
        return columns

    @classmethod
    def from_columns(cls, columns: Mapping[str, np.ndarray]) -> Exposures:
        """Exposures from all columns by their names in EXPOSURES: the inverse of `columns`."""
        plain = {field.name.upper() for field in dataclasses.fields(cls)} - {"POSITIONS"}
        prefixes = [name.removesuffix("_IN") for name in columns if name.endswith("_IN")]
        states = ((columns[f"{p}_IN"], columns[f"{p}_ANGLE"], columns.get(f"{p}_TURN")) for p in prefixes)
        positions = {p: Position(*state) for p, state in zip(prefixes, states, strict=True)}
        return cls(**{name.lower(): columns[name] for name in plain}, positions=positions)

    def _plain(self) -> dict[str, np.ndarray]:
        names = [field.name for field in dataclasses.fields(self) if field.name != "positions"]
        return {name: getattr(self, name) for name in names}


@dataclasses.dataclass(frozen=True)
class Points:
    """Field points: `point` the identifier, `x` and `y` in degrees in the instrument frame."""

    point: Int[np.ndarray, " p"]
    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.point)

    def __repr__(self) -> str:
        if not len(self):
            return "Points: none"
        x, y = (f"{name} {v.min():+.3f} to {v.max():+.3f}°" for name, v in (("X", self.x), ("Y", self.y)))
        return f"Points: {len(self)} field points, {x}, {y}"


@dataclasses.dataclass(frozen=True)
class Sources:
    """Standard stars: catalogue `q`, `u` and their errors in the equatorial frame, `teff` in K (or NaN).

    `filter` is the band of a value, "" where the catalogue does not state it (None: nowhere). A star with values in
    several bands has a row for each, with one number `source`; its first row stands for it wherever a star is meant. A
    row may be a field of stars, which differ from its `q`, `u` by `scatter` (rms of each).
    """

    source: Int[np.ndarray, " s"]
    name: Shaped[np.ndarray, " s"]
    q: Float[np.ndarray, " s"]
    u: Float[np.ndarray, " s"]
    q_err: Float[np.ndarray, " s"]
    u_err: Float[np.ndarray, " s"]
    teff: Float[np.ndarray, " s"]
    filter: Shaped[np.ndarray, " s"] = None  # pyright: ignore[reportAssignmentType]
    scatter: Float[np.ndarray, " s"] = None  # pyright: ignore[reportAssignmentType]

    def __post_init__(self) -> None:
        if self.scatter is None:
            object.__setattr__(self, "scatter", np.zeros(len(self.source)))
        if self.filter is None:
            object.__setattr__(self, "filter", np.full(len(self.source), "", dtype="U1"))

    def __len__(self) -> int:
        return len(self.source)

    @classmethod
    def none(cls) -> Sources:
        """A table without sources."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0, dtype="U1"), *[np.zeros(0)] * 5)

    @property
    def stars(self) -> Int[np.ndarray, " s"]:
        """For each row the first row of its star."""
        _, first, number = np.unique(self.source, return_index=True, return_inverse=True)
        return first[number]

    def columns(self) -> dict[str, np.ndarray]:
        """The columns of SOURCES; FILTER and SCATTER only where there is any."""
        names = [field.name for field in dataclasses.fields(self)]
        absent = {"filter": not (self.filter != "").any(), "scatter": not self.scatter.any()}
        return {name.upper(): getattr(self, name) for name in names if not absent.get(name)}


Arrays = TypeVar("Arrays")


def _one_after_the_other(kind: type[Arrays], parts: Sequence[Arrays]) -> Arrays:
    """A record whose arrays are the arrays of all `parts`, joined along their first axis."""
    names = [field.name for field in dataclasses.fields(kind)]  # pyright: ignore[reportArgumentType]
    return kind(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclasses.dataclass(frozen=True)
class Block:
    """Intensities of some field points in all exposures, dense: the input of the likelihood.

    `counts` and `sigma` in electrons, camera by camera; `used` is False where there is no measurement, or a
    flagged or unusable one (counts 0 and sigma 1 stand there). `source` is a row of `Sources`, -1 for none.
    """

    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    counts: Float[np.ndarray, "p e k"]
    sigma: Float[np.ndarray, "p e k"]
    used: Bool[np.ndarray, "p e"]
    source: Int[np.ndarray, "p e"]

    @classmethod
    def joined(cls, blocks: Sequence[Block]) -> Block:
        """The field points of some blocks, one after the other."""
        return _one_after_the_other(cls, blocks)


@dataclasses.dataclass(frozen=True)
class InputFile:
    """A file that went into a result: where it was and the SHA-256 of its bytes."""

    path: Path
    sha256: str


@dataclasses.dataclass(frozen=True, eq=False)
class FineStructure:
    """Structure in whole frames that is finer than their cells, in patches of the field at `x`, `y` (degrees).

    `gain` is the mean square, over the pixels of a patch, of the relative gain of a camera against its surroundings, as
    far as exposures agree on it; chance can make it negative. `error` is the standard error that it has without any
    structure. Patches of several files stand one after the other.
    """

    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    gain: Float[np.ndarray, "n k"]
    error: Float[np.ndarray, "n k"]

    @classmethod
    def joined(cls, parts: Sequence[FineStructure]) -> FineStructure:
        """The patches of several files."""
        return _one_after_the_other(cls, parts)

    @functools.cached_property
    def _usual(self) -> tuple[float, float]:
        """Mean square gain of patches without spots, and its standard error."""
        deviate = self.gain / self.error
        middle = float(np.median(deviate)) if deviate.size else 0.0
        spread = max(1.0, 1.4826 * float(np.median(np.abs(deviate - middle)))) if deviate.size else 1.0
        weight = np.where(np.abs(deviate - middle) < SPOT * spread, self.error**-2.0, 0.0)
        total = float(weight.sum())
        return (
            (float(np.sum(weight * self.gain)) / total, spread * total**-0.5) if total > 0 else (0.0, np.inf)
        )

    @property
    def everywhere(self) -> float:
        """Rms gain of the pixels of the whole field, spots left out; 0 where noise makes as much."""
        mean, error = self._usual
        return float(np.sqrt(mean)) if mean > FINE * error else 0.0

    @property
    def spots(self) -> Int[np.ndarray, "s 2"]:
        """Patches (row) and cameras that have far more than the field usually has, the clearest first."""
        mean, _ = self._usual
        deviate = (self.gain - max(mean, 0.0)) / self.error
        found = np.argwhere((deviate > SPOT) & (self.gain > ROUNDING))
        return found[np.argsort(-deviate[tuple(found.T)])]


@dataclasses.dataclass(frozen=True, repr=False)
class CalibrationSet(Displayed):
    """A calibration set, read and checked; numbers have the units of the docstrings.

    `intensities` gives the data of a slice of the points. In a set that was made of whole frames, `fine` is the
    structure that is finer than its cells, and `cells` how many cells along their longer side were asked for.
    `stated_errors` are the errors of the numbers of the set.

    >>> calset.instrument, len(calset.exposures), len(calset.points)
    ('WALOP-SOUTH', 14, 29)
    """

    instrument: str
    site: Site
    origin: str
    exposures: Exposures
    points: Points
    sources: Sources
    filters: Mapping[str, FilterCurve]
    intensities: Intensities
    inputs: tuple[InputFile, ...] = ()
    remarks: tuple[str, ...] = ()
    fine: FineStructure | None = None
    cells: int | None = None
    stated_errors: StatedErrors = StatedErrors()

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return self.intensities.cameras

    def display(self) -> Display:
        """What was observed: exposures by KIND, field points, standards, filters, remarks."""
        e, points = self.exposures, self.points
        kinds = ", ".join(f"{number} {kind}" for kind, number in Counter(e.kind.tolist()).items())
        x, y = (f"{values.min():+.3f} … {values.max():+.3f}°" for values in (points.x, points.y))
        facts = {
            "from": ", ".join(str(entry.path) for entry in self.inputs) or self.origin or "memory",
            "exposures": f"{len(e)} ({kinds})",
            "field points": f"{len(points)}, X {x}, Y {y}",
            "cameras": str(self.cameras),
            "filters": ", ".join(sorted({str(name) for name in e.filter})),
            "standards": ", ".join(str(name) for name in self.sources.name) or "none",
        }
        return Display(f"Calibration set of {self.instrument}", tuple(facts.items()), notes=self.remarks)

    def to_arrays(self) -> dict[str, Any]:
        """The set as arrays: `from_arrays(**calset.to_arrays())` is the same set; NaN where nothing was measured.

        `counts` and `errors` (point, exposure, camera) are electrons, `x`, `y` and `angles` degrees.

        >>> arrays = calset.to_arrays()
        >>> arrays["counts"].shape == (len(calset.points), len(calset.exposures), calset.cameras)
        True
        """
        block, e = self.intensities.block(0, len(self.points)), self.exposures
        used, level, table = block.used[:, :, None], None, cast("Any", self.intensities)
        if getattr(table, "sky", None) is not None:  # of a table with the column SKY
            level = np.zeros(block.counts.shape)
            level[table.point, table.exposure] = table.sky
        others = ("EXPOSURE", "KIND", "CLP_IN", "CLP_ANGLE")
        columns = {name.lower(): values for name, values in e.columns().items() if name not in others}
        stars = {f.name.upper(): getattr(self.sources, f.name) for f in dataclasses.fields(Sources)}
        return {
            "counts": np.where(used, block.counts, np.nan),
            "errors": np.where(used, block.sigma, np.nan),
            "x": block.x,
            "y": block.y,
            "angles": np.where(e.clp_in, e.clp_angle, np.nan),
            "kinds": e.kind,
            "sky": level,
            "source": np.where(block.source >= 0, np.append(self.sources.source, -1)[block.source], -1),
            **columns,
            "instrument": self.instrument,
            "site": self.site,
            "filters": dict(self.filters),
            "sources": stars if len(self.sources) else None,
            "origin": self.origin,
            "fine": self.fine,
            "stated_errors": self.stated_errors.stated,
        }

    def to_table(self) -> Any:
        """The exposures as an astropy table, with the columns of EXPOSURES."""
        columns = self.exposures.columns()
        angles = [name for name in columns if name.endswith(("_ANGLE", "_TURN"))]
        units = dict.fromkeys((*angles, "RA", "DEC", "ROTATOR"), "deg")
        units |= {"MJD": "d", "EXPTIME": "s", "TEMP": "Celsius", "HA": "h", "TEFF": "K"}
        return astropy_table({name: (values, units.get(name, ""), "") for name, values in columns.items()})


class Intensities:
    """The intensities of every (exposure, point): a table, or any other source.

    `block` must be pure and may be called from several threads. It counts field points as `CalibrationSet.points` does,
    and exposures as `CalibrationSet.exposures`.
    """

    def block(self, start: int, stop: int) -> Block:
        """Return the data of the field points `start:stop`, dense in the exposures."""
        raise NotImplementedError

    @property
    def cameras(self) -> int:
        """Number of cameras. This default reads one point; the classes of the package know it without reading."""
        return self.block(0, 1).counts.shape[-1]

    @property
    def rows(self) -> int:
        """Number of used rows, that is of (exposure, point) pairs with a good intensity in every camera."""
        raise NotImplementedError


def sampled(intensities: Intensities, total: int, most: int) -> tuple[Int[np.ndarray, " p"], Block]:
    """At most `most` of the `total` field points of a set, in evenly spaced blocks of neighbours, and their data."""
    if total <= most:
        return np.arange(total), intensities.block(0, total)
    starts = np.linspace(0, total - SAMPLED_TOGETHER, most // SAMPLED_TOGETHER).astype(int)
    blocks = [intensities.block(start, start + SAMPLED_TOGETHER) for start in starts.tolist()]
    return (starts[:, None] + np.arange(SAMPLED_TOGETHER)).ravel(), Block.joined(blocks)

"""Optical settings, for which the optics of an instrument are computed at a field point; built-in filters."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from walop_jax.data.records import Exposures, FilterCurve
from walop_jax.io.errors import fail, nearest

DEFAULT_FILTER = "SDSS-r"
"""Filter of an exposure without a FILTER."""

_TABLES = {"SDSS-r": "sdss_r.csv"}
"""Files beside this one. The WALOP filters are custom: the survey's curve is where one starts."""

BUILTIN_FILTERS = tuple(_TABLES)
"""Names that `builtin_filter` knows, single wavelengths (`single_wavelength`) apart."""

PHOTOMETRIC_BANDS: Mapping[str, tuple[float, float]] = {
    "U": (0.3663, 0.0650), "B": (0.4361, 0.0890), "V": (0.5448, 0.0840), "R": (0.6407, 0.1580), "I": (0.7980, 0.1540),
}  # fmt: skip
"""Bands of catalogues: effective wavelength and full width at half maximum (µm) of the Johnson–Cousins system.

Source: Bessell 2005, ARA&A 43, 293, Table 1.
"""

_SINGLE = re.compile(r"MONO-(\d{3,6}(?:\.\d+)?)")


def single_wavelength(name: str) -> float | None:
    """Wavelength (µm) of light called MONO-<Ångström>; None: another name."""
    match = _SINGLE.fullmatch(name)
    return None if match is None else 1e-4 * float(match[1])


_BETWEEN = re.compile(r"[\s_-]+")
_TELLING = 3  # letters from which on case tells nothing: R and r are two filters


def same_filters(name: str, names: Iterable[str]) -> list[str]:
    """Names among `names` that mean the filter `name`: itself, else all that differ in case, blanks and dashes alone.

    Case counts in names with fewer than three letters and digits.

    >>> same_filters("sdss r", ["SDSS-r", "SDSS-i"]), same_filters("r", ["R"])
    (['SDSS-r'], [])
    """
    known = list(dict.fromkeys(map(str, names)))
    return [name] if name in known else [other for other in known if _letters(other) == _letters(name)]


def _letters(name: str) -> str:
    plain = _BETWEEN.sub("", name)
    return plain.lower() if len(plain) >= _TELLING else plain


def builtin_filter(name: str) -> FilterCurve:
    """Return a built-in filter curve by name; wavelength in µm.

    `SDSS-r` is the r curve of the SDSS camera as measured by Doi et al. 2010, AJ 139, 1628, Table 4, for an
    airmass of 1.3. The curve counts photons: it is the fraction of the photons at each wavelength that is detected.

    `MONO-6500` is light of 6500 Å alone, and so on. Raises `DataError` with the nearest names if there is no such
    filter.
    """
    wavelength = single_wavelength(name)
    if wavelength is not None:
        return FilterCurve(name=name, wavelength=np.array([wavelength]), throughput=np.ones(1))
    if name not in _TABLES:
        advice = f"add it to the FILTERS table; {nearest(name, (*BUILTIN_FILTERS, 'MONO-6500'))}"
        raise fail(f"no built-in filter is called {name!r}", advice=advice)
    table = Path(__file__).with_name(_TABLES[name])
    wavelength, throughput = np.loadtxt(table, delimiter=",", unpack=True, encoding="utf-8")
    return FilterCurve(name=name, wavelength=wavelength * 1e-4, throughput=throughput.copy())


RowSelection = slice | Int[np.ndarray, " r"] | Bool[np.ndarray, " n"]

TEMPERATURE = 10.0
"""Temperature of the instrument (Celsius) where nothing is said of it."""


def nearest_hours(hour_angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Hour angles (h) from −12 to 12: 23.5 h is half an hour before the meridian. A missing one is 0."""
    hours = np.nan_to_num(hour_angle)
    return np.where(np.abs(hours) > 12.0, (hours + 12.0) % 24.0 - 12.0, hours)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Optical settings, one per row (n).

    A row is the name of a filter; the colour temperature of the source (K; NaN: flat photon spectrum); the temperature
    of the instrument (Celsius); the hour angle (h); and `positions` of the moving elements behind the polariser by
    column prefix (deg; NaN: out). `turns` holds, for elements that turn during the exposure, by how much (deg, about
    that position). An element without a position is out of the beam. Raises ValueError for columns of different
    lengths.

    >>> walop.Settings.default(2).at(CHWP=22.5).positions
    {'CHWP': array([22.5, 22.5])}
    """

    filter: Shaped[np.ndarray, " n"]
    teff: Float[np.ndarray, " n"]
    temperature: Float[np.ndarray, " n"]
    hour_angle: Float[np.ndarray, " n"]
    positions: Mapping[str, Float[np.ndarray, " n"]] = dataclasses.field(default_factory=dict)
    turns: Mapping[str, Float[np.ndarray, " n"]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        lengths = sorted({len(values) for values in (*self._plain(), *self._moved())})
        if len(lengths) > 1:
            raise ValueError(f"columns of {' and '.join(map(str, lengths))} rows in one table of settings")

    @classmethod
    def default(cls, count: int, filter_name: str = DEFAULT_FILTER) -> Settings:
        """Settings with SDSS-r, a flat photon spectrum, all moving elements out, 10 °C, on the meridian."""
        teff, temperature = np.full(count, np.nan), np.full(count, TEMPERATURE)
        return cls(np.full(count, filter_name), teff, temperature, hour_angle=np.zeros(count))

    @classmethod
    def of(cls, exposures: Exposures, moving: Iterable[str]) -> Settings:
        """The settings of exposures, for an instrument with the moving elements `moving` behind its polariser.

        A missing temperature is taken as in `default`, a missing hour angle as 0. Raises ValueError for a moving
        element of which the exposures say nothing.
        """
        positions = {prefix: exposures.position(prefix) for prefix in moving}
        return cls(
            filter=exposures.filter,
            teff=exposures.teff,
            temperature=np.where(np.isfinite(exposures.temp), exposures.temp, TEMPERATURE),
            hour_angle=nearest_hours(exposures.ha),
            positions={p: np.where(entry.inside, entry.angle, np.nan) for p, entry in positions.items()},
            turns={p: entry.turn for p, entry in positions.items() if entry.turn.any()},
        )

    def at(self, **positions: float | Float[np.ndarray, " n"] | None) -> Settings:
        """These settings with moving elements at other angles (deg, by column prefix; None or NaN: out)."""
        angles = {
            prefix: np.broadcast_to(np.asarray(np.nan if angle is None else angle, float), len(self)).copy()
            for prefix, angle in positions.items()
        }
        return dataclasses.replace(self, positions={**self.positions, **angles})

    def __len__(self) -> int:
        return len(self.teff)

    def __getitem__(self, rows: RowSelection) -> Settings:
        return Settings(
            *(values[rows] for values in self._plain()),
            positions={prefix: angle[rows] for prefix, angle in self.positions.items()},
            turns={prefix: turn[rows] for prefix, turn in self.turns.items()},
        )

    def _plain(self) -> tuple[np.ndarray, ...]:
        return self.filter, self.teff, self.temperature, self.hour_angle

    def _moved(self) -> tuple[np.ndarray, ...]:
        return *self.positions.values(), *self.turns.values()

    def position(self, prefix: str) -> Float[np.ndarray, " n"]:
        """Angle of a moving element (deg; NaN: out)."""
        return self.positions.get(prefix, np.full(len(self), np.nan))

    def inside(self) -> dict[str, float]:
        """Angles (deg) of the elements in the beam, of a single row."""
        return {prefix: float(angle.item()) for prefix, angle in self.positions.items() if np.isfinite(angle)}

    def check_moving(self, moving: Iterable[str]) -> None:
        """Raise ValueError, with the nearest names, for an element in the beam that is none of `moving`."""
        elements = tuple(moving)
        for prefix, angle in self.positions.items():
            if prefix not in elements and np.isfinite(angle).any():
                what = f"{prefix}_ANGLE is given, but the instrument has no moving element {prefix!r}"
                raise ValueError(f"{what}; {nearest(prefix, elements)}")

    # ----------------------------------------------------------------------------------- rows that agree

    def layouts(self) -> list[tuple[Settings, Int[np.ndarray, " r"]]]:
        """One setting for each combination of filter and positions, and the rows that have it.

        Only these decide how a computation is laid out; the rest are numbers that go into it.
        """
        return self._grouped([self.filter, *self._moved()])

    def optics(self) -> list[tuple[Settings, Int[np.ndarray, " r"]]]:
        """One setting for each that makes the optics differ, colour of the source apart, and the rows that have it."""
        return self._grouped([self.filter, *self._moved(), self.temperature, self.hour_angle])

    def distinct(self) -> list[tuple[Settings, Int[np.ndarray, " r"]]]:
        """Each distinct setting once, with the rows that have it."""
        return self._grouped([*self._plain(), *self._moved()])

    def _grouped(self, columns: list[np.ndarray]) -> list[tuple[Settings, Int[np.ndarray, " r"]]]:
        number = np.zeros(len(self), int)
        for column in columns:
            values, code = np.unique(column, return_inverse=True)
            _, number = np.unique(number * len(values) + code.reshape(-1), return_inverse=True)
        order = np.argsort(number, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(self) else []
        return [(self[rows[:1]], rows) for rows in groups]

    @property
    def key(self) -> tuple[object, ...]:
        """Key that distinguishes the optics of a single row; ValueError for several rows."""
        if len(self) != 1:
            raise ValueError(f"one setting is asked for, {len(self)} are given")
        turns = sorted((prefix, float(turn.item())) for prefix, turn in self.turns.items() if turn.any())
        inside = (*sorted(self.inside().items()), *turns)
        return (str(self.filter[0]), inside, float(self.temperature[0]), float(self.hour_angle[0]))

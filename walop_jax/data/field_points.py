"""Tables of field points: where, and under which optical settings, something is asked of an instrument."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Mapping, Sized
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.filters import DEFAULT_FILTER
from walop_jax.data.schema import Column, Place
from walop_jax.data.settings import TEMPERATURE, Settings
from walop_jax.data.user_tables import InputTable, numeric_column, read_input_table
from walop_jax.io.errors import fail, rows_text

_NAN = float("nan")
_SINGLE = 1  # point: it may lie outside without a doubt about its unit
POINT_COLUMNS: Mapping[str, Column] = {
    "X": Column("float", "deg"),
    "Y": Column("float", "deg"),
    "TEFF": Column("float", "K", _NAN),
    "FILTER": Column("str", missing=DEFAULT_FILTER),
    "TEMP": Column("float", "Celsius", TEMPERATURE),
    "HA": Column("float", "h", 0.0),
}


@runtime_checkable
class InstrumentOfTables(Protocol):
    """What a table must know of the instrument that it is for; the field reaches to ±`field_limit` (deg)."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def field_limit(self) -> float:
        """Largest |X|, |Y| (deg)."""
        ...

    @property
    def cameras(self) -> Sized:
        """Its cameras."""
        ...

    @property
    def arms(self) -> Sized:
        """Its arms."""
        ...

    def moving(self) -> tuple[str, ...]:
        """Column prefixes of its moving elements behind the polariser."""
        ...


@dataclasses.dataclass(frozen=True)
class FieldPoints:
    """Where, and under which optical settings, an instrument matrix is asked for.

    `x`, `y` in degrees; `outside` marks points beyond the field of the instrument.
    """

    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    settings: Settings
    outside: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.x)


def field_points(
    source: InputTable, instrument: InstrumentOfTables, always_in: Collection[str] = ()
) -> FieldPoints:
    """The X, Y and optional settings of a table of field points of an instrument.

    A moving element has the columns `<P>_ANGLE` and `<P>_IN`; without the latter it is in the beam where it has an
    angle. The elements `always_in` (column prefixes) must have an angle. Single points outside the field are marked; if
    most of them lie outside, the unit must be wrong.

    Raises `DataError` naming file, column and row for anything that cannot be meant.
    """
    place = Place(source.path, "")
    columns = {name: numeric_column(source, name, rule) for name, rule in POINT_COLUMNS.items()}
    x, y, teff = (columns[name] for name in ("X", "Y", "TEFF"))

    def refuse(bad: np.ndarray, what: str, column: str, advice: str) -> None:
        if np.any(bad):
            raise place.fail(f"{what} in {rows_text(np.flatnonzero(bad))}", column, advice)

    for name in ("X", "Y", "TEMP", "HA"):
        refuse(~np.isfinite(columns[name]), "is not finite", name, "correct or remove these rows")
    cold = ~np.isnan(teff) & ~((teff >= 500) & (teff < 1e6))
    refuse(cold, "is no temperature of a source", "TEFF", "give kelvin, or leave it empty: flat spectrum")
    refuse(np.abs(columns["TEMP"]) > 150, "exceeds ±150", "TEMP", "degrees Celsius: are these kelvin?")
    refuse(np.abs(columns["HA"]) > 24, "exceeds ±24", "HA", "hours: are these degrees?")
    positions = {}
    for prefix in instrument.moving():
        if prefix in always_in and f"{prefix}_ANGLE" not in source.names:
            advice = f"add it: {prefix} was in the beam in all exposures of the calibration (NaN: it is out)"
            raise place.fail("the column is missing", f"{prefix}_ANGLE", advice)
        angle = numeric_column(source, f"{prefix}_ANGLE", Column("float", "deg", _NAN))
        inside = np.isfinite(angle)
        if f"{prefix}_IN" in source.names:
            inside = numeric_column(source, f"{prefix}_IN", Column("bool", missing=False))
        missing = inside & ~np.isfinite(angle)
        refuse(missing, "is not finite", f"{prefix}_ANGLE", f"{prefix}_IN is true: give the angle")
        refuse(np.abs(angle) > 36000, "exceeds ±36000", f"{prefix}_ANGLE", "encoder readings are in degrees")
        positions[prefix] = np.where(inside, angle, np.nan)
    limit = instrument.field_limit
    outside = np.maximum(np.abs(x), np.abs(y)) > limit
    if len(x) > _SINGLE and np.mean(outside) > 0.5:
        raise place.fail(
            f"most points lie outside ±{limit:g}° of {instrument.name}: {rows_text(np.flatnonzero(outside))}",
            "X, Y",
            "field coordinates are in degrees: are these arcmin or pixels?",
        )
    settings = Settings(
        filter=columns["FILTER"],
        teff=teff,
        temperature=columns["TEMP"],
        hour_angle=columns["HA"],
        positions=positions,
    )
    return FieldPoints(x=x, y=y, settings=settings, outside=outside)


def true_matrices(
    path: str | os.PathLike[str], instrument: InstrumentOfTables
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n m"]]:
    """X, Y (deg) and M21, M22, … of a table of true matrices, three for each arm.

    Raises `DataError` for what is missing or not finite.
    """
    source = read_input_table(path)
    points = field_points(source, instrument)
    names = [f"M{arm + 2}{column}" for arm in range(len(instrument.arms)) for column in (1, 2, 3)]
    matrix = np.stack([numeric_column(source, name, Column("float")) for name in names], axis=1)
    bad = np.flatnonzero(~np.isfinite(matrix).all(axis=1))
    if bad.size:
        column = f"{names[0]} … {names[-1]}"
        raise fail(f"not finite in {rows_text(bad)}", file=path, column=column, advice="remove these rows")
    return points.x, points.y, matrix

"""The columns of the calibration tables, and the one way that a column becomes an array.

Columns go by name (FITS names know no upper and lower case). A unit that can be converted is converted;
a missing unit is that of the schema (docs: files); anything else is refused. What comes out is native-endian.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Collection, Mapping
from typing import Any, Literal

import numpy as np
from astropy import units

from walop_jax.data.records import CALIBRATION_PLATE, POLARISER, PREFIX
from walop_jax.io.errors import fail, nearest, rows_text

Kind = Literal["int", "float", "bool", "str"]

CALVERS = 2
"""Newest version of the calibration set format; a set is written in the oldest version that can hold it."""


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of a table: its kind, its unit in memory, and its value where the file lacks it.

    `missing` None means that the column is required; `width` is the number of values in a row, or None for
    as many as the file has. `shape_advice` says what a row should hold, `remarked` whether it is worth a remark
    that the column is not there.
    """

    kind: Kind
    unit: str = ""
    missing: object = None
    width: int | None = 1
    shape_advice: str = "see the file format"
    remarked: bool = True


_NAN = float("nan")
EXPOSURES: Mapping[str, Column] = {
    "EXPOSURE": Column("int"),
    "KIND": Column("str"),
    "MJD": Column("float", "d", _NAN),
    "EXPTIME": Column("float", "s", _NAN),
    "FILTER": Column("str", missing="SDSS-r"),
    "CLP_IN": Column("bool"),
    "CLP_ANGLE": Column("float", "deg", _NAN),
    "CHWP_IN": Column("bool", missing=False),
    "CHWP_ANGLE": Column("float", "deg", _NAN),
    "TEMP": Column("float", "Celsius", _NAN),
    "HA": Column("float", "h", _NAN),
    "RA": Column("float", "deg", _NAN),
    "DEC": Column("float", "deg", _NAN),
    "ROTATOR": Column("float", "deg", _NAN),
    "TEFF": Column("float", "K", _NAN),
}
POINTS: Mapping[str, Column] = {
    "POINT": Column("int"),
    "X": Column("float", "deg"),
    "Y": Column("float", "deg"),
}
_COUNTS = Column("float", "electron", width=4, shape_advice="one row holds the four cameras O1, E1, O2, E2")
INTENSITIES: Mapping[str, Column] = {
    "EXPOSURE": Column("int"),
    "POINT": Column("int"),
    "SOURCE": Column("int", missing=-1),
    "N": _COUNTS,
    "N_ERR": _COUNTS,
    "FLAG": Column("int", missing=0),
}
SOURCES: Mapping[str, Column] = {
    "SOURCE": Column("int"),
    "NAME": Column("str"),
    "Q": Column("float"),
    "U": Column("float"),
    "Q_ERR": Column("float"),
    "U_ERR": Column("float"),
    "TEFF": Column("float", "K", _NAN),
}
_PADDED = "use one length, padded with NaN"
FILTERS: Mapping[str, Column] = {
    "FILTER": Column("str"),
    "WAVELENGTH": Column("float", "um", width=None, shape_advice=_PADDED),
    "THROUGHPUT": Column("float", width=None, shape_advice=_PADDED),
}
TABLES: Mapping[str, Mapping[str, Column]] = {
    "EXPOSURES": EXPOSURES,
    "POINTS": POINTS,
    "INTENSITIES": INTENSITIES,
    "SOURCES": SOURCES,
    "FILTERS": FILTERS,
}
"""The tables of a calibration set of version 1, in the order in which they are written."""
_ANY_CAMERAS = dataclasses.replace(
    _COUNTS, width=None, shape_advice="one row holds all cameras, the same number in every row"
)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a table came from, so that every check can say so."""

    file: object
    extension: str

    def fail(self, what: str, column: str = "", advice: str = "") -> ValueError:
        """Build the error of something wrong in this table."""
        return fail(what, file=self.file, extension=self.extension, column=column, advice=advice)


def table_rules(name: str, version: int, columns: Collection[str], place: Place) -> Mapping[str, Column]:
    """The columns of a table of a calibration set of a version, where a file has `columns` (in capitals).

    From version 2 on EXPOSURES has a pair `<P>_IN`, `<P>_ANGLE` for every further moving element, need not have
    those of CLP and CHWP, and INTENSITIES has any number of cameras. Raises `DataError` for half a pair and for a
    prefix that is none.
    """
    rules = TABLES[name]
    if version == 1:
        return rules
    if name == "INTENSITIES":
        return {**rules, "N": _ANY_CAMERAS, "N_ERR": _ANY_CAMERAS}
    return {**rules, **_moving_columns(columns, place)} if name == "EXPOSURES" else rules


def _moving_columns(columns: Collection[str], place: Place) -> dict[str, Column]:
    """The columns of all moving elements: an element without any is out, one with an angle alone is always in."""
    rules: dict[str, Column] = {}
    for prefix in (POLARISER, CALIBRATION_PLATE):
        inside, angle = f"{prefix}_IN", f"{prefix}_ANGLE"
        absent = inside not in columns and angle not in columns
        rules[inside] = Column("bool", missing=False if absent else None)
        rules[angle] = Column("float", "deg", _NAN)
        if absent:
            rules |= {name: dataclasses.replace(rules[name], remarked=False) for name in (inside, angle)}
    for name in columns:
        prefix, mark, last = name.rpartition("_")
        if not mark or last not in ("IN", "ANGLE") or name in rules:
            continue
        if not PREFIX.fullmatch(prefix):
            raise place.fail(
                f"{prefix!r} is no name of a moving element",
                name,
                "letters, digits and _, a letter first; rename the column if it is none of a moving element",
            )
        inside, angle = f"{prefix}_IN", f"{prefix}_ANGLE"
        if angle not in columns:
            pairs = [entry for entry in columns if entry.endswith("_ANGLE")]
            advice = f"add it, or rename {inside} if there is no such element"
            raise place.fail(
                f"the column is missing, {inside} is there",
                angle,
                f"{advice} ({nearest(angle, pairs)})" if pairs else advice,
            )
        rules[inside] = Column("bool", missing=True, remarked=False)
        rules[angle] = Column("float", "deg")
    return rules


def column_names(hdu: Any, place: Place) -> list[str]:
    """Names of the columns of a FITS table in capitals; `DataError` if it is none or has a name twice."""
    if type(hdu).__name__ != "BinTableHDU":
        raise place.fail("is not a binary table", advice="write it as a FITS binary table")
    names = [name.upper() for name in hdu.columns.names]
    for name in names:
        if names.count(name) > 1:
            raise place.fail("the column is there twice", name, "remove or rename one of them")
    return names


def read_table(hdu: Any, schema: Mapping[str, Column], place: Place) -> tuple[dict[str, Any], list[str]]:
    """Turn a FITS table into arrays by column name, in the schema's units, and remarks on what was odd.

    Raises `DataError` for a missing, duplicated or ill-typed column, a unit that cannot be converted, and a
    table without rows.
    """
    names = column_names(hdu, place)
    for name, column in schema.items():
        if column.missing is None and name not in names:
            others = sorted(set(names) - set(schema))
            advice = f"add it{' (' + nearest(name, others) + ')' if others else ''}"
            raise place.fail("the column is missing", name, advice)
    rows = int(hdu.header["NAXIS2"])
    if rows == 0:
        raise place.fail("has no rows", advice="a calibration set needs at least one")

    remarks = [
        f"{place.file} [{place.extension}] {name}: unknown column, not used ({nearest(name, schema)})"
        for name in names
        if name not in schema
    ]
    table: dict[str, Any] = {}
    for name, column in schema.items():
        if name in names:
            index = names.index(name)
            table[name] = _read_column(hdu, index, name, column, place)
            if _is_converted(hdu.columns[index].unit, column):
                where, unit = f"{place.file} [{place.extension}] {name}", hdu.columns[index].unit.strip()
                remarks.append(f"{where}: is in {unit}, converted to {column.unit or 'a fraction'}")
        else:
            table[name] = np.full(rows, column.missing)
            if column.remarked:
                where = f"{place.file} [{place.extension}] {name}"
                remarks.append(f"{where}: no such column, {column.missing} taken")
    return table, remarks


def _read_column(hdu: Any, index: int, name: str, column: Column, place: Place) -> np.ndarray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.asarray(hdu.data.field(index))
    except (ValueError, TypeError, OSError, UnicodeError, KeyError, IndexError, Warning) as error:
        raise place.fail(f"cannot be read: {error}", name, "write the column again") from error
    if values.dtype == object or (column.width != 1 and values.ndim == 1):
        values = _rectangular(values, name, column, place)
    if column.width == 1 and values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim != (1 if column.width == 1 else 2) or (
        (column.width or 0) > 1 and values.shape[1] != column.width
    ):
        width = "any number of" if column.width is None else column.width
        raise place.fail(
            f"has shape {values.shape[1:] or '()'} in a row where {width} value(s) are needed",
            name,
            column.shape_advice,
        )
    null = hdu.columns[index].null
    if null not in (None, "") and np.issubdtype(values.dtype, np.integer) and np.any(values == int(null)):
        raise place.fail(
            f"undefined (TNULL) in {rows_text(np.unique(np.nonzero(values == int(null))[0]))}",
            name,
            "fill or remove these rows",
        )
    return _convert(values, hdu.columns[index].unit, name, column, place)


def _rectangular(values: np.ndarray, name: str, column: Column, place: Place) -> np.ndarray:
    """Bring one value per row into a column of width one, refuse arrays whose length varies."""
    if values.dtype == object:
        raise place.fail("is an array of variable length", name, column.shape_advice)
    return values[:, None] if column.width is None else values


def _convert(values: np.ndarray, unit: str | None, name: str, column: Column, place: Place) -> np.ndarray:
    strings = values.dtype.kind in "SU"
    if column.kind == "str":
        if not strings:
            raise place.fail("holds numbers where names are needed", name, "write it as a string column")
        names = np.char.strip(values.astype(str))
        if np.any(bad := [not (text.isascii() and text.isprintable()) for text in names.tolist()]):
            raise place.fail(
                f"holds a control character in {rows_text(np.flatnonzero(bad))}",
                name,
                "write printable ASCII",
            )
        return names
    if strings:
        raise place.fail(
            f"holds strings where numbers are needed, {str(values.flat[0])!r} in row 0 (counted from 0)",
            name,
            "write it as a numeric column",
        )
    if column.kind == "float":
        if values.dtype.kind not in "fiu":
            raise place.fail(f"holds {values.dtype.name} values", name, "write it as a numeric column")
        return _to_unit(values.astype(np.float64), unit, name, column, place)
    # Whole numbers are compared as floats to find 3.5 and NaN; identifiers are far below 2**53.
    if values.dtype.kind == "f" and np.any(bad := ~(np.abs(values) < 2.0**53) | (values != np.round(values))):
        raise place.fail(f"is not a whole number in {rows_text(np.nonzero(bad)[0])}", name, "write integers")
    if values.dtype.kind not in "fiub":
        raise place.fail(f"holds {values.dtype.name} values", name, "write integers")
    if column.kind == "int":
        return values.astype(np.int64)
    if np.any(bad := (values != 0) & (values != 1)):
        raise place.fail(
            f"is neither true nor false in {rows_text(np.nonzero(bad)[0])}", name, "write T or F"
        )
    return values.astype(bool)


def _to_unit(values: np.ndarray, unit: str | None, name: str, column: Column, place: Place) -> np.ndarray:
    return values if not (unit or "").strip() else convert_unit(values, str(unit), column.unit, name, place)


def _is_converted(unit: str | None, column: Column) -> bool:
    """Whether numbers in a unit that can be read become others in that of the schema."""
    given = (unit or "").strip()
    return bool(given) and column.kind == "float" and units.Unit(given) != units.Unit(column.unit)


def convert_unit(values: np.ndarray, unit: str, wanted: str, name: str, place: Place) -> np.ndarray:
    """Convert `values` from a FITS unit string to the wanted one.

    Hour angles may come as angles, temperatures in kelvin. Raises `DataError` for an unknown unit and for
    one of another physical type.
    """
    try:
        # The generic reading, because `electron` is not a unit of the FITS standard.
        given = units.Unit(unit.strip())
    except (ValueError, TypeError) as error:
        raise place.fail(f"the unit {unit!r} is not known", name, f"use {wanted or 'no unit'}") from error
    target = units.Unit(wanted)
    if given == target:
        return values  # no arithmetic: what was written comes back bit for bit
    if wanted == "h" and given.is_equivalent(units.deg):
        target = units.hourangle
    try:
        return np.asarray(
            units.Quantity(values, given).to_value(target, units.temperature()), dtype=np.float64
        )
    except units.UnitConversionError as error:
        advice = f"convert the column to {wanted or 'a fraction without unit'}"
        if wanted == "electron":
            advice += " (multiply by the gain)"
        raise place.fail(
            f"the unit {unit!r} cannot be converted to {wanted or 'none'!r}", name, advice
        ) from error

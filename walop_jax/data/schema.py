"""The columns of all tables, what their values must be, and the one way in which they become arrays.

Columns go by name, in upper or lower case. A unit that can be converted is converted; a missing unit is that of the
column (docs: files); anything else is refused. Arrays are native-endian. FITS tables, tables of users and arrays
in memory differ only in how their values are had.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.kinds import CALIBRATION_PLATE, POLARISER, PREFIX
from walop_jax.data.records import DataFlag
from walop_jax.data.units import Place, check_units, convert_unit, differs, partner_of, unit_of
from walop_jax.io.errors import nearest, rows_text

ColumnType = Literal["int", "float", "bool", "str"]

CALVERS = 2
"""Version of the calibration set format that is written. Sets of version 1 are sets of version 2 as well."""


class Rule(NamedTuple):
    """Condition on the values of a column: where `broken` is true, the fault and its remedy."""

    broken: Callable[[np.ndarray], np.ndarray]
    what: str
    advice: str


def finite(advice: str) -> Rule:
    """The rule that a value is neither NaN nor infinite."""
    return Rule(lambda values: ~np.isfinite(values), "is not finite", advice)


def within(limit: float, advice: str, what: str = "") -> Rule:
    """The rule that a value lies from −`limit` to `limit`; NaN passes."""
    return Rule(lambda values: np.abs(values) > limit, what or f"exceeds ±{limit:g}", advice)


def _not_alone(ids: np.ndarray) -> np.ndarray:
    _, inverse, number = np.unique(ids, return_inverse=True, return_counts=True)
    return number[inverse] > 1


UNIQUE = Rule(_not_alone, "the identifier is not unique", "number the rows")


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of a table: its kind, its unit in memory, and its value where the file lacks it.

    `missing` None means that the column is required; `width` is the number of values in a row, or None for
    as many as the file has. `shape_advice` describes the row that is expected, `remarked` whether it is worth a remark
    that the column is not there, `rules` what holds for its values in any table. `true` is the whole number that a
    truth value stands for.
    """

    kind: ColumnType
    unit: str = ""
    missing: Any = None
    width: int | None = 1
    shape_advice: str = "one value in a row: split it"
    remarked: bool = True
    rules: tuple[Rule, ...] = ()
    true: int = 1


_NAN = float("nan")
_IDENTIFIER = Column("int", rules=(UNIQUE,))
_OF_A_SOURCE = Rule(
    lambda teff: ~np.isnan(teff) & ~((teff >= 500) & (teff < 1e6)),
    "is not a temperature of a source",
    "in kelvin; NaN means a flat photon spectrum, as an empty cell of a text does",
)
_JULIAN = "is this a Julian Date? subtract 2400000.5"
_IS_JULIAN = Rule(lambda mjd: np.abs(mjd) > 1e6, "is not a Modified Julian Date", _JULIAN)
_TIME = Rule(lambda time: (time < 0) | np.isinf(time), "is not a time", "seconds; NaN where it is not known")
_POSITIVE = Rule(
    lambda error: ~(error > 0) | np.isinf(error),
    "is not a positive number",
    "it is the width of a prior: give the error of the catalogue",
)
_NUMBERED = Rule(lambda number: number < 0, "is negative", "−1 means no source; number from 0")


def _number(unit: str, *rules: Rule) -> Column:
    """A number for each exposure, NaN where it is not known."""
    return Column("float", unit, _NAN, rules=rules)


_TEFF = _number("K", _OF_A_SOURCE)
_ANGLE = _number("deg", within(36000.0, "encoder readings are in degrees: are these steps?"))
TURN = Column("float", "deg", 0.0, rules=(finite("0 where the element stands still"),), remarked=False)
EXPOSURES: Mapping[str, Column] = {
    "EXPOSURE": _IDENTIFIER,
    "KIND": Column("str"),
    "MJD": _number("d", _IS_JULIAN),
    "EXPTIME": _number("s", _TIME),
    "FILTER": Column("str", missing="SDSS-r"),
    "CLP_IN": Column("bool", missing=False),
    "CLP_ANGLE": _ANGLE,
    "CHWP_IN": Column("bool", missing=False),
    "CHWP_ANGLE": _ANGLE,
    "TEMP": _number(
        "Celsius",
        within(
            150.0,
            "temperatures are in degrees Celsius: are these kelvin? Write NaN where it is not known (999)",
        ),
    ),
    "HA": _number("h", within(24.0, "hour angles are in hours: are these degrees?")),
    "RA": _number("deg", within(360.0, "right ascensions are in degrees")),
    "DEC": _number("deg", within(90.0, "declinations are in degrees")),
    "ROTATOR": _number("deg", within(720.0, "position angles are in degrees; NaN where it is not known")),
    "TEFF": _TEFF,
}
_COORDINATE = Column("float", "deg", rules=(finite("remove these points"),))
POINTS: Mapping[str, Column] = {"POINT": _IDENTIFIER, "X": _COORDINATE, "Y": _COORDINATE}
_COUNTS = Column(
    "float", "electron", width=None, shape_advice="one row holds all cameras, the same number in every row"
)
INTENSITIES: Mapping[str, Column] = {
    "EXPOSURE": Column("int"),
    "POINT": Column("int"),
    "SOURCE": Column("int", missing=-1),
    "N": _COUNTS,
    "N_ERR": _COUNTS,
    "FLAG": Column("int", missing=0, true=int(DataFlag.BAD_PIXEL)),
}
SKY = dataclasses.replace(_COUNTS, missing=np.nan)
_SHARE = within(1.0, "fractions are wanted: are these per cent?", "exceeds 1")
_FRACTION = Column("float", rules=(finite("remove the source"), _SHARE))
_ERROR = Column("float", rules=(_POSITIVE,))
_SCATTER = Rule(
    lambda rms: ~((rms >= 0) & (rms <= 1)), "is no scatter", "the rms of q and of u, a fraction; 0: none"
)
SOURCES: Mapping[str, Column] = {
    "SOURCE": Column("int", rules=(_NUMBERED,)),
    "NAME": Column("str"),
    "Q": _FRACTION,
    "U": _FRACTION,
    "Q_ERR": _ERROR,
    "U_ERR": _ERROR,
    "TEFF": _TEFF,
    "FILTER": Column("str", missing="", remarked=False),
    "SCATTER": Column("float", missing=0.0, remarked=False, rules=(_SCATTER,)),
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
"""The tables of a calibration set, in the order in which they are written; see `table_rules`."""


def check(table: Mapping[str, np.ndarray], columns: Mapping[str, Column], place: Place) -> None:
    """Raise `DataError`, with column and rows, for values of a table that break a rule of their column."""
    for name, column in columns.items():
        for rule in column.rules:
            place.refuse(rule.broken(table[name]), rule.what, name, rule.advice)


def table_rules(name: str, columns: Collection[str], place: Place) -> Mapping[str, Column]:
    """The columns of a table of a calibration set, where a file has `columns` (in capitals).

    EXPOSURES has a pair `<P>_IN`, `<P>_ANGLE` for every moving element, INTENSITIES may have SKY. Raises `DataError`
    for half a pair and for a prefix that is none.
    """
    if name == "INTENSITIES" and "SKY" in columns:
        return {**INTENSITIES, "SKY": SKY}
    return TABLES[name] if name != "EXPOSURES" else {**EXPOSURES, **_moving_columns(columns, place)}


def _moving_columns(columns: Collection[str], place: Place) -> dict[str, Column]:
    """The columns of all moving elements: an element without any is out, one with an angle alone is always in."""
    rules: dict[str, Column] = {}
    for prefix in (POLARISER, CALIBRATION_PLATE):
        inside, angle = f"{prefix}_IN", f"{prefix}_ANGLE"
        present = inside in columns or angle in columns
        rules[inside] = Column("bool", missing=None if present else False, remarked=present)
        rules[angle] = dataclasses.replace(_ANGLE, remarked=present)
    for name in columns:
        prefix, _, last = name.rpartition("_")
        if last == "TURN" and f"{prefix}_ANGLE" in columns:
            rules[name] = TURN
        if last not in ("IN", "ANGLE") or name == last or name in rules:
            continue
        if not PREFIX.fullmatch(prefix):
            advice = (
                "letters, digits and _, a letter first; rename the column if it is none of a moving element"
            )
            raise place.fail(f"{prefix!r} is no name of a moving element", name, advice)
        inside, angle = f"{prefix}_IN", f"{prefix}_ANGLE"
        if angle not in columns:
            pairs = [entry for entry in columns if entry.endswith("_ANGLE")]
            advice = f"add it, or rename {inside} if there is no such element"
            like = f" ({nearest(angle, pairs)})" if pairs else ""
            raise place.fail(f"the column is missing, {inside} is there", angle, advice + like)
        rules[inside] = Column("bool", missing=True, remarked=False)
        rules[angle] = dataclasses.replace(_ANGLE, missing=None)
    return rules


# ---------------------------------------------------------------------------------------- whole tables


def column_names(hdu: Any, place: Place) -> list[str]:
    """Names of the columns of a FITS table in capitals; `DataError` if it is none or has a name twice."""
    if type(hdu).__name__ != "BinTableHDU":
        raise place.fail("is not a binary table", advice="write it as a FITS binary table")
    return distinct((name.upper() for name in hdu.columns.names), place)


def distinct(names: Iterable[str], place: Place) -> list[str]:
    """The names of columns; `DataError` if one is there twice."""
    columns = list(names)
    for name in columns:
        if columns.count(name) > 1:
            raise place.fail("the column is there twice", name, "remove or rename one of them")
    return columns


def read_table(hdu: Any, columns: Mapping[str, Column], place: Place) -> tuple[dict[str, Any], list[str]]:
    """Turn a FITS table into arrays by column name, in the units of `columns`, and remarks on oddities.

    Raises `DataError` for a missing, duplicated or ill-typed column, a unit that cannot be converted, and a
    table without rows.
    """
    names = column_names(hdu, place)
    unknown = [name for name in names if name not in columns]
    stored, units_of, absent = dict[str, np.ndarray](), dict[str, str](), dict[str, list[str]]()
    remarks = [place.remark(f"unknown column, not used ({nearest(name, columns)})", name) for name in unknown]
    for name, column in columns.items():
        if name not in names:
            if column.remarked:
                absent.setdefault(str(column.missing), []).append(name)
            continue
        index = names.index(name)
        stored[name] = _stored(hdu, index, name, place)
        unit = units_of[name] = (hdu.columns[index].unit or "").strip()
        if column.true != 1 and stored[name].dtype.kind == "b":
            what = f"holds truth values: true is taken as {column.true}, {DataFlag(column.true).meaning}"
            remarks.append(place.remark(what, name))
        if column.kind == "float" and unit and differs(unit, column.unit):
            remarks.append(place.remark(f"is in {unit}, converted to {column.unit or 'a fraction'}", name))
    table = _filled(stored, units_of, int(hdu.header["NAXIS2"]), columns, place, sorted(unknown))
    for missing, left_out in absent.items():
        what = f"column{'s' if len(left_out) > 1 else ''} missing; using {missing}"
        remarks.append(place.remark(what, ", ".join(left_out)))
    return table, remarks


def table_of(given: Mapping[str, Any], columns: Mapping[str, Column], place: Place) -> dict[str, np.ndarray]:
    """A table in memory, its columns by name, as `read_table` returns it; absent columns have their defaults.

    Raises `DataError` for a column that is missing, ill-typed or of another shape than `columns` say, and for one that
    `columns` do not have.
    """
    rows = max(len(values) for values in given.values())
    for name, values in given.items():
        if name not in columns:
            raise place.fail("there is no such column", name, nearest(name, columns))
        if len(values) != rows:
            raise place.fail(f"has {len(values)} values, another column {rows}", name, "one for each row")
    return _filled(given, {name: unit_of(values) for name, values in given.items()}, rows, columns, place)


def _filled(
    given: Mapping[str, Any],
    units_of: Mapping[str, str],
    rows: int,
    columns: Mapping[str, Column],
    place: Place,
    unknown: Collection[str] = (),
) -> dict[str, np.ndarray]:
    """The columns of a table from those that are given, in their units; `unknown` are names of others that it has."""
    for name, column in columns.items():
        if column.missing is None and name not in given:
            like = f" ({nearest(name, unknown)})" if unknown else ""
            raise place.fail("the column is missing", name, f"add it{like}")
    if rows == 0:
        raise place.fail("has no rows", advice="a calibration set needs at least one")
    table = {
        name: values_of(given[name], name, column, place, unit=units_of[name])
        if name in given
        else np.full(rows, column.missing)
        for name, column in columns.items()
    }
    for name, unit in units_of.items():
        partner, column = partner_of(name), columns[name]
        if partner != name and partner in units_of and column.kind == "float":
            check_units({partner: units_of[partner], name: unit}, column.unit, place)
    return table


# ---------------------------------------------------------------------------------------- values of a column


def undefined(hdu: Any, index: int) -> Bool[np.ndarray, ...]:
    """True where a FITS table holds no value: stored integers equal to TNULL, logical values that are neither T nor F.

    The stored integers are compared, ahead of TSCAL and TZERO (FITS standard 4.0, section 7.3.2).
    """
    column = hdu.columns[index]
    stored = np.asarray(hdu.data.view(np.ndarray)[hdu.data.dtype.names[index]])
    if getattr(column.format, "format", "") == "L":
        return (stored != ord("T")) & (stored != ord("F"))
    if column.null in (None, "") or stored.dtype.kind not in "iu":
        return np.zeros(stored.shape, bool)
    return stored == int(column.null)


def _stored(hdu: Any, index: int, name: str, place: Place) -> np.ndarray:
    """The values of a column of a FITS table as they are stored, none of them undefined."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values, missing = np.asarray(hdu.data.field(index)), undefined(hdu, index)
    except (ValueError, TypeError, OSError, UnicodeError, KeyError, IndexError, Warning) as error:
        raise place.fail(f"cannot be read: {error}", name, "write the column again") from error
    place.refuse(missing, "undefined (TNULL)", name, "fill or remove these rows")
    return values


def values_of(
    given: Any, name: str, rule: Column, place: Place, *, unit: str = "", lenient: bool = False
) -> np.ndarray:
    """The values of a column in the kind, unit and shape of its rule; numbers that are masked are NaN.

    `given` is a column of an astropy table, an array, a quantity, times or a list; `unit` that of one without. In a
    table of a user (`lenient`) texts may be numbers and truth values, and an empty cell has the value of an absent
    column.

    Raises `DataError`, with rows, for values of another kind or shape, for whole numbers, truth values and names that
    are masked, and as `convert_unit` does.
    """
    values, empty, stated = plain_column(given, name, rule, place)
    values, empty = (_shaped(array, name, rule, place) for array in (values, empty))
    strings, fill = values.dtype.kind in "OSU", rule.missing if lenient else None
    if rule.kind == "str":
        if not strings and not lenient:
            raise place.fail("holds numbers where names are needed", name, "write it as a string column")
        text = np.char.strip(values.astype(str))
        if lenient:
            return np.where(empty | (text == "") | (text == "None"), str(fill), text)
        place.refuse(empty, "is masked", name, "fill or remove these rows")
        bad = [not (entry.isascii() and entry.isprintable()) for entry in text.tolist()]
        place.refuse(np.array(bad), "holds a control character", name, "write printable ASCII")
        return text
    if strings and not lenient:
        what = f"holds strings where numbers are needed, {str(values.flat[0])!r} in row 0 (counted from 0)"
        raise place.fail(what, name, "write it as a numeric column")
    if strings:
        values = _from_text(np.where(empty, "", np.char.strip(values.astype(str))), rule, name, place)
    if values.dtype.kind not in ("fiu" if rule.kind == "float" else "fiub"):
        advice = "write it as a numeric column" if rule.kind == "float" else "write integers"
        raise place.fail(f"holds {values.dtype.name} values", name, advice)
    if rule.kind == "int" and values.dtype.kind == "b":
        values = values * np.int64(rule.true)
    if rule.kind == "float":
        numbers = values.astype(np.float64)
        numbers[empty] = np.nan
        numbers = convert_unit(numbers, stated or unit, rule.unit, name, place) if stated or unit else numbers
        return numbers if fill is None else np.where(np.isnan(numbers), fill, numbers)
    if fill is not None:
        values = np.where(empty, fill, values)
    else:
        place.refuse(empty, "is masked", name, "fill or remove these rows")
    if rule.kind == "bool":
        place.refuse((values != 0) & (values != 1), "is neither true nor false", name, "write T or F")
        return values.astype(bool)
    # Whole numbers are compared as floats to find 3.5 and NaN; identifiers are far below 2**53.
    if values.dtype.kind == "f":
        bad = ~(np.abs(values) < 2.0**53) | (values != np.round(values))
        place.refuse(bad, "is not a whole number", name, "write integers")
    return values.astype(np.int64)


def plain_column(
    column: Any, name: str, rule: Column, place: Place
) -> tuple[np.ndarray, Bool[np.ndarray, ...], str]:
    """The values of a column, where they are masked, and its unit; times become MJD (UTC) where days are wanted."""
    if hasattr(column, "jd1") or np.asarray(column).dtype.kind == "M":
        from astropy.time import Time

        if rule.unit != "d":
            raise place.fail("holds times", name, f"give numbers in {rule.unit or 'plain'}")
        masked = np.asarray(getattr(column, "mask", False))
        if not hasattr(column, "jd1"):
            days = np.asarray(column)
            masked = masked | np.isnat(days)
            column = Time(np.where(masked, np.datetime64("2000-01-01"), days), scale="utc")
        if not hasattr(column, "utc"):
            raise place.fail("holds differences of times", name, "give dates")
        values = np.asarray(getattr(column.utc.mjd, "unmasked", column.utc.mjd), dtype=float)
        return values, np.broadcast_to(masked, values.shape), ""
    unit = unit_of(column)
    values, masked = without_mask(getattr(column, "value", column) if unit else column)
    if values.dtype.names:
        raise place.fail("is no plain column", name, "give a column of numbers or texts")
    return values, masked, unit


def _shaped(values: np.ndarray, name: str, rule: Column, place: Place) -> np.ndarray:
    """The values with the axes of their column: rows, and values in a row unless that is one."""
    if values.dtype == object and any(isinstance(entry, np.ndarray) for entry in values.flat[:1]):
        raise place.fail("is an array of variable length", name, rule.shape_advice)
    if rule.width is None and values.ndim == 1:
        values = values[:, None]
    if rule.width == 1 and values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    several = rule.width != 1
    if values.ndim != 1 + several or (several and rule.width not in (None, values.shape[1])):
        width = "any number of" if rule.width is None else rule.width
        what = f"has shape {values.shape[1:] or '()'} in a row where {width} value(s) are needed"
        raise place.fail(what, name, rule.shape_advice)
    return values


MISSING = ("", "nan", "na", "n/a", "<na>", "none", "null", "--", "-", "...")
"""Texts of a cell without a value, in small letters."""
_TRUTH = dict.fromkeys(("false", "f", "0", "0.0", "no", *MISSING), 0.0)
_TRUTH |= dict.fromkeys(("true", "t", "1", "1.0", "yes"), 1.0)


def _from_text(text: np.ndarray, rule: Column, name: str, place: Place) -> Float[np.ndarray, ...]:
    """Numbers from the cells of a text, NaN where they are empty; of truth values 1 and 0."""
    numbers, truth = np.empty(text.shape), rule.kind == "bool"
    for at, cell in np.ndenumerate(text):
        try:
            missing = cell.lower() in MISSING
            numbers[at] = _TRUTH[cell.lower()] if truth else float("nan" if missing else cell)
        except (KeyError, ValueError):
            what, advice = ("neither true nor false", "write T or F") if truth else ("not a number", "")
            if not truth and "," in cell:
                advice = "write numbers with a decimal point and without separators of thousands"
            what = f"{str(cell)!r} is {what}, in {rows_text(at[:1])}"
            raise place.fail(what, name, advice or "correct it or leave it empty") from None
    return numbers


def without_mask(values: Any) -> tuple[np.ndarray, Bool[np.ndarray, ...]]:
    """The values of an array, column or masked quantity, and where they are masked, that is, missing."""
    plain = np.asarray(np.ma.getdata(getattr(values, "unmasked", values)))
    return plain, np.broadcast_to(np.asarray(getattr(values, "mask", False)), plain.shape)


def in_unit(values: Any, unit: str, name: str) -> Float[np.ndarray, "*s"]:
    """Numbers that callers bring along (lists, scalars, quantities, columns) as native float64 in `unit`.

    Numbers without a unit are taken to have it, masked ones are NaN. `name` is what errors call them. Raises
    `DataError` for a unit that cannot be converted and for values that are not numbers.
    """
    place = Place("", "")
    unit_given = unit_of(values)
    plain = getattr(values, "value", values) if unit_given and not hasattr(values, "colnames") else values
    try:
        raw, masked = without_mask(plain)
        numbers = np.where(masked, np.nan, raw.astype(np.float64))
    except (TypeError, ValueError):
        raise place.fail("is not made of numbers", name, f"give numbers in {unit or 'fractions'}") from None
    flat = np.atleast_1d(numbers).astype(np.float64)
    flat = convert_unit(flat, unit_given, unit, name, place) if unit_given else flat
    return flat.reshape(np.shape(numbers))

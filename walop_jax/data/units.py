"""Units of columns, and the place of a column in messages about it."""

from __future__ import annotations

import dataclasses
import datetime
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from astropy import units

from walop_jax.io.errors import fail, rows_text


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a table comes from (file and extension), so that every check can name it."""

    file: object
    extension: str

    def fail(self, what: str, column: str = "", advice: str = "") -> ValueError:
        """Build the error of something wrong in this table."""
        return fail(what, file=self.file, extension=self.extension, column=column, advice=advice)

    def refuse(self, bad: np.ndarray, what: str, column: str, advice: str) -> None:
        """Raise `DataError` naming the rows (first axis) where `bad` is set, if there are any."""
        if np.any(bad):
            rows = np.unique(np.nonzero(bad)[0])
            raise self.fail(f"{what} in {rows_text(rows)}", column, advice)

    def remark(self, what: str, column: str) -> str:
        """A sentence about a column of this table."""
        return f"{self.file} [{self.extension}] {column}: {what}"


_SEXAGESIMAL = re.compile(r"\s*[+-]?\d+\s*[:hd ]\s*\d.*")


def is_sexagesimal(value: Any) -> bool:
    """True for a text that looks like 06:30:12.5, 6 30 12.5 or 6h30m12.5s."""
    return isinstance(value, str) and _SEXAGESIMAL.fullmatch(value) is not None


def degrees_of(text: str | Sequence[str], unit: str) -> Any:
    """The angles (deg) of texts; `unit` (hourangle, deg) is that of one without; ValueError for what is no angle."""
    from astropy.coordinates import Angle  # imported here: it takes a seventh of a second

    return Angle(text, unit=unit).deg


def sexagesimal(degrees: float, unit: str) -> str:
    """An angle (deg) as hh:mm:ss.ss, or ±dd:mm:ss.ss where `unit` is deg."""
    from astropy.coordinates import Angle

    hours = unit == "hourangle"
    turned = round(degrees * 24000.0) / 24000.0 % 360.0 if hours else degrees  # hundredths of seconds
    return str(Angle(turned, "deg").to_string(unit, sep=":", precision=2, pad=True, alwayssign=not hours))


def mjd_of(text: str) -> float:
    """The MJD (UTC, d) of a text of ISO 8601, with the offset of its zone if it has one; ValueError for others."""
    time = datetime.datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    utc = time.astimezone(datetime.UTC).replace(tzinfo=None) if time.tzinfo else time
    return (utc - datetime.datetime(1858, 11, 17)) / datetime.timedelta(days=1)


def unit_of(column: Any) -> str:
    """The unit that a column, an array or a quantity brings along, "" for none."""
    return str(getattr(column, "unit", None) or "")


TOGETHER: Mapping[str, str] = {"Y": "X", "U": "Q"}
"""Columns that have the unit of another one, beside errors, which have that of their value."""


def partner_of(name: str) -> str:
    """The column that has the unit of this one: N for its error N_ERR; the column itself otherwise."""
    value = name.replace("_ERR", "")
    return TOGETHER.get(value, value) if value == name else value


def check_units(given: Mapping[str, str], wanted: str, place: Place) -> None:
    """Raise `DataError` where some of columns that belong together have a unit to be converted and others have none."""
    converted = [name for name, unit in given.items() if unit and differs(unit, wanted)]
    without = [name for name, unit in given.items() if not unit]
    if converted and without:
        what = f"has no unit, {converted[0]} is in {given[converted[0]]}"
        raise place.fail(what, without[0], f"give all in one unit, or all in {wanted or 'fractions'}")


def differs(unit: str, wanted: str) -> bool:
    """True where a column in `unit` must be converted to `wanted`."""
    try:
        return units.Unit(unit) != units.Unit(wanted)
    except ValueError:
        return True  # unknown: an error of its own where it is converted


def convert_unit(values: np.ndarray, unit: str, wanted: str, name: str, place: Place) -> np.ndarray:
    """Convert `values` from a FITS unit string to the wanted one.

    Hour angles may come as angles, temperatures in kelvin. Raises `DataError` for an unknown unit and for
    one of another physical type.
    """
    try:
        # The generic reading, because `electron` is not a unit of the FITS standard.
        unit_given = units.Unit(unit.strip())
    except (ValueError, TypeError) as error:
        raise place.fail(f"the unit {unit!r} is not known", name, f"use {wanted or 'no unit'}") from error
    target = units.Unit(wanted)
    if unit_given == target:
        return values  # no arithmetic: values come back bit for bit
    if hasattr(unit_given, "physical_unit") or unit_given in (units.mag, units.dex, units.dB):
        advice = f"give the column in {wanted or 'fractions'}"
        if wanted in ("electron", "ct"):
            advice = (
                "counts in electrons are needed: 10^(−0.4 (m − m₀)) of magnitudes m, m₀ that of one electron, and "
                "N_ERR = 0.921 N · error of m; 10^d of dex"
            )
        raise place.fail(f"is logarithmic ({unit.strip()})", name, advice)
    if wanted == "h" and unit_given.is_equivalent(units.deg):
        target = units.hourangle
    try:
        converted = units.Quantity(values, unit_given).to_value(target, units.temperature())
        return np.asarray(converted, dtype=np.float64)
    except units.UnitConversionError as error:
        what = f"the unit {unit!r} cannot be converted to {wanted or 'none'!r}"
        advice = f"convert the column to {wanted or 'a fraction without unit'}"
        if wanted in ("electron", "ct"):
            per_time = unit_given.is_equivalent(target / units.s)
            advice += f" (multiply by the {'exposure time' if per_time else 'gain'})"
        raise place.fail(what, name, advice) from error

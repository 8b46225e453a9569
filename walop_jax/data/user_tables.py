"""Tables that astronomers bring along (FITS, CSV, ECSV): columns by name, checked, with units taken care of.

Column names know no upper and lower case. A cell that is empty or masked is NaN, or the value that the column
has where it is absent.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.data.schema import Column, Place, converted, distinct
from walop_jax.io.errors import DataError, fail, rows_text
from walop_jax.io.fits_reading import UNREADABLE, one_line, open_fits
from walop_jax.io.plain_tables import table_format
from walop_jax.io.text import check_input, some

_TRUTH = dict.fromkeys(("true", "t", "1", "1.0", "yes"), 1.0) | dict.fromkeys(
    ("false", "f", "0", "0.0", "no", ""), 0.0
)

_LISTED = 12  # columns, in a message


@dataclasses.dataclass(frozen=True)
class InputTable:
    """A table as it was read, to be handed back with columns added; `rows` is its length."""

    path: Path
    rows: int
    table: Any

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its columns in capitals."""
        return tuple(str(name).upper() for name in self.table.colnames)


def read_input_table(path: str | os.PathLike[str]) -> InputTable:
    """Read a table with whatever columns it has.

    Raises `DataError` if the file is missing, damaged, no table, has no rows, or names a column twice.
    """
    from astropy.table import Table  # imported here: it takes a third of a second

    kind = table_format(path)
    path = check_input(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if kind == "fits":
                with open_fits(path) as opened:
                    number = next(
                        (n for n, h in enumerate(opened.hdus) if type(h).__name__ == "BinTableHDU"), None
                    )
                    if number is None:
                        raise fail("has no table", file=path, advice="write one, or use a CSV file")
                    table: Any = Table.read(opened.hdus[number], character_as_bytes=False)
            else:
                table = Table.read(path, format=kind)
    except DataError:
        raise
    except UNREADABLE as error:
        what = f"cannot be read as a table: {one_line(error)}"
        raise fail(what, file=path, advice="write it again") from error
    if len(table) == 0:
        raise fail("has no rows", file=path, advice="nothing to be done")
    distinct((str(name).upper() for name in table.colnames), Place(path, ""))
    return InputTable(path, len(table), table)


def in_memory(columns: Any, name: str = "the table") -> InputTable:
    """A table given in memory: an astropy table, or columns by name (arrays, lists, scalars, quantities).

    `name` is what errors call it. Raises `DataError` if it has no rows, or columns of different lengths.
    """
    from astropy.table import Table

    try:
        if isinstance(columns, Table):
            table = Table(columns, copy=False)  # quantities become columns with a unit
        else:
            arrays = {str(key): np.atleast_1d(values) for key, values in dict(columns).items()}
            rows = max((len(values) for values in arrays.values()), default=0)
            single = {key for key, values in dict(columns).items() if np.ndim(values) == 0}
            table = Table({k: np.repeat(v, rows, axis=0) if k in single else v for k, v in arrays.items()})
    except (TypeError, ValueError) as error:
        raise fail(
            f"is no table: {one_line(error)}", file=name, advice="give columns of one length"
        ) from error
    if len(table) == 0:
        raise fail("has no rows", file=name, advice="nothing to be done")
    return InputTable(Path(name), len(table), table)


def numeric_column(source: InputTable, name: str, rule: Column) -> np.ndarray:
    """A column as an array in the unit, and of the kind, that `rule` asks for.

    Raises `DataError` naming file, column and rows for what cannot be converted.
    """
    place = Place(source.path, "")
    if name not in source.names:
        if rule.missing is None:
            advice = f"add it, or name it so; {_what_is_there(source)}"
            raise place.fail("the column is missing", name, advice)
        return np.full(source.rows, rule.missing)
    column = source.table.columns[source.names.index(name)]
    values = np.ma.getdata(np.ma.asarray(column))
    if values.ndim != 1:
        raise place.fail(f"has shape {values.shape[1:]} in a row, one value is needed", name, "split it")
    return _cells(column, name, rule, place)


def _what_is_there(source: InputTable) -> str:
    return f"the table has {some([str(name) for name in source.table.colnames], _LISTED)}"


def vector_column(source: InputTable, name: str, rule: Column, cameras: Sequence[str]) -> np.ndarray:
    """A column with `rule.width` numbers in a row, or that many columns side by side, which text formats need.

    These are N0, N1, … and N0_ERR, N1_ERR, … (or N_ERR0, …), or go by the names of the `cameras`: O1, E1, … and
    O1_ERR, E1_ERR, … Raises `DataError` as `numeric_column` does, and for a row of another width.
    """
    place = Place(source.path, "")
    width = rule.width or 1
    if name not in source.names:
        head, _, tail = name.partition("_")
        end = f"_{tail}" if tail else ""
        spelled = [f"{head}{k}{end}" for k in range(width)], [f"{camera.upper()}{end}" for camera in cameras]
        forms = (*spelled, [f"{name}{k}" for k in range(width)])
        parts = next((form for form in forms if any(part in source.names for part in form)), None)
        if parts is None:
            if rule.missing is not None:
                return np.full((source.rows, width), rule.missing)
            listed = ", or ".join(f"{form[0]} … {form[-1]}" for form in spelled)
            raise place.fail("the column is missing", name, f"add it, or {listed}; {_what_is_there(source)}")
        single = dataclasses.replace(rule, width=1)
        return np.stack([numeric_column(source, part, single) for part in parts], axis=1)
    column = source.table.columns[source.names.index(name)]
    values = np.ma.getdata(np.ma.asarray(column))
    if values.ndim != 2 or values.shape[1] != width:
        what = f"has shape {values.shape[1:] or '()'} in a row, {width} values are needed"
        raise place.fail(what, name, rule.shape_advice)
    return _cells(column, name, rule, place)


def _cells(column: Any, name: str, rule: Column, place: Place) -> np.ndarray:
    """The values of a column as `rule` has them; a masked, empty or NaN cell is what it says of absent columns."""
    values = np.ma.getdata(np.ma.asarray(column))
    empty = np.broadcast_to(np.asarray(getattr(column, "mask", False)), values.shape)
    if rule.kind == "str":
        text = np.char.strip(values.astype(str))
        return np.where(empty | (text == ""), str(rule.missing), text)
    if values.dtype.kind in "OSU":
        text = np.where(empty, "", np.char.strip(values.astype(str)))
        values = _from_text(text, rule.kind == "bool", name, place)
    if rule.kind == "bool":
        return converted(np.where(empty, False, values), "", name, rule, place)
    empty = empty | (values != values)
    found = converted(values, str(column.unit or ""), name, rule, place)
    return np.where(empty, float("nan" if rule.missing is None else str(rule.missing)), found)


def _from_text(text: np.ndarray, truth: bool, name: str, place: Place) -> Float[np.ndarray, ...]:
    """Numbers from the cells of a text, NaN where they are empty; of truth values 1 and 0."""
    numbers = np.empty(text.shape)
    for at, cell in np.ndenumerate(text):
        try:
            numbers[at] = _TRUTH[cell.lower()] if truth else float(cell or "nan")
        except (KeyError, ValueError):
            what, advice = ("neither true nor false", "write T or F") if truth else ("not a number", "")
            raise place.fail(
                f"{str(cell)!r} is {what}, in {rows_text(at[:1])}",
                name,
                advice or "correct it or leave it empty",
            ) from None
    return numbers


def extended(source: InputTable, added: Mapping[str, Any], header: Mapping[str, Any] | None = None) -> Any:
    """A copy of a table with columns added (an old column of that name is replaced), an astropy table.

    A value of `added` is an array, alone or with its description and its unit; `header` adds to the header of
    the table (CSV has none).
    """
    table = source.table.copy(copy_data=False)
    for key in [key for key in table.meta if key.upper() in ("CHECKSUM", "DATASUM", "EXTNAME")]:
        del table.meta[key]
    table.meta.update(header or {})
    present = {str(name).upper(): name for name in table.colnames}
    for name, values in added.items():
        if name in present:
            table.remove_column(present[name])
        values, *about = values if isinstance(values, tuple) else (values,)
        table[name] = values
        for attribute, text in zip(("description", "unit"), about, strict=False):
            if text:
                setattr(table[name], attribute, text)
    return table

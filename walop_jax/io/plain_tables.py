"""Tables of results that did not start as a table of the user.

Columns with unit and description, FITS or ECSV.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Column as AstropyColumn
from astropy.table import Table, vstack

from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import PathLike, fail
from walop_jax.io.text import some

FORMATS = {
    ".fits": "fits",
    ".fit": "fits",
    ".fits.gz": "fits",
    ".csv": "ascii.csv",
    ".ecsv": "ascii.ecsv",
    ".vot": "votable",
    ".votable": "votable",
    ".parquet": "parquet",
}
"""Extensions of tables that are read, and what astropy calls the format."""


def table_format(path: PathLike) -> str:
    """Format of a table with this name, as astropy calls it.

    Raises `DataError` for an extension that is none of `FORMATS`.
    """
    name = Path(path).name.lower()
    for extension, kind in FORMATS.items():
        if name.endswith(extension):
            return kind
    raise fail("has no extension of a table", file=path, advice=f"use {', '.join(FORMATS)}")


def astropy_table(
    columns: Mapping[str, tuple[np.ndarray, str, str]],
    notes: Mapping[str, str | int | float | bool] | None = None,
) -> Table:
    """An astropy table of columns given as (values, unit, description), with notes in `meta`."""
    return Table(
        [
            AstropyColumn(values, name=name, unit=unit or None, description=about)
            for name, (values, unit, about) in columns.items()
        ],
        meta=dict(notes or {}),
    )


def faults_of_ucds(ucds: Mapping[str, str]) -> list[str]:
    """Sentences on words for the meaning of columns that are no UCD of the vocabulary of the IVOA."""
    from astropy.io.votable.ucd import check_ucd

    wrong = [
        name for name, ucd in ucds.items() if ucd and not check_ucd(ucd, check_controlled_vocabulary=True)
    ]
    return [f"{name}: {ucds[name]!r} is no UCD" for name in wrong]


def _as_votable(table: Table) -> Any:
    """The table as a VOTable: the cards of its header as parameters, the frame of its times."""
    from astropy.io.votable import from_table
    from astropy.io.votable.tree import Param, TimeSys

    votable: Any = from_table(table)
    votable.version = "1.4"
    resource, cards = votable.resources[0], dict(table.meta or {})
    for key, value in cards.items():
        text = json.dumps(value) if isinstance(value, bool | int | float) else str(value)
        param = Param(votable, name=str(key), ID=str(key), datatype="unicodeChar", arraysize="*", value=text)
        resource.tables[0].params.append(param)
    if scale := str(cards.get("TIMESYS", "")):
        config = {"version": votable.version, "version_1_4_or_later": True}  # before astropy 7.2 asked for
        resource.time_systems.append(
            TimeSys(ID="TIME", timescale=scale, refposition="TOPOCENTER", timeorigin=0.0, config=config)
        )
    return votable


def stacked(first: Any, second: Any) -> Any:
    """The rows of two tables as one; cells without a value are masked."""
    return vstack([first, second], metadata_conflicts="silent")


def numbered(name: str, width: int) -> list[str]:
    """Names of columns side by side in place of one with so many numbers in a row: N0 …, N0_ERR …; of others SKY0 …"""
    head, _, tail = name.partition("_")
    if head == "N":
        return [f"{head}{k}{'_' + tail if tail else ''}" for k in range(width)]
    return [f"{name}{k}" for k in range(width)]


def _side_by_side(table: Any) -> Any:
    """The table with a column for each number of a row, as texts of numbers need it; without its header."""
    flat = Table()
    for name in table.colnames:
        column = table[name]
        if len(shape := column.shape[1:]) == 0:
            flat[name] = column
            continue
        values = column.reshape(len(column), -1)
        for k, single in enumerate(numbered(name, int(np.prod(shape)))):
            flat[single] = values[:, k]
    return flat


def not_in(path: PathLike, table: Table) -> list[str]:
    """A sentence on the words of a table's header that the format of a file cannot hold."""
    words = [
        str(key) for key in (table.meta or {}) if str(key).upper() not in ("REMARK", "COMMENT", "HISTORY")
    ]
    if table_format(path) != "ascii.csv" or not words:
        return []
    return [f"CSV has no header: {some(words, 8)} are not in {path}; .ecsv and .fits keep them"]


def write_table(path: PathLike, table: Table, *, overwrite: bool = False) -> None:
    """Write an astropy table in the format of the name; whole or not at all.

    In CSV, which has neither a header nor several numbers in a cell, the latter stand side by side (`numbered`).

    Raises `DataError` as `atomic_path` does, for an unknown extension, and for columns that the format cannot hold.
    """
    kind = table_format(path)
    with atomic_path(path, overwrite=overwrite) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if kind == "votable":
                _as_votable(table).to_xml(str(temporary))
            else:
                flat = _side_by_side(table) if kind == "ascii.csv" else table
                flat.write(temporary, format=kind, overwrite=True)
        except ImportError as error:
            what = f"needs {error.name or 'a library'}, which is not installed"
            raise fail(what, file=path, advice="pip install 'walop-jax[parquet]', or write .fits") from error
        except (ValueError, TypeError) as error:
            what = f"cannot be written: {' '.join(str(error).split())[:300]}"
            raise fail(what, file=path, advice="try .ecsv") from error

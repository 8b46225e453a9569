"""The file of nights, `nights.fits`: normal equations that are kept (docs: files).

A row of 127 parameters takes 67 kB. All extensions carry checksums; the file appears whole or not at all.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data.hdus import sign_and_write, table_hdu
from walop_jax.data.schema import Column, read_table
from walop_jax.data.units import Place
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import OpenFile, open_fits
from walop_jax.io.names import NIGHTS
from walop_jax.io.text import in_ascii
from walop_jax.model.parameters import Parameter
from walop_jax.nights.together import EffectAmplitude, Night

NIGHTVER = 1
_NAN = float("nan")
_AGAIN = "make the nights again and write them anew"
_NUMBERS = ("START", "PRIOR_MEAN", "PRIOR_WIDTH", "LOOSE", "SCALE")
_PARAMETERS = {
    **dict.fromkeys(("NAME", "UNIT"), Column("str")),
    **dict.fromkeys(_NUMBERS, Column("float", missing=_NAN)),
    "CANDIDATE": Column("bool"),
}
_FIELDS = {
    "NIGHT": ("number", Column("int")),
    "MJD_BEG": ("begin", Column("float", "d")),
    "MJD_END": ("end", Column("float", "d")),
    "MJD": ("mjd", Column("float", "d")),
    "FILTERS": ("filters", Column("str")),
    "SOURCE": ("source", Column("str")),
    "SHA256": ("sha256", Column("str")),
    "NDATA": ("n_data", Column("int")),
    "DOF": ("dof", Column("int")),
    "CHI2": ("chi2", Column("float")),
    "REFERENCE": ("reference", Column("float", width=None)),
    "GRADIENT": ("gradient", Column("float", width=None)),
    "MATRIX": ("matrix", Column("float", width=None)),
}
"""Columns of NIGHTS and the field of a `Night` in each: filters as one text, of the matrix the lower triangle."""
_NIGHTS = {name: column for name, (_, column) in _FIELDS.items()}


def write_nights(path: str | os.PathLike[str], nights: Sequence[Night], *, overwrite: bool = False) -> None:
    """Write nights of the same parameters to a file, which appears whole or not at all.

    Raises `DataError` if the file exists and `overwrite` is False, and ValueError for nights of different parameters.
    """
    first = nights[0]
    if any(night.names != first.names or night.model != first.model for night in nights):
        raise ValueError("nights of different parameters go into files of their own")
    p, lower = first.parameters, np.tril_indices(len(first.names))
    stated = ("NAME", "UNIT", "START", "LOOSE", "SCALE")
    parameters = {column: [getattr(entry, column.lower()) for entry in p] for column in stated} | {
        "PRIOR_MEAN": [entry.prior and entry.prior[0] for entry in p],
        "PRIOR_WIDTH": [entry.width for entry in p],
        "CANDIDATE": np.arange(len(p)) >= len(p) - first.candidates,
    }
    stored = [
        vars(night) | {"filters": " ".join(night.filters), "matrix": night.matrix[lower]} for night in nights
    ]
    rows = {name: [values[field] for values in stored] for name, (field, _) in _FIELDS.items()}
    primary = fits.PrimaryHDU()
    cards = {"INSTRUME": first.instrument, "CREATOR": "walop-jax", "MODEL": first.model}
    primary.header.update(NIGHTVER=NIGHTVER, **cards)
    tables = ("PARAMETERS", parameters, _PARAMETERS), ("NIGHTS", rows, _NIGHTS)
    hdus = [primary, *(_table(name, columns, path, rules) for name, columns, rules in tables)]
    with atomic_path(path, overwrite=overwrite) as temporary:
        sign_and_write(hdus, temporary)


def _table(name: str, columns: Mapping[str, Any], path: Any, rules: Mapping[str, Column]) -> fits.BinTableHDU:
    """A table of values by the rules of their columns: texts in ASCII, NaN for None."""
    arrays = {}
    for column, values in columns.items():
        if (kind := rules[column].kind) == "str":
            values = [in_ascii(text) for text in values]
        arrays[column] = np.array(values, kind)
    return table_hdu(name, arrays, path, rules)


def read_nights(path: str | os.PathLike[str]) -> list[Night]:
    """The nights of a file. Raises `DataError`, with advice, for one that is damaged, of another kind, or newer."""
    with open_fits(path, _AGAIN) as opened:
        return _nights(opened)


def _nights(opened: OpenFile) -> list[Night]:
    path, header = opened.path, opened.hdus[0].header
    version = header.get("NIGHTVER")
    if not isinstance(version, int) or isinstance(version, bool):
        raise fail("is no file of nights", file=path, column="NIGHTVER", advice=_AGAIN)
    if version > NIGHTVER:
        raise fail(f"is of version {version}, newer than this program", file=path, advice="update walop-jax")
    hdus = {hdu.name.strip().upper(): hdu for hdu in opened.hdus[1:]}
    for name in ("PARAMETERS", "NIGHTS"):
        if name not in hdus:
            raise fail("the extension is missing", file=path, extension=name, advice=_AGAIN)
    table, _ = read_table(hdus["PARAMETERS"], _PARAMETERS, Place(path, "PARAMETERS"))
    rows, _ = read_table(hdus["NIGHTS"], _NIGHTS, Place(path, "NIGHTS"))
    n = len(table["NAME"])
    for name, width in (("REFERENCE", n), ("GRADIENT", n), ("MATRIX", n * (n + 1) // 2)):
        if rows[name].shape[1] != width or not np.isfinite(rows[name]).all():
            what = f"is not {width} finite numbers a row"
            raise fail(what, file=path, extension="NIGHTS", column=name, advice=_AGAIN)
    parameters = []
    entries = zip(*(table[name].tolist() for name in _PARAMETERS), strict=True)
    for name, unit, start, mean, width, loose, scale, candidate in entries:
        prior = None if np.isnan(width) else (mean, width)
        p = Parameter(
            name, unit, "", "", start, prior, scale=scale, loose=None if np.isnan(loose) else loose,
            part=name.partition(".")[0],
        )  # fmt: skip
        # Candidates that start elsewhere are gauges of the model.
        parameters.append(EffectAmplitude.read(p) if candidate and start == 0.0 else p)
    lower, nights = np.tril_indices(n), []
    for k in range(len(rows["NIGHT"])):
        values: dict[str, Any] = {
            field: rows[name][k] if rows[name].ndim > 1 else rows[name][k].item()
            for name, (field, _) in _FIELDS.items()
        }
        matrix = np.zeros((n, n))
        matrix[lower] = values["matrix"]
        values |= {"matrix": matrix + np.tril(matrix, -1).T, "filters": tuple(values["filters"].split())}
        instrument, model = (str(header.get(card, "")) for card in ("INSTRUME", "MODEL"))
        of_all = {"parameters": tuple(parameters), "candidates": int(table["CANDIDATE"].sum())}
        nights.append(Night(instrument=instrument, model=model, **of_all, **values))
    return nights


def nights_in(folder: Path) -> list[Night]:
    """The nights of all files of a folder (a SURVEY, or a folder of night files). `DataError` for none."""
    files = [folder / NIGHTS] if (folder / NIGHTS).exists() else sorted(folder.glob("night*.fits"))
    if not files:
        raise fail("holds no nights", file=folder, advice="give sets, RUNs of walop-jax refit or a SURVEY")
    return [night for file in files for night in read_nights(file)]

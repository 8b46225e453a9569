"""Tables of FITS files by the rules of their columns, checksums."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data import schema
from walop_jax.data.records import FilterCurve
from walop_jax.data.units import Place

_CODES = {"int": "J", "float": "D", "bool": "L"}


def sign_and_write(hdus: list[Any], path: Path) -> None:
    """Add checksums to HDUs and write them to a file that may be there already (a temporary one)."""
    for hdu in hdus:
        # astropy would note the date in the comments: then equal sets would be unequal files.
        hdu.add_checksum(when="FITS checksum of this extension")
    fits.HDUList(hdus).writeto(path, overwrite=True, output_verify="exception")


def set_table_hdu(name: str, columns: Mapping[str, np.ndarray], path: object) -> fits.BinTableHDU:
    """A table of a calibration set."""
    rules = schema.table_rules(name, list(columns), Place(path, name))
    return table_hdu(name, columns, path, rules)


def filter_columns(filters: Mapping[str, FilterCurve]) -> dict[str, np.ndarray]:
    """The columns of a FILTERS table, padded with NaN."""
    longest = max(len(curve.wavelength) for curve in filters.values())
    columns = {name: np.full((len(filters), longest), np.nan) for name in ("WAVELENGTH", "THROUGHPUT")}
    for row, curve in enumerate(filters.values()):
        columns["WAVELENGTH"][row, : len(curve.wavelength)] = curve.wavelength
        columns["THROUGHPUT"][row, : len(curve.throughput)] = curve.throughput
    return {"FILTER": np.array(list(filters)), **columns}


def table_hdu(
    name: str, columns: Mapping[str, np.ndarray], path: object, rules: Mapping[str, schema.Column]
) -> fits.BinTableHDU:
    """A binary table by its rules, columns with a default optional; `DataError`, at `path`, for text beyond ASCII."""
    made = []
    for column, rule in rules.items():
        if column not in columns and rule.missing is not None:
            continue
        values = columns[column]
        if rule.kind == "str":
            for value in np.unique(values):
                check_ascii(str(value), column, Place(path, name))
            code = f"{max(1, values.dtype.itemsize // 4)}A"
        else:
            width = 1 if values.ndim == 1 else values.shape[1]
            code = f"{width if width > 1 else ''}{_CODES[rule.kind]}"
            if rule.kind == "int" and np.any(np.abs(values) > 2**31 - 1):
                code = "K"
        made.append(fits.Column(name=column, format=code, unit=rule.unit or None, array=values))
    return fits.BinTableHDU.from_columns(made, name=name)


def check_ascii(value: str, column: str, place: Place) -> None:
    """Raise `DataError` for text that a FITS file cannot hold."""
    if not value.isascii() or not (value.isprintable() or not value):
        raise place.fail(f"{value!r} is not plain ASCII", column, "FITS has no other letters: rename it")

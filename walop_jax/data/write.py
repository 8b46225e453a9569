"""Writing calibration sets as tables.

The extension COMPRESSION describes the whole frames for whose pixels a calibration set stands
(docs: files).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data import schema
from walop_jax.data.checks import instrument_name
from walop_jax.data.frames import Grid
from walop_jax.data.records import CalibrationSet, Compression, FilterCurve, InputFile
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.units import Place
from walop_jax.io.atomic import atomic_path

EXTENSION = "COMPRESSION"
MOST_EXPOSURES = 1_000_000  # of a run that a header may claim


def compression_hdu(found: Compression, path: object) -> fits.BinTableHDU:
    """The extension of a record."""
    columns = {"NAME": np.array(list(found.values), "U"), "VALUE": np.array(list(found.values.values()))}
    rules = {"NAME": schema.Column("str"), "VALUE": schema.Column("float")}
    hdu = table_hdu(EXTENSION, columns, path, rules)
    hdu.header["NPIXELS"] = (found.pixels, "pixels that the field points stand for")
    hdu.header["CHI2"] = (found.chi2, "chi-square of the pixels at these values")
    hdu.header["DOF"] = (found.dof, "its degrees of freedom")
    if found.gain is not None and found.response is not None:
        hdu.header["STRUCTG"] = (found.gain, "rms gain of a camera at a pixel")
        hdu.header["STRUCTR"] = (found.response, "rms response of a camera to q, u there")
    if found.exposures is not None:
        hdu.header["EXPOSURE"] = _in_runs(found.exposures)
    for number, entry in enumerate(found.frames, start=1):
        hdu.header[f"FILE{number}"] = str(entry.path.name)
        hdu.header[f"SHA{number}"] = entry.sha256
    return hdu


def read_compression(hdu: Any, path: Path) -> Compression:
    """The record of an extension; `DataError` for one that lacks something."""
    place, header = Place(path, EXTENSION), hdu.header
    for name in ("NPIXELS", "CHI2", "DOF"):
        if _asked(header, name) is None:
            raise place.fail("is missing or no number", name, "compress the frames again")
    names = [name.upper() for name in getattr(getattr(hdu, "columns", None), "names", [])]
    if sorted(names) != ["NAME", "VALUE"]:
        raise place.fail("has not the columns NAME and VALUE", advice="compress the frames again")
    values = np.asarray(hdu.data["VALUE"], float)
    if not np.isfinite(values).all():
        raise place.fail("is not finite", "VALUE", "compress the frames again")
    frames = []
    while f"SHA{len(frames) + 1}" in header:
        number = len(frames) + 1
        frames.append(InputFile(Path(str(header.get(f"FILE{number}", ""))), str(header[f"SHA{number}"])))
    return Compression(
        pixels=int(header["NPIXELS"]),
        chi2=float(header["CHI2"]),
        dof=int(header["DOF"]),
        values={
            str(name).strip(): float(value) for name, value in zip(hdu.data["NAME"], values, strict=True)
        },
        frames=tuple(frames),
        gain=_asked(header, "STRUCTG"),
        response=_asked(header, "STRUCTR"),
        exposures=None if "EXPOSURE" not in header else _of_runs(header["EXPOSURE"], place),
    )


def _in_runs(numbers: Iterable[int]) -> str:
    """Whole numbers as runs, the first and the last of each: "0:23,40:41"."""
    ordered = np.unique(np.array([*numbers], int))
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    return ",".join(f"{run[0]}:{run[-1]}" for run in runs if len(run))


def _of_runs(text: object, place: Place) -> tuple[int, ...]:
    """The whole numbers of runs; `DataError` for texts that are none."""
    runs = [re.fullmatch(r"(-?\d{1,18}):(-?\d{1,18})", run) for run in str(text).strip().split(",")]
    ends = [(int(run[1]), int(run[2])) for run in runs if run]
    if len(ends) < len(runs) or any(not 0 <= last - first < MOST_EXPOSURES for first, last in ends):
        raise place.fail(
            f"is {text!r}, not runs of numbers like 0:23", "EXPOSURE", "compress the frames again"
        )
    return tuple(number for first, last in ends for number in range(first, last + 1))


def _asked(header: Any, name: str) -> float | None:
    """A number of the header; None where it is missing."""
    value = header.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def remark(found: Compression, points: int) -> str:
    """Caution about a set that stands for pixels."""
    return (
        f"{points} field points stand for {found.pixels:,} pixels, of which χ²/dof was "
        f"{found.chi2 / max(found.dof, 1):.5g}: structure below a twentieth of the field is not seen here"
    )


# -------------------------------------------------------------------------------------------------- tables

_CODES = {"int": "J", "float": "D", "bool": "L"}


def write_calibration_set(
    path: str | os.PathLike[str], calset: CalibrationSet, *, overwrite: bool = False
) -> None:
    """Write a calibration set as tables, with checksums; the file appears whole or not at all.

    Data that were read come back bit for bit, rows that are not used included; other intensities (frames, say)
    are written as their used rows. The bytes depend on the set alone, not on the day.

    Raises `DataError` if the file exists and `overwrite` is False, if the folder is missing or read-only,
    and if a name cannot be written in FITS (ASCII only).

    >>> walop.write_calibration_set("copy.fits", calset)
    """
    with atomic_path(path, overwrite=overwrite) as temporary:
        hdus: list[Any] = [_primary(calset, path)]
        for name, columns in set_tables(calset).items():
            hdus.append(set_table_hdu(name, columns, path))
        if calset.compression is not None:
            hdus.append(compression_hdu(calset.compression, path))
        sign_and_write(hdus, temporary)


def set_tables(calset: CalibrationSet) -> dict[str, dict[str, np.ndarray]]:
    """The tables of a calibration set by name, columns by name; without those of the standards where there are none."""
    points, sources = calset.points, calset.sources
    intensities = TableIntensities.of(calset.intensities, points)
    tables = {
        "EXPOSURES": calset.exposures.columns(),
        "POINTS": {"POINT": points.point, "X": points.x, "Y": points.y},
        "INTENSITIES": {
            "EXPOSURE": calset.exposures.exposure[intensities.exposure],
            "POINT": points.point[intensities.point],
            # The appended −1 is the entry of a row without a source (−1, the last entry).
            "SOURCE": np.append(sources.source, -1)[intensities.source],
            "N": intensities.counts,
            "N_ERR": intensities.sigma,
            "FLAG": intensities.flag,
        },
    }
    if intensities.sky is not None:
        tables["INTENSITIES"]["SKY"] = intensities.sky
    if len(sources):
        tables["SOURCES"] = sources.columns()
    if calset.filters:
        tables["FILTERS"] = filter_columns(calset.filters)
    return tables


def sign_and_write(hdus: list[Any], path: Path) -> None:
    """Add checksums to HDUs and write them to a file that may be there already (a temporary one)."""
    for hdu in hdus:
        # astropy would note the date in the comments: then equal sets would be unequal files.
        hdu.add_checksum(when="FITS checksum of this extension")
    fits.HDUList(hdus).writeto(path, overwrite=True, output_verify="exception")


def _primary(calset: CalibrationSet, path: object) -> fits.PrimaryHDU:
    primary, site, place = fits.PrimaryHDU(), calset.site, Place(path, "PRIMARY")
    instrument_name(calset.instrument, place)
    cards = {
        "TELESCOP": (site.telescope, ""),
        "INSTRUME": (calset.instrument, ""),
        "CALVERS": (schema.CALVERS, "version of the calibration set format"),
        "SITELAT": (site.latitude, "[deg] latitude"),
        "SITELONG": (site.longitude, "[deg] longitude, east positive"),
        "SITEELEV": (site.elevation, "[m] elevation"),
        "ORIGIN": (calset.origin, ""),
    }
    for name, (value, comment) in cards.items():
        if isinstance(value, str):
            _ascii(value, name, place)
        elif not np.isfinite(value):
            continue  # FITS headers know no NaN; a missing card is read as one
        primary.header[name] = (value, comment)
    return primary


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
    """A binary table by its rules; columns that have a default may be left out.

    Raises `DataError`, naming `path`, for text that is not plain ASCII.
    """
    fits_columns = []
    for column, rule in rules.items():
        if column not in columns and rule.missing is not None:
            continue
        values = columns[column]
        if rule.kind == "str":
            for value in np.unique(values):
                _ascii(str(value), column, Place(path, name))
            code = f"{max(1, values.dtype.itemsize // 4)}A"
        else:
            width = 1 if values.ndim == 1 else values.shape[1]
            code = f"{width if width > 1 else ''}{_CODES[rule.kind]}"
            if rule.kind == "int" and np.any(np.abs(values) > 2**31 - 1):
                code = "K"
        fits_columns.append(fits.Column(name=column, format=code, unit=rule.unit or None, array=values))
    return fits.BinTableHDU.from_columns(fits_columns, name=name)


def _ascii(value: str, column: str, place: Place) -> None:
    if not value.isascii() or not (value.isprintable() or not value):
        raise place.fail(f"{value!r} is not plain ASCII", column, "FITS knows no other letters: rename it")


def grid_cards(grid: Grid) -> dict[str, str | float]:
    """The header cards of the linear field coordinates of an image."""
    cards: dict[str, str | float] = {}
    for n, axis in enumerate("XY"):
        cards |= {f"CTYPE{n + 1}": axis, f"CUNIT{n + 1}": "deg"}
        cards |= {f"CRPIX{n + 1}": grid.reference[n], f"CRVAL{n + 1}": grid.value[n]}
        cards |= {f"CD{n + 1}_{m + 1}": grid.matrix[n][m] for m in range(2)}
    return cards

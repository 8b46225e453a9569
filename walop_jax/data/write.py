"""Writing calibration sets as tables.

The extension STRUCTURE is that of a set that was made of whole frames: structure finer than its points (docs: files).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data import schema
from walop_jax.data.checks import instrument_name
from walop_jax.data.hdus import check_ascii, filter_columns, set_table_hdu, sign_and_write, table_hdu
from walop_jax.data.records import ERROR_WORDS, CalibrationSet, FineStructure
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.units import Place
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import PathLike

STRUCTURE = "STRUCTURE"
_RULES = {
    "X": schema.Column("float", "deg"),
    "Y": schema.Column("float", "deg"),
    "GAIN2": schema.Column("float"),
    "GAIN2_ERR": schema.Column("float"),
}


def _structure_hdu(found: FineStructure, path: object) -> fits.BinTableHDU:
    """The extension of the structure of whole frames."""
    columns = {"X": found.x, "Y": found.y, "GAIN2": found.gain, "GAIN2_ERR": found.error}
    return table_hdu(STRUCTURE, columns, path, _RULES)


def read_structure(hdu: Any, cameras: int, path: Path) -> FineStructure:
    """The structure of whole frames of an extension; `DataError` for one that lacks something."""
    place, again = Place(path, STRUCTURE), "write the set again, from the frames"
    names = [name.upper() for name in getattr(getattr(hdu, "columns", None), "names", [])]
    if missing := [name for name in _RULES if name not in names]:
        raise place.fail(f"has no column {missing[0]}", advice=again)
    x, y, gain, error = (np.asarray(hdu.data[name], float) for name in _RULES)
    if not gain.shape == error.shape == (len(x), cameras):
        what = f"has values of shape {gain.shape}, errors of {error.shape}, for {len(x)} places and {cameras} cameras"
        raise place.fail(what, "GAIN2", again)
    if not (np.isfinite([x, y]).all() and np.isfinite([gain, error]).all() and (error > 0).all()):
        raise place.fail(
            "holds numbers that are not finite, or errors that are not positive", "GAIN2_ERR", again
        )
    return FineStructure(x, y, gain, error)


# -------------------------------------------------------------------------------------------------- tables


def write_calibration_set(path: PathLike, calset: CalibrationSet, *, overwrite: bool = False) -> None:
    """Write a calibration set as tables, with checksums; the file appears whole or not at all.

    Data that were read come back bit for bit, rows that are not used included; other intensities are
    written as their used rows. The bytes depend on the set alone, not on the day.

    Raises `DataError` if the file exists and `overwrite` is False, if the folder is missing or read-only,
    and if a name cannot be written in FITS (ASCII only).

    >>> walop.write_calibration_set("copy.fits", calset)
    """
    with atomic_path(path, overwrite=overwrite) as temporary:
        tables = set_tables(calset).items()
        hdus: list[Any] = [_primary(calset, path), *(set_table_hdu(*table, path) for table in tables)]
        if calset.fine is not None:
            hdus.append(_structure_hdu(calset.fine, path))
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
            check_ascii(value, name, place)
        elif not np.isfinite(value):
            continue  # FITS headers know no NaN; a missing card is read as one
        primary.header[name] = (value, comment)
    for name, value in calset.stated_errors.stated.items():
        word, unit, *_ = ERROR_WORDS[name]
        primary.header[word] = (value, f"{f'[{unit}] ' if unit else ''}standard error")
    return primary

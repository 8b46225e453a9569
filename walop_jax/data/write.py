"""Writing calibration sets as tables.

The extension COMPRESSION describes the whole frames for whose pixels a calibration set stands
(docs: files).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data import schema
from walop_jax.data.checks import instrument_name
from walop_jax.data.hdus import check_ascii, filter_columns, set_table_hdu, sign_and_write, table_hdu
from walop_jax.data.records import ERROR_WORDS, CalibrationSet, Compression, InputFile
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.units import Place
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import PathLike

EXTENSION, _AGAIN = "COMPRESSION", "compress the frames again"
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
        ordered = np.unique(np.array([*found.exposures], int))
        runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
        hdu.header["EXPOSURE"] = ",".join(f"{run[0]}:{run[-1]}" for run in runs if len(run))
    for number, entry in enumerate(found.frames, start=1):
        hdu.header[f"FILE{number}"] = str(entry.path.name)
        hdu.header[f"SHA{number}"] = entry.sha256
    return hdu


def read_compression(hdu: Any, path: Path) -> Compression:
    """The record of an extension; `DataError` for one that lacks something."""
    place, header = Place(path, EXTENSION), hdu.header
    for name in ("NPIXELS", "CHI2", "DOF"):
        if _asked(header, name) is None:
            raise place.fail("is missing or no number", name, _AGAIN)
    names = [name.upper() for name in getattr(getattr(hdu, "columns", None), "names", [])]
    if sorted(names) != ["NAME", "VALUE"]:
        raise place.fail("has not the columns NAME and VALUE", advice=_AGAIN)
    values = np.asarray(hdu.data["VALUE"], float)
    if not np.isfinite(values).all():
        raise place.fail("is not finite", "VALUE", _AGAIN)
    frames = []
    while f"SHA{len(frames) + 1}" in header:
        number = len(frames) + 1
        frames.append(InputFile(Path(str(header.get(f"FILE{number}", ""))), str(header[f"SHA{number}"])))
    by_name = zip(hdu.data["NAME"], values.tolist(), strict=True)
    return Compression(
        pixels=int(header["NPIXELS"]),
        chi2=float(header["CHI2"]),
        dof=int(header["DOF"]),
        values={str(name).strip(): value for name, value in by_name},
        frames=tuple(frames),
        gain=_asked(header, "STRUCTG"),
        response=_asked(header, "STRUCTR"),
        exposures=None if "EXPOSURE" not in header else _of_runs(header["EXPOSURE"], place),
    )


def _of_runs(text: object, place: Place) -> tuple[int, ...]:
    """The whole numbers of runs, "0:23,40:41"; `DataError` for texts that are none."""
    runs = [re.fullmatch(r"(-?\d{1,18}):(-?\d{1,18})", run) for run in str(text).strip().split(",")]
    ends = [(int(run[1]), int(run[2])) for run in runs if run]
    if len(ends) < len(runs) or any(not 0 <= last - first < MOST_EXPOSURES for first, last in ends):
        raise place.fail(f"is {text!r}, not runs of numbers like 0:23", "EXPOSURE", _AGAIN)
    return tuple(number for first, last in ends for number in range(first, last + 1))


def _asked(header: Any, name: str) -> float | None:
    """A number of the header; None where it is missing."""
    value = header.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def remark(found: Compression, points: int) -> str:
    """Caution about a set that stands for pixels."""
    what = f"{points} field points stand for {found.pixels:,} pixels, of which χ²/dof was"
    ratio = found.chi2 / max(found.dof, 1)
    return f"{what} {ratio:.5g}: structure below a twentieth of the field is not seen here"


# -------------------------------------------------------------------------------------------------- tables


def write_calibration_set(path: PathLike, calset: CalibrationSet, *, overwrite: bool = False) -> None:
    """Write a calibration set as tables, with checksums; the file appears whole or not at all.

    Data that were read come back bit for bit, rows that are not used included; other intensities (frames, say)
    are written as their used rows. The bytes depend on the set alone, not on the day.

    Raises `DataError` if the file exists and `overwrite` is False, if the folder is missing or read-only,
    and if a name cannot be written in FITS (ASCII only).

    >>> walop.write_calibration_set("copy.fits", calset)
    """
    with atomic_path(path, overwrite=overwrite) as temporary:
        tables = set_tables(calset).items()
        hdus: list[Any] = [_primary(calset, path), *(set_table_hdu(*table, path) for table in tables)]
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

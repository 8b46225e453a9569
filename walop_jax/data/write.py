"""Writing calibration sets: tables as the format has them, and whole frames slab by slab.

The extension COMPRESSION says of a calibration set that stands for the pixels of whole frames, what they were.

A table NAME, VALUE of the model's parameters at which the pixels were summed; in its header NPIXELS, CHI2 and DOF of
the pixels there, and the frames, FILE1, SHA1, …; STRUCTG and STRUCTR, by how much single pixels differ (docs: files).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data import schema
from walop_jax.data.checks import instrument_name, oldest_version
from walop_jax.data.frames import Grid, count_names, error_names
from walop_jax.data.records import CalibrationSet, Compression, DataFlag, Exposures, FilterCurve, InputFile
from walop_jax.data.schema import Place
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import checksum_text, data_sum, padded

EXTENSION = "COMPRESSION"


def compression_hdu(found: Compression) -> fits.BinTableHDU:
    """The extension of a record."""
    names = np.array(list(found.values), dtype="U")
    hdu = fits.BinTableHDU.from_columns(
        [
            fits.Column(name="NAME", format=f"{max(1, names.dtype.itemsize // 4)}A", array=names),
            fits.Column(name="VALUE", format="D", array=np.array(list(found.values.values()))),
        ],
        name=EXTENSION,
    )
    hdu.header["NPIXELS"] = (found.pixels, "pixels that the field points stand for")
    hdu.header["CHI2"] = (found.chi2, "chi-square of the pixels at these values")
    hdu.header["DOF"] = (found.dof, "its degrees of freedom")
    if found.gain is not None and found.response is not None:
        hdu.header["STRUCTG"] = (found.gain, "rms gain of a camera at a pixel")
        hdu.header["STRUCTR"] = (found.response, "rms response of a camera to q, u there")
    for number, entry in enumerate(found.frames, start=1):
        hdu.header[f"FILE{number}"] = str(entry.path.name)
        hdu.header[f"SHA{number}"] = entry.sha256
    return hdu


def read_compression(hdu: Any, path: Path) -> Compression:
    """The record of an extension; `DataError` for one that lacks something."""
    place, header = Place(path, EXTENSION), hdu.header
    for name in ("NPIXELS", "CHI2", "DOF"):
        if not isinstance(header.get(name), int | float) or isinstance(header.get(name), bool):
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
    )


def _asked(header: Any, name: str) -> float | None:
    """A number of the header; None where it is missing."""
    value = header.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def remark(found: Compression, points: int) -> str:
    """Caution about a set that stands for pixels."""
    return (
        f"{points} field points stand for {found.pixels:,} pixels, of which χ²/dof was "
        f"{found.chi2 / max(found.dof, 1):.5g}: what is smaller than a twentieth of the field is not seen here"
    )


# ---------------------------------------------------------------------------------------------------- tables and frames

_CODES = {"int": "J", "float": "D", "bool": "L"}
_SLAB = 1 << 18  # (exposure, pixel) pairs that are written at a time


def write_calibration_set(
    path: str | os.PathLike[str], calset: CalibrationSet, *, overwrite: bool = False
) -> None:
    """Write a calibration set as tables, with checksums; the file appears whole or not at all.

    What was read comes back bit for bit, rows that are not used included; other intensities (frames, say)
    are written as their used rows. The bytes depend on the set alone, not on the day. CALVERS is the oldest
    version of the format that can hold the set.

    Raises `DataError` if the file exists and `overwrite` is False, if the folder is missing or read-only,
    and if a name cannot be written in FITS (ASCII only).

    >>> walop.write_calibration_set("copy.fits", calset)
    """
    with atomic_path(path, overwrite=overwrite) as temporary:
        sign_and_write(_hdus(calset, set_tables(calset), path), temporary)


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
            # The appended −1 is what a row without a source (−1, the last entry) becomes.
            "SOURCE": np.append(sources.source, -1)[intensities.source],
            "N": intensities.counts,
            "N_ERR": intensities.sigma,
            "FLAG": intensities.flag,
        },
    }
    return tables | _optional_tables(calset)


def _optional_tables(calset: CalibrationSet) -> dict[str, dict[str, np.ndarray]]:
    tables = {}
    if len(calset.sources):
        tables["SOURCES"] = {name: getattr(calset.sources, name.lower()) for name in schema.SOURCES}
    if calset.filters:
        tables["FILTERS"] = filter_columns(calset.filters)
    return tables


def sign_and_write(hdus: list[Any], path: Path) -> None:
    """Add checksums to HDUs and write them to a file that may be there already (a temporary one)."""
    for hdu in hdus:
        # astropy would note the date in the comments: then equal sets would be unequal files.
        hdu.add_checksum(when="FITS checksum of this extension")
    fits.HDUList(hdus).writeto(path, overwrite=True, output_verify="exception")


def _primary(calset: CalibrationSet, version: int, path: object) -> fits.PrimaryHDU:
    primary = fits.PrimaryHDU()
    site = calset.site
    instrument_name(calset.instrument, version, schema.Place(path, "PRIMARY"))
    cards = {
        "TELESCOP": (site.telescope, "telescope"),
        "INSTRUME": (calset.instrument, "instrument"),
        "CALVERS": (version, "version of the calibration set format"),
        "SITELAT": (site.latitude, "[deg] latitude"),
        "SITELONG": (site.longitude, "[deg] longitude, east positive"),
        "SITEELEV": (site.elevation, "[m] elevation"),
        "ORIGIN": (calset.origin, "who made these data"),
    }
    for name, (value, comment) in cards.items():
        if isinstance(value, str):
            _ascii(value, f"PRIMARY] {name}", path)
        elif not np.isfinite(value):
            continue  # FITS headers know no NaN; a missing card is read as one
        primary.header[name] = (value, comment if not isinstance(value, str) else "")
    return primary


def _hdus(calset: CalibrationSet, tables: Mapping[str, Mapping[str, np.ndarray]], path: object) -> list[Any]:
    """The primary header of a set, some of its tables, and what it stands for."""
    version = oldest_version(calset.instrument, calset.exposures, calset.cameras)
    made: list[Any] = [_primary(calset, version, path)]
    for name, columns in tables.items():
        rules = schema.table_rules(name, version, list(columns), schema.Place(path, name))
        made.append(table_hdu(name, columns, path, rules))
    return made if calset.compression is None else [*made, compression_hdu(calset.compression)]


def exposures_hdu(exposures: Exposures, version: int, path: object) -> fits.BinTableHDU:
    """The EXPOSURES table in a version of the calibration set format."""
    columns = exposures.columns()
    rules = schema.table_rules("EXPOSURES", version, list(columns), schema.Place(path, "EXPOSURES"))
    return table_hdu("EXPOSURES", columns, path, rules)


def filter_columns(filters: Mapping[str, FilterCurve]) -> dict[str, np.ndarray]:
    """The columns of a FILTERS table, padded with NaN."""
    longest = max(len(curve.wavelength) for curve in filters.values())
    columns = {name: np.full((len(filters), longest), np.nan) for name in ("WAVELENGTH", "THROUGHPUT")}
    for row, curve in enumerate(filters.values()):
        columns["WAVELENGTH"][row, : len(curve.wavelength)] = curve.wavelength
        columns["THROUGHPUT"][row, : len(curve.throughput)] = curve.throughput
    return {"FILTER": np.array(list(filters)), **columns}


def table_hdu(
    name: str,
    columns: Mapping[str, np.ndarray],
    path: object,
    rules: Mapping[str, schema.Column] | None = None,
) -> fits.BinTableHDU:
    """A binary table by its rules (default: those of the calibration set's table of that name).

    Raises `DataError`, naming `path`, for text that is not plain ASCII.
    """
    made = []
    for column, rule in (schema.TABLES[name] if rules is None else rules).items():
        values = columns[column]
        if rule.kind == "str":
            for value in np.unique(values):
                _ascii(str(value), f"{name}] {column}", path)
            code = f"{max(1, values.dtype.itemsize // 4)}A"
        else:
            width = 1 if values.ndim == 1 else values.shape[1]
            code = f"{width if width > 1 else ''}{_CODES[rule.kind]}"
            if rule.kind == "int" and np.any(np.abs(values) > 2**31 - 1):
                code = "K"
        made.append(fits.Column(name=column, format=code, unit=rule.unit or None, array=values))
    return fits.BinTableHDU.from_columns(made, name=name)


def _ascii(value: str, where: str, path: object) -> None:
    if not value.isascii() or not (value.isprintable() or not value):
        extension, _, column = where.partition("] ")
        raise fail(
            f"{value!r} is not plain ASCII",
            file=path,
            extension=extension,
            column=column,
            advice="FITS knows no other letters: rename it",
        )


def write_frames(
    path: str | os.PathLike[str],
    calset: CalibrationSet,
    grid: Grid,
    *,
    dtype: str = "f4",
    overwrite: bool = False,
) -> None:
    """Write a calibration set as whole frames, never holding more than a slab of them in memory.

    The points of `calset` must be the pixels of `grid`, row by row; its `intensities.block` is asked for some
    image rows at a time. Pixels without a measurement get bit 2 (bad pixel) of the FLAG image. `dtype` is
    `f4` or `f8`. The images carry checksums too.

    Raises `DataError` as `write_calibration_set` does, and if points and grid differ in number.
    """
    if len(calset.points) != grid.pixels:
        raise fail(
            f"{len(calset.points)} points for {grid.width} × {grid.height} pixels",
            file=path,
            advice="one per pixel",
        )
    shape = (len(calset.exposures), grid.height, grid.width)
    counts, errors = count_names(calset.cameras), error_names(calset.cameras)
    kinds = dict.fromkeys((*counts, *errors), np.dtype(f">{dtype}")) | {"FLAG": np.dtype(">i2")}
    with atomic_path(path, overwrite=overwrite) as temporary:
        tables = {"EXPOSURES": calset.exposures.columns()} | _optional_tables(calset)
        sign_and_write(_hdus(calset, tables, path), temporary)
        cubes: dict[str, tuple[np.memmap[Any, Any], int]] = {}
        for name, kind in kinds.items():
            cubes[name] = _append_image(temporary, name, kind, shape, grid)
        step = max(1, _SLAB // (shape[0] * grid.width))
        for top in range(0, grid.height, step):
            bottom = min(top + step, grid.height)
            block = calset.intensities.block(top * grid.width, bottom * grid.width)
            planes = (shape[0], bottom - top, grid.width)
            for k in range(calset.cameras):
                cubes[counts[k]][0][:, top:bottom] = block.counts[..., k].T.reshape(planes)
                cubes[errors[k]][0][:, top:bottom] = block.sigma[..., k].T.reshape(planes)
            flag = np.where(block.used.T, 0, DataFlag.BAD_PIXEL)
            cubes["FLAG"][0][:, top:bottom] = flag.reshape(planes)
        for cube, start in cubes.values():
            cube.flush()
            _sign_image(temporary, start, cube)


def grid_cards(grid: Grid) -> dict[str, str | float]:
    """The header cards of the linear field coordinates of an image."""
    cards: dict[str, str | float] = {}
    for n, axis in enumerate("XY"):
        cards |= {f"CTYPE{n + 1}": axis, f"CUNIT{n + 1}": "deg"}
        cards |= {f"CRPIX{n + 1}": grid.reference[n], f"CRVAL{n + 1}": grid.value[n]}
        cards |= {f"CD{n + 1}_{m + 1}": grid.matrix[n][m] for m in range(2)}
    return cards


def _append_image(
    path: Path, name: str, kind: np.dtype[Any], shape: tuple[int, int, int], grid: Grid
) -> tuple[np.memmap[Any, Any], int]:
    """Add the header and the room of an image to a file; return the mapped room and the header's place."""
    header = fits.Header()
    header["XTENSION"] = "IMAGE"
    header["BITPIX"] = 16 if kind.kind == "i" else -8 * kind.itemsize
    header["NAXIS"] = 3
    for axis, length in enumerate(reversed(shape), start=1):
        header[f"NAXIS{axis}"] = length
    header["PCOUNT"], header["GCOUNT"], header["EXTNAME"] = 0, 1, name
    header.update(grid_cards(grid))
    if name != "FLAG":
        header["BUNIT"] = "electron"
    header["CHECKSUM"], header["DATASUM"] = "0" * 16, "0".rjust(10)
    text = header.tostring().encode("ascii")
    start = path.stat().st_size
    with path.open("r+b") as stream:
        stream.seek(start)
        stream.write(text)
        stream.truncate(start + len(text) + padded(int(np.prod(shape)) * kind.itemsize))
    return np.memmap(path, kind, mode="r+", offset=start + len(text), shape=shape), start


def _sign_image(path: Path, start: int, cube: np.memmap[Any, Any]) -> None:
    """Put the sums of an image into the cards that were kept free for them."""
    total = data_sum(path, int(cube.offset), padded(cube.nbytes))
    with path.open("r+b") as stream:
        stream.seek(start)
        header = fits.Header.fromstring(stream.read(int(cube.offset) - start).decode("ascii"))
        header["DATASUM"] = str(total).rjust(10)
        header["CHECKSUM"] = checksum_text(header.tostring().encode("ascii"), total)
        stream.seek(start)
        stream.write(header.tostring().encode("ascii"))

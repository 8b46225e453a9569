"""Reading a calibration set: one or several files in, one checked `CalibrationSet` out."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.data import schema
from walop_jax.data.checks import (
    instrument_name,
    make_exposures,
    make_filters,
    make_points,
    make_sources,
)
from walop_jax.data.compression import EXTENSION, read_compression, remark
from walop_jax.data.filters import builtin_filter
from walop_jax.data.frames import FrameIntensities, frame_stack, image_names
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.plausibility import doubts_about
from walop_jax.data.records import (
    KINDS,
    CalibrationSet,
    Exposures,
    FilterCurve,
    InputFile,
    Intensities,
    Points,
    Site,
    Sources,
)
from walop_jax.data.repeats import check_repeats
from walop_jax.data.schema import CALVERS, Place, column_names, read_table, table_rules
from walop_jax.data.table_intensities import TableIntensities, mask_repeats, table_intensities, usable
from walop_jax.io.errors import DataError, fail, nearest
from walop_jax.io.fits_reading import UNREADABLE, OpenFile, one_line, open_fits

_IMAGE = re.compile(r"[NE](0|[1-9][0-9]{0,2})")  # of one camera: counts or errors
_NO_SETS = (".csv", ".ecsv", ".txt", ".dat", ".vot", ".xml", ".json", ".toml", ".nc", ".npz", ".h5")
_SAMPLE = 8  # image rows looked at when frames are opened; every block is checked again as it is read


def read_calibration_set(*paths: str | os.PathLike[str], kinds: Collection[str] = ()) -> CalibrationSet:
    """Read and check one calibration set, merging several files into one.

    Whole frames are not read, only described; their blocks are checked as they are read. What was odd but
    harmless (unknown columns, masked rows, …) stands in `remarks`. `kinds` are kinds of exposures beyond `KINDS`
    that sets of version 2 may have, for sources of the caller's own.

    Raises `DataError` that names file, extension, column and row for anything that cannot be trusted.
    """
    if not paths:
        raise fail("no file was given", advice="name at least one calibration set")
    sets: list[CalibrationSet] = []
    for path in paths:
        one = _read_one(Path(path), kinds)
        known = {entry.inputs[0].sha256: entry.inputs[0].path for entry in sets}
        if one.inputs[0].sha256 in known:
            raise fail(
                f"has the same bytes as {known[one.inputs[0].sha256]}",
                file=path,
                advice="name each file once: repeated data would shrink the errors",
            )
        sets.append(one)
    return sets[0] if len(sets) == 1 else merge_calibration_sets(*sets)


def _read_one(path: Path, kinds: Collection[str]) -> CalibrationSet:
    if path.is_dir():
        raise fail("is a folder", file=path, advice="a calibration set is a FITS file; a RUN holds results")
    if path.suffix.lower() in _NO_SETS:
        advice = "a calibration set is a FITS file (walop-jax docs files); walop_jax.from_arrays makes one of arrays"
        raise fail("is not a calibration set", file=path, advice=advice)
    with open_fits(path) as opened:
        try:
            found = _from_hdus(opened, (*KINDS, *kinds))
        except DataError:
            raise
        except UNREADABLE as error:
            raise fail(
                f"cannot be read: {one_line(error)}", file=path, advice="write the file again"
            ) from error
    return dataclasses.replace(found, inputs=(InputFile(path, opened.sha256),))


def set_from_hdus(opened: OpenFile, kinds: Collection[str] = ()) -> CalibrationSet:
    """A calibration set from HDUs in memory, checked as a file is; `kinds` as for `read_calibration_set`."""
    return _from_hdus(opened, (*KINDS, *kinds))


def _from_hdus(opened: OpenFile, kinds: Collection[str]) -> CalibrationSet:
    path, remarks = opened.path, list(opened.remarks)
    primary = opened.hdus[0].header
    version, instrument, site = _header(primary, path)
    tables, images = _extensions(opened, version, remarks)

    def table(name: str) -> dict[str, Any]:
        if name not in tables:
            raise fail("the extension is missing", file=path, extension=name, advice="see the file format")
        place = Place(path, name)
        rules = table_rules(name, version, column_names(tables[name], place), place)
        columns, more = read_table(tables[name], rules, place)
        remarks.extend(more)
        return columns

    filters = make_filters(table("FILTERS"), Place(path, "FILTERS")) if "FILTERS" in tables else {}
    place = Place(path, "EXPOSURES")
    exposures = make_exposures(table("EXPOSURES"), filters, site, place, version=version, kinds=kinds)
    remarks.extend(doubts_about(instrument, site, exposures, place))
    sources = (
        make_sources(table("SOURCES"), Place(path, "SOURCES")) if "SOURCES" in tables else empty_sources()
    )
    if images:
        if "INTENSITIES" in tables:
            raise fail("has frames and a table of intensities", file=path, advice="use one file for each")
        if opened.compressed:
            raise fail("frames are read in slabs", file=path, advice="unpack the file with gunzip")
        intensities, points = _frames(images, exposures, instrument, version, path)
    else:
        points = make_points(table("POINTS"), instrument, Place(path, "POINTS"))
        place = Place(path, "INTENSITIES")
        intensities, more = table_intensities(table("INTENSITIES"), exposures, points, sources, place)
        intensities, repeated = mask_repeats(intensities, exposures, path)
        remarks.extend(more + repeated + _idle(intensities, exposures, path))
    compression = None if EXTENSION not in tables else read_compression(tables[EXTENSION], path)
    if compression is None:
        remarks.extend(check_repeats(intensities, exposures, points, path))
    found = CalibrationSet(
        instrument=instrument,
        site=site,
        origin=str(primary.get("ORIGIN", "")).strip(),
        exposures=exposures,
        points=points,
        sources=sources,
        filters=with_builtins(filters, exposures),
        intensities=intensities,
        remarks=tuple(remarks),
        compression=compression,
    )
    return found if compression is None else dataclasses.replace(found, remarks=(*remarks, remark(found)))


def _header(header: Any, path: Path) -> tuple[int, str, Site]:
    place = Place(path, "PRIMARY")
    version = header.get("CALVERS")
    if version is None:
        what = "a calibration product of a fit" if "PRODVERS" in header else "a calibration set"
        advice = (
            f"this is {what}: give the set that it was made from"
            if "PRODVERS" in header
            else f"is this {what}?"
        )
        raise place.fail("is missing", "CALVERS", advice)
    if isinstance(version, bool) or not isinstance(version, int) or not 1 <= version <= CALVERS:
        what = f"is {version!r}, this program reads up to {CALVERS}"
        raise place.fail(what, "CALVERS", "use a newer walop-jax")
    instrument = instrument_name(header.get("INSTRUME", ""), version, place)
    values: dict[str, float] = {}
    for name in ("SITELAT", "SITELONG", "SITEELEV"):
        value = header.get(name, float("nan"))
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise place.fail(f"is {value!r}, not a number", name, "degrees (east positive) and metres")
        values[name] = float(value)
    telescope = str(header.get("TELESCOP", "")).strip()
    site = Site(telescope, values["SITELAT"], values["SITELONG"], values["SITEELEV"])
    return version, instrument, site


def _extensions(opened: OpenFile, version: int, remarks: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Sort the extensions of a file by name into tables and images."""
    four = image_names(4)
    tables: dict[str, Any] = {}
    images: dict[str, Any] = {}
    for number, hdu in enumerate(opened.hdus[1:], start=1):
        name = hdu.name.strip().upper()
        image = name in four or (version > 1 and _IMAGE.fullmatch(name))
        kind = tables if name in (*schema.TABLES, EXTENSION) else images if image else None
        if kind is None:
            known = (*schema.TABLES, EXTENSION, *four)
            remarks.append(f"{opened.path} [{name or number}]: unknown extension ({nearest(name, known)})")
        elif name in kind:
            raise fail("is there twice", file=opened.path, extension=name, advice="remove one")
        else:
            kind[name] = hdu
    return tables, images


def empty_sources() -> Sources:
    """Return a table without sources."""
    none = np.zeros(0)
    return Sources(np.zeros(0, dtype=np.int64), np.zeros(0, dtype="U1"), none, none, none, none, none)


def with_builtins(filters: dict[str, FilterCurve], exposures: Exposures) -> dict[str, FilterCurve]:
    """Add the built-in curves that the exposures name and the file does not bring; a file's own win."""
    absent = {str(name) for name in exposures.filter} - set(filters)
    return filters | {name: builtin_filter(name) for name in sorted(absent)}


def _idle(intensities: TableIntensities, exposures: Exposures, path: Path) -> list[str]:
    idle = np.setdiff1d(np.arange(len(exposures)), intensities.exposure[intensities.used])
    names = ", ".join(str(entry) for entry in exposures.exposure[idle][:5]) + (" …" if len(idle) > 5 else "")
    return [f"{path} [INTENSITIES]: no used row for exposure(s) {names}"] if len(idle) else []


def _frames(
    images: dict[str, Any], exposures: Exposures, instrument: str, version: int, path: Path
) -> tuple[Intensities, Points]:
    """Describe frames, and look at a few rows of pixels for what is wrong everywhere."""
    if np.any(bad := (exposures.kind == "standard") & ~exposures.clp_in):
        raise fail(
            f"EXPOSURE {exposures.exposure[bad][0]} is a standard, and a pixel of a frame has no SOURCE",
            file=path,
            extension="EXPOSURES",
            column="KIND",
            advice="give standards in a table, in another file",
        )
    grid, stack = frame_stack(images, len(exposures), path, 4 if version == 1 else None)
    width, total = grid.width, grid.pixels
    corners = (0, width - 1, total - width, total - 1)
    x, y = (np.concatenate(parts) for parts in zip(*(grid.xy(n, n + 1) for n in corners), strict=True))
    make_points({"POINT": np.arange(4), "X": x, "Y": y}, instrument, Place(path, "N0"))
    intensities = FrameIntensities(grid, (stack,))
    place, last = Place(path, "N0"), intensities.cameras - 1
    sampled = [int(row) for row in np.unique(np.linspace(0, grid.height - 1, _SAMPLE).astype(int))]
    spoilt = number = 0
    lowest, highest = np.inf, -np.inf
    for row in sampled:
        counts, sigma, flag = intensities.read(stack, row * width, (row + 1) * width)
        used, bad, _ = usable(counts, sigma, flag)
        intensities.block(row * width, (row + 1) * width)  # refuses errors that are not positive
        spoilt, number = spoilt + int(bad.sum()), number + bad.size
        if np.any(used):
            values = counts[used]
            lowest, highest = min(lowest, values.min()), max(highest, values.max())
    if spoilt > 0.2 * number:
        raise place.fail(
            f"{100 * spoilt / number:.0f} % of the pixels looked at are not finite or far below zero",
            f"N0…N{last}, E0…E{last}",
            "repair the reduction, or set the FLAG image",
        )
    if lowest == highest and number > 1:
        raise place.fail(f"all counts are equal ({lowest:g})", f"N0…N{last}", "these are not measurements")
    return intensities, grid.points

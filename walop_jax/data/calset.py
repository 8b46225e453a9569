"""Reading a calibration set: one or several files in, one checked `CalibrationSet` out."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.data import checks, plausible, schema
from walop_jax.data.celestial import ICRS, made_icrs
from walop_jax.data.cells import cells_of
from walop_jax.data.frames import frames_of, image_names
from walop_jax.data.hdus import filter_columns
from walop_jax.data.kinds import CALIBRATION_PLATE, KINDS, POLARISER
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.records import (
    ERROR_WORDS,
    CalibrationSet,
    Exposures,
    FilterCurve,
    FineStructure,
    InputFile,
    Points,
    Site,
    Sources,
    StatedErrors,
)
from walop_jax.data.repeats import mask_repeats, repeated_counts
from walop_jax.data.settings import builtin_filter
from walop_jax.data.table_intensities import ONE_CAMERA, TableIntensities, table_intensities
from walop_jax.data.units import Place, check_units, unit_of
from walop_jax.data.write import STRUCTURE, read_structure, set_tables
from walop_jax.io.errors import PathLike, fail, nearest
from walop_jax.io.fits_reading import OpenFile, open_fits

_IMAGE = re.compile(r"[NE](0|[1-9][0-9]{0,2})")  # of one camera: counts or errors
_NO_SETS = (".csv", ".ecsv", ".txt", ".dat", ".vot", ".xml", ".json", ".toml", ".nc", ".npz", ".h5")
_NAN = float("nan")
_COMPRESSED = "COMPRESSION"  # extension of sets that stood for the pixels of frames near one set of values


def read_calibration_set(
    *paths: PathLike, kinds: Collection[str] = (), cells: int | None = None
) -> CalibrationSet:
    """Read and check one calibration set; several files become one set.

    Whole frames become field points, means over cells of their pixels: `cells` along the longer side (default: 80).
    Harmless oddities (unknown columns, masked rows, …) are listed in `remarks`. `kinds` are KINDs of exposures beyond
    `KINDS`, for sources of the caller's own.

    Raises `DataError` that names file, extension, column and row for anything that cannot be trusted.
    """
    if not paths:
        raise fail("no file was given", advice="name at least one calibration set")
    sets: dict[str, CalibrationSet] = {}
    for path in paths:
        calset = _read_one(Path(path), kinds, cells)
        if (same := sets.setdefault(calset.inputs[0].sha256, calset)) is not calset:
            advice = "name each file once: repeated data would shrink the errors"
            raise fail(f"has the same bytes as {same.inputs[0].path}", file=path, advice=advice)
    calsets = tuple(sets.values())
    return calsets[0] if len(calsets) == 1 else merge_calibration_sets(*calsets)


def _read_one(path: Path, kinds: Collection[str], cells: int | None) -> CalibrationSet:
    if path.is_dir():
        advice = f"a calibration set is a FITS file; walop-jax report {path} shows a folder of results"
        raise fail("is a folder", file=path, advice=advice)
    if path.suffix.lower() in _NO_SETS:
        advice = "a calibration set is a FITS file (walop-jax docs files); walop_jax.from_arrays makes one of arrays"
        raise fail("is not a calibration set", file=path, advice=advice)
    with open_fits(path, "write the file again") as opened:
        calset = _from_hdus(opened, (*KINDS, *kinds), cells)
    return dataclasses.replace(calset, inputs=(InputFile(path, opened.sha256),))


def _from_hdus(opened: OpenFile, kinds: Collection[str], cells: int | None) -> CalibrationSet:
    path, remarks = opened.path, list(opened.remarks)
    primary = opened.hdus[0].header
    instrument, site = _header(primary, path)
    hdus, images = _extensions(opened, remarks)
    if images and "INTENSITIES" in hdus:
        raise fail("has frames and a table of intensities", file=path, advice="use one file for each")
    if images and opened.compressed:
        raise fail("frames are read some rows at a time", file=path, advice="unpack the file with gunzip")
    if _COMPRESSED in hdus:
        what = "the field points stand for pixels near values of another fit; such sets are no longer read"
        advice = "give the frames of which it was made: they are read as cells, for any fit"
        raise fail(what, file=path, extension=_COMPRESSED, advice=advice)
    tables = {}
    remarks += _unused_words(opened, hdus)
    for name in ("EXPOSURES", *(() if images else ("POINTS", "INTENSITIES")), "FILTERS", "SOURCES"):
        place = Place(path, name)
        if name in hdus:
            columns = schema.column_names(hdus[name], place)
            # CLP and CHWP alone move, whatever else is there.
            if primary["CALVERS"] == 1 and name == "EXPOSURES":
                turns = [f"{prefix}_TURN" for prefix in (POLARISER, CALIBRATION_PLATE)]
                columns = [column for column in columns if column in {*schema.EXPOSURES, *turns}]
            rules = schema.table_rules(name, columns, place)
            tables[name], odd = schema.read_table(hdus[name], rules, place)
            remarks += odd
            if name == "EXPOSURES":
                remarks += _in_icrs(tables[name], (hdus[name].header, primary), place)
        elif name not in ("FILTERS", "SOURCES"):
            raise place.fail("the extension is missing", advice="see the file format")
    return assembled(
        tables,
        path,
        instrument=instrument,
        site=site,
        origin=str(primary.get("ORIGIN", "")).strip(),
        kinds=kinds,
        remarks=remarks,
        images=images,
        cells=cells,
        structure=hdus.get(STRUCTURE),
        stated_errors=_stated_errors(primary, path),
    )


def assembled(
    tables: Mapping[str, dict[str, Any]],
    path: Path,
    *,
    instrument: str,
    site: Site,
    origin: str,
    kinds: Collection[str] = KINDS.keys(),
    remarks: Iterable[str] = (),
    images: Mapping[str, Any] | None = None,
    cells: int | None = None,
    structure: Any = None,
    fine: FineStructure | None = None,
    stated_errors: StatedErrors | None = None,
) -> CalibrationSet:
    """A checked calibration set from its tables, each a dictionary of columns in kind and unit of the schema.

    FILTERS and SOURCES may be missing. With `images` (HDUs of whole frames by name) POINTS and INTENSITIES are made of
    `cells` of the frames, and tables of that name are not used. `structure` is the HDU with the structure that is finer
    than the points of a set made of frames, `fine` the same from memory. `path` is the name of the set in errors and
    remarks.

    Raises `DataError` for numbers that cannot be meant.
    """
    remarks = list(remarks)
    instrument = checks.instrument_name(instrument, Place(path, "PRIMARY"))
    filters = checks.make_filters(tables["FILTERS"], Place(path, "FILTERS")) if "FILTERS" in tables else {}
    tables = {name: dict(columns) for name, columns in tables.items()}
    filters, spelled = checks.match_filters(tables, filters, path)
    remarks += spelled
    place = Place(path, "EXPOSURES")
    exposures = checks.make_exposures(tables["EXPOSURES"], filters, site, place, kinds)
    remarks += checks.doubts_about(instrument, site, exposures, place, origin)
    sources = Sources.none()
    if "SOURCES" in tables:
        sources = checks.make_sources(tables["SOURCES"], Place(path, "SOURCES"), filters)
    if images:
        intensities, points, fine, odd = _cells(images, exposures, instrument, path, cells)
        remarks += odd
    else:
        points = checks.make_points(tables["POINTS"], instrument, Place(path, "POINTS"))
        place = Place(path, "INTENSITIES")
        checks.check_cameras(instrument, tables["INTENSITIES"]["N"].shape[1], place, "N")
        intensities, odd = table_intensities(tables["INTENSITIES"], exposures, points, sources, place)
        intensities, repeated = mask_repeats(intensities, exposures, path)
        remarks += odd + repeated
        rows = intensities.exposure
        numbers = intensities.counts, intensities.sigma, intensities.used
        # Rows of a set made of frames stand for many pixels each, with the errors of their means.
        photons = ~exposures.flux_known[rows] & (structure is None and fine is None)
        doubts = plausible.of_counts(*numbers, measured=photons, group=rows)
        remarks += [place.remark(what, column) for column, what in doubts]
        idle = np.setdiff1d(np.arange(len(exposures)), intensities.exposure[intensities.used])
        if len(idle):
            names = ", ".join(map(str, exposures.exposure[idle][:5])) + (" …" if len(idle) > 5 else "")
            remarks.append(f"{path} [INTENSITIES]: no used row for exposure(s) {names}")
    if structure is not None:
        fine = read_structure(structure, intensities.cameras, path)
        remarks += _spots(fine, path)
    remarks += repeated_counts(intensities, exposures, points, path)
    used = np.unique(exposures.filter).tolist()
    if idle_curves := [name for name in filters if name not in {*used, *sources.filter.tolist()}]:
        what = f"the curve of {', '.join(idle_curves)} is used by no exposure (FILTER is {', '.join(used)} there)"
        remarks.append(Place(path, "FILTERS").remark(f"{what}; correct the name, or remove it", "FILTER"))
    return CalibrationSet(
        instrument=instrument,
        site=site,
        origin=origin,
        exposures=exposures,
        points=points,
        sources=sources,
        filters=filters | {name: builtin_filter(name) for name in sorted(set(used) - set(filters))},
        intensities=intensities,
        remarks=tuple(remarks),
        fine=fine,
        cells=cells if images else None,
        stated_errors=stated_errors or StatedErrors(),
    )


def _header(header: Any, path: Path) -> tuple[str, Site]:
    place = Place(path, "PRIMARY")
    version = header.get("CALVERS")
    if version is None:
        advice = "is this a calibration set?"
        if "PRODVERS" in header:
            advice = "this is a calibration product of a fit: give the set that it was made from"
        raise place.fail("is missing", "CALVERS", advice)
    if isinstance(version, bool) or not isinstance(version, int) or not 1 <= version <= schema.CALVERS:
        what = f"is {version!r}, this program reads up to {schema.CALVERS}"
        raise place.fail(what, "CALVERS", "use a newer walop-jax")
    instrument = checks.instrument_name(header.get("INSTRUME", ""), place)
    values: list[float] = []
    for name in ("SITELAT", "SITELONG", "SITEELEV"):
        value = header.get(name, _NAN)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise place.fail(f"is {value!r}, not a number", name, "degrees (east positive) and metres")
        values.append(float(value))
    return instrument, Site(str(header.get("TELESCOP", "")).strip(), *values)


def _unused_words(opened: OpenFile, tables: Mapping[str, Any]) -> Iterator[str]:
    """Remark on words of headers that have the name of a column of EXPOSURES, which alone is read."""
    columns = (
        schema.column_names(tables["EXPOSURES"], Place(opened.path, "EXPOSURES"))
        if "EXPOSURES" in tables
        else ()
    )
    for extension in ("PRIMARY", *schema.TABLES):
        header = (
            opened.hdus[0].header if extension == "PRIMARY" else getattr(tables.get(extension), "header", {})
        )
        for name in schema.EXPOSURES:
            if name in header:
                there = "that column counts" if name in columns else "write a column of EXPOSURES"
                what = f"= {header[name]} in the header is not used: {there}"
                yield Place(opened.path, extension).remark(what, name)


def _in_icrs(table: dict[str, Any], headers: Iterable[Any], place: Place) -> list[str]:
    """Put RA and DEC of the exposures into ICRS, where the first header with a reference system states another one."""
    known = np.isfinite(table["RA"]) & np.isfinite(table["DEC"])
    for header in headers if known.any() else ():
        ra, dec, frame = made_icrs(
            header, table["RA"][known], table["DEC"][known], table["MJD"][known], place
        )
        if frame != ICRS:
            table["RA"][known], table["DEC"][known] = ra, dec
            what = f"are in {frame.system if frame.system == 'GAPPT' else frame}: converted to ICRS"
            return [] if frame.is_icrs else [place.remark(what, "RA, DEC")]
    return []


def _stated_errors(header: Any, path: Path) -> StatedErrors:
    """The errors of the numbers of a set, as its primary header gives them."""
    place, stated = Place(path, "PRIMARY"), dict[str, float]()
    for name, (word, unit, _, about) in ERROR_WORDS.items():
        value = header.get(word)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < np.inf:
            wanted = f"the error of {about}: a number{f' in {unit}' if unit else ''}, 0 or more"
            raise place.fail(f"is {value!r}", word, wanted)
        stated[name] = float(value)
    return StatedErrors(**stated)


def _extensions(opened: OpenFile, remarks: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Sort the extensions of a file by name into tables and images."""
    four = [name for names in image_names(4) for name in names] + ["FLAG"]
    tables: dict[str, Any] = {}
    images: dict[str, Any] = {}
    for number, hdu in enumerate(opened.hdus[1:], start=1):
        name = hdu.name.strip().upper()
        image = name == "FLAG" or _IMAGE.fullmatch(name)
        kind = tables if name in (*schema.TABLES, STRUCTURE, _COMPRESSED) else images if image else None
        if kind is None:
            expected = (*schema.TABLES, STRUCTURE, *four)
            remarks.append(f"{opened.path} [{name or number}]: unknown extension ({nearest(name, expected)})")
        elif name in kind:
            raise fail("is there twice", file=opened.path, extension=name, advice="remove one")
        else:
            kind[name] = hdu
    if "INTENSITIES" in tables and "N0" not in images:  # pictures of something else
        remarks += [f"{opened.path} [{name}]: unknown extension, not used" for name in images]
        images.clear()
    return tables, images


def _cells(
    images: Mapping[str, Any], exposures: Exposures, instrument: str, path: Path, cells: int | None
) -> tuple[TableIntensities, Points, FineStructure, list[str]]:
    """The cells of whole frames as field points with their intensities, structure finer than these, and remarks."""
    if np.any(bad := exposures.direct("standard")):
        what = f"EXPOSURE {exposures.exposure[bad][0]} is a standard, and a pixel of a frame has no SOURCE"
        advice = "give standards in a table, in another file"
        raise Place(path, "EXPOSURES").fail(what, "KIND", advice)
    frames = frames_of(images, len(exposures), path)
    checks.check_cameras(instrument, frames.cameras, Place(path, "N0"), "")
    width, height = frames.grid.width, frames.grid.height
    x, y = frames.grid.at(np.array([0, width - 1, 0, width - 1]), np.array([0, 0, height - 1, height - 1]))
    checks.make_points({"POINT": np.arange(4), "X": x, "Y": y}, instrument, Place(path, "N0"))
    points, intensities, fine, remarks = cells_of(frames, path, np.isin(exposures.kind, ONE_CAMERA), cells)
    what = f"{width} × {height} pixels of each exposure have become {len(points)} field points"
    return (
        intensities,
        points,
        fine,
        [f"{path} [N0…N{frames.cameras - 1}]: {what}", *remarks, *_spots(fine, path)],
    )


def _spots(fine: FineStructure, path: Path) -> Iterator[str]:
    """Remark on the places of the field at which pixels differ most from their surroundings."""
    if len(spots := fine.spots):
        (patch, camera), places = spots[0].tolist(), len(np.unique(spots[:, 0]))
        gain = float(np.sqrt(fine.gain[patch, camera]))
        where = f"near X = {fine.x[patch]:.4f}, Y = {fine.y[patch]:.4f} deg"
        others = f"; and {places - 1} other place(s)" if places > 1 else ""
        yield (
            f"{path} [N{camera}]: pixels {where} differ by {100 * gain:.2g} % (rms) from their surroundings in all "
            f"exposures{others}: dust, or a flat field that is left? q and u of stars there are off by up to half of "
            "that (STRUCTURE of the set has a map)"
        )


NAME = "arrays"
"""Name in errors of the file that is none."""

_SHOWN = 3


def from_arrays(
    counts: Any,
    errors: Any,
    x: Any,
    y: Any,
    angles: Any,
    kinds: Any = "clp",
    *,
    instrument: str = "WALOP-SOUTH",
    site: Site | None = None,
    filters: Mapping[str, Any] | None = None,
    sources: Mapping[str, Any] | None = None,
    source: Any = None,
    sky: Any = None,
    origin: str = "",
    fine: FineStructure | None = None,
    stated_errors: Mapping[str, float] | None = None,
    **exposures: Any,
) -> CalibrationSet:
    """A checked calibration set from arrays in memory.

    `counts` and `errors` have the shape (point, exposure, camera), in electrons; counts that are NaN in all cameras
    were not measured. `x`, `y` are the field points in degrees, `angles` the angles (deg) of the calibration polariser
    in the exposures, NaN where it is out. `kinds` is the KIND of every exposure, or one for all.

    Any other column of EXPOSURES goes by its name in small letters, one value or one for each exposure: `mjd`,
    `filter`, `teff`, `temp`, `ha`, `ra`, `dec`, `rotator`, `chwp_in`, `chwp_angle`, … (docs: files). `sources` are the
    columns of SOURCES, `source` (point, exposure) the SOURCE of every intensity, −1 for none; `sky` the level of the
    sky that was subtracted from the counts, in their shape; `filters` are `FilterCurve`s by name; `fine` is that
    of a set that was made of whole frames; `stated_errors` are those of the numbers of the set that differ from the
    usual ones, such as `{"position": 0.2, "scale": 1e-4}` (docs: files). Quantities are converted.

    Raises `DataError`, naming column and row, for whatever a file would be refused for.

    >>> angles = [0.0, 30.0, 60.0, 90.0]
    >>> counts = 1e5 * (1 + np.random.default_rng(1).random((2, 4, 4)))  # 2 field points, 4 exposures, 4 cameras
    >>> made = walop.from_arrays(counts, np.sqrt(counts), x=[0.0, 0.1], y=[0.0, 0.0], angles=angles)
    >>> made.exposures.clp_angle
    array([ 0., 30., 60., 90.])
    """
    check_units({"counts": unit_of(counts), "errors": unit_of(errors)}, "electron", Place(NAME, ""))
    counts = schema.in_unit(counts, "electron", "counts")
    errors = schema.in_unit(errors, "electron", "errors")
    x, y, angles = (
        np.atleast_1d(schema.in_unit(v, "deg", n)) for v, n in ((x, "x"), (y, "y"), (angles, "angles"))
    )
    if counts.ndim != 3 or counts.shape[:2] != (len(x), len(angles)) or len(x) != len(y):
        what = f"has shape {counts.shape} for {len(x)} values of x, {len(y)} of y and {len(angles)} angles"
        raise fail(what, column="counts", advice="its axes are (point, exposure, camera)")
    for name, curve in (filters or {}).items():
        if not isinstance(curve, FilterCurve):
            advice = f"give walop.FilterCurve({name!r}, wavelength in um, throughput)"
            raise fail(f"{name!r} is no curve", column="filters", advice=advice)
    if errors.shape != counts.shape:
        raise fail(f"has shape {errors.shape}, counts {counts.shape}", column="errors", advice="one for each")
    number, inside = len(angles), np.isfinite(angles)
    at = point, exposure = np.nonzero(np.isfinite(counts).all(axis=2))
    of_star, masked = schema.without_mask(np.full(counts.shape[:2], -1) if source is None else source)
    tables: dict[str, Mapping[str, Any]] = {
        "EXPOSURES": {
            "EXPOSURE": np.arange(number),
            "KIND": _spread("KIND", kinds, number),
            "CLP_IN": inside,
            "CLP_ANGLE": np.where(inside, angles, np.nan),
        }
        | {name.upper(): _spread(name, values, number) for name, values in exposures.items()},
        "POINTS": {"POINT": np.arange(len(x)), "X": x, "Y": y},
        "INTENSITIES": {
            "EXPOSURE": exposure,
            "POINT": point,
            "SOURCE": np.where(masked, -1, of_star)[at],
            "N": counts[at],
            "N_ERR": errors[at],
        },
    }
    if sky is not None:
        level = np.broadcast_to(schema.in_unit(sky, "electron", "sky"), counts.shape)
        tables["INTENSITIES"] = {**tables["INTENSITIES"], "SKY": level[at]}
    if sources is not None:
        tables["SOURCES"] = _sources(sources)
    if filters:
        tables["FILTERS"] = filter_columns(filters)
    site = site or Site("", _NAN, _NAN, _NAN)
    calset = _in_memory(tables, instrument=instrument, site=site, origin=origin, fine=fine)
    stated = StatedErrors.of(stated_errors or {})
    return dataclasses.replace(calset, remarks=(*calset.remarks, *_spoilt(counts)), stated_errors=stated)


def checked(calset: CalibrationSet, kinds: Collection[str] = ()) -> CalibrationSet:
    """A set from memory after the checks that files go through; unusable rows are masked, with a remark."""
    names = "instrument", "site", "origin", "fine", "stated_errors"
    header = {name: getattr(calset, name) for name in names}
    found = _in_memory(set_tables(calset), **header, kinds=(*KINDS, *kinds))
    before, after = calset.intensities, found.intensities
    if isinstance(before, TableIntensities) and isinstance(after, TableIntensities):
        # A file says why a row is not to be used, memory only that it is not.
        return dataclasses.replace(found, intensities=after.using(after.used & before.used))
    return found


def _in_memory(tables: Mapping[str, Mapping[str, Any]], **header: Any) -> CalibrationSet:
    """A checked set of columns in memory; `header` as for `assembled`."""
    filled = {}
    for name, columns in tables.items():
        place = Place(NAME, name)
        filled[name] = schema.table_of(columns, schema.table_rules(name, list(columns), place), place)
    return assembled(filled, Path(NAME), **header)


def _spoilt(counts: np.ndarray) -> Iterator[str]:
    """Remarks on values that are finite in some cameras only, by their position in the array."""
    finite = np.isfinite(counts)
    places = np.argwhere(finite.any(axis=2) & ~finite.all(axis=2))
    if len(places):
        cameras = {(p, e): map(str, np.flatnonzero(~finite[p, e])) for p, e in places[:_SHOWN].tolist()}
        shown = ", ".join(f"counts[{p}, {e}] (camera {' and '.join(k)})" for (p, e), k in cameras.items())
        suffix = f" and {len(places) - _SHOWN} more" if len(places) > _SHOWN else ""
        yield f"{NAME}: not finite in {shown}{suffix}: not used in any camera"


def _spread(name: str, values: Any, number: int) -> Any:
    """A column of EXPOSURES from one value for each, or one for all."""
    spread = np.repeat(np.atleast_1d(values), number) if np.size(values) == 1 else values
    if np.shape(spread) != (number,):
        what = f"has shape {np.shape(values)} for {number} exposures"
        raise fail(what, column=name.lower(), advice="one value for each")
    plain, masked = schema.without_mask(spread)
    if plain.dtype.kind in "bSU":
        Place(NAME, "EXPOSURES").refuse(masked, "is masked", name.lower(), "fill or remove these")
    return spread


def _sources(given: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of SOURCES, numbered where they have no number: a star that has values in several bands once."""
    columns = {str(name).upper(): np.atleast_1d(values) for name, values in given.items()}
    numbers = np.arange(max(map(len, columns.values()), default=0))
    if "FILTER" in columns and "NAME" in columns:
        _, first, star = np.unique(columns["NAME"], return_index=True, return_inverse=True)
        numbers = np.argsort(np.argsort(first))[star]
    columns.setdefault("SOURCE", numbers)
    return columns

"""A calibration set made of arrays: they meet the checks that a file meets, because they become one in memory."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data import schema
from walop_jax.data.calset import set_from_hdus
from walop_jax.data.quantities import in_unit
from walop_jax.data.records import CalibrationSet, FilterCurve, Site
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import filter_columns, set_hdus, table_hdu
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import OpenFile

NAME = "arrays"
"""What errors call the file that is none."""

_SHOWN = 3
_UNITS = {name: rule.unit for name, rule in schema.EXPOSURES.items()}


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
    filters: Mapping[str, FilterCurve] | None = None,
    sources: Mapping[str, Any] | None = None,
    source: Any = None,
    origin: str = "",
    **exposures: Any,
) -> CalibrationSet:
    """A checked calibration set from arrays in memory.

    `counts` and `errors` have the shape (point, exposure, camera), in electrons; counts that are NaN in all cameras
    were not measured. `x`, `y` are the field points in degrees, `angles` those of the calibration polariser in every
    exposure in degrees, NaN where it is out. `kinds` is the KIND of every exposure, or one for all.

    Any other column of EXPOSURES goes by its name in small letters, one value or one for each exposure: `mjd`,
    `filter`, `teff`, `temp`, `ha`, `ra`, `dec`, `rotator`, `chwp_in`, `chwp_angle`, … (docs: files). `sources` are
    the columns of SOURCES, `source` (point, exposure) the SOURCE of every intensity, −1 for none; `filters` are
    curves by name. Quantities are converted.

    Raises `DataError`, naming column and row, for whatever a file would be refused for.
    """
    counts, errors = in_unit(counts, "electron", "counts"), in_unit(errors, "electron", "errors")
    x, y, angles = (np.atleast_1d(in_unit(v, "deg", n)) for v, n in ((x, "x"), (y, "y"), (angles, "angles")))
    if counts.ndim != 3 or counts.shape[:2] != (len(x), len(angles)) or len(x) != len(y):
        raise fail(
            f"has shape {counts.shape} for {len(x)} values of x, {len(y)} of y and {len(angles)} angles",
            column="counts",
            advice="its axes are (point, exposure, camera)",
        )
    if errors.shape != counts.shape:
        raise fail(f"has shape {errors.shape}, counts {counts.shape}", column="errors", advice="one for each")
    number = len(angles)
    inside = np.isfinite(angles)
    columns = {
        "EXPOSURE": np.arange(number),
        "KIND": np.broadcast_to(np.asarray(kinds, str), number),
        "CLP_IN": inside,
        "CLP_ANGLE": np.where(inside, angles, np.nan),
    } | {name.upper(): _column(name.upper(), values, number) for name, values in exposures.items()}
    for name, rule in schema.EXPOSURES.items():
        columns.setdefault(name, np.full(number, rule.missing))
    point, exposure = np.nonzero(np.isfinite(counts).all(axis=2))
    rows = {
        "EXPOSURE": exposure,
        "POINT": point,
        "SOURCE": np.full(len(point), -1) if source is None else np.asarray(source)[point, exposure],
        "N": counts[point, exposure],
        "N_ERR": errors[point, exposure],
        "FLAG": np.zeros(len(point), int),
    }
    primary = fits.PrimaryHDU()
    cards: dict[str, Any] = {"INSTRUME": instrument, "CALVERS": schema.CALVERS, "ORIGIN": origin}
    if site is not None:
        cards |= {"TELESCOP": site.telescope, "SITELAT": site.latitude, "SITELONG": site.longitude}
        cards |= {"SITEELEV": site.elevation}
    primary.header.update(cards)
    rules = schema.table_rules("EXPOSURES", schema.CALVERS, list(columns), schema.Place(NAME, "EXPOSURES"))
    hdus = [
        primary,
        table_hdu("EXPOSURES", columns, NAME, {name: rules[name] for name in rules if name in columns}),
        table_hdu("POINTS", {"POINT": np.arange(len(x)), "X": x, "Y": y}, NAME),
        table_hdu("INTENSITIES", rows, NAME),
    ]
    if sources is not None:
        hdus.append(table_hdu("SOURCES", _sources(sources), NAME))
    if filters:
        hdus.append(table_hdu("FILTERS", filter_columns(filters), NAME))
    found = set_from_hdus(_in_memory(hdus))
    return dataclasses.replace(found, remarks=(*found.remarks, *_spoilt(counts)))


def _spoilt(counts: np.ndarray) -> Iterator[str]:
    """What is measured in some cameras only, by its place in the array."""
    finite = np.isfinite(counts)
    places = np.argwhere(finite.any(axis=2) & ~finite.all(axis=2))
    if len(places):
        shown = ", ".join(
            f"counts[{p}, {e}] (camera {' and '.join(str(k) for k in np.flatnonzero(~finite[p, e]))})"
            for p, e in places[:_SHOWN].tolist()
        )
        more = f" and {len(places) - _SHOWN} more" if len(places) > _SHOWN else ""
        yield f"{NAME}: not finite in {shown}{more}: not used in any camera"


def checked(calset: CalibrationSet, kinds: Collection[str] = ()) -> CalibrationSet:
    """A set from memory behind the checks that files meet, and as they would leave it: unusable rows masked, and said.

    `kinds` are kinds of exposures beyond those of the format. Raises `DataError` as `read_calibration_set` does.
    """
    found = set_from_hdus(_in_memory(set_hdus(calset, NAME)), kinds)
    before, after = calset.intensities, found.intensities
    if isinstance(before, TableIntensities) and isinstance(after, TableIntensities):
        # A file says why a row is not to be used, memory only that it is not.
        return dataclasses.replace(found, intensities=after.using(after.used & before.used))
    return found


def _in_memory(hdus: list[Any]) -> OpenFile:
    return OpenFile(Path(NAME), hashlib.sha256().hexdigest(), hdus, compressed=False, remarks=())


def _column(name: str, values: Any, number: int) -> np.ndarray:
    unit = _UNITS.get(name, "deg" if name.endswith("_ANGLE") else "")
    raw = np.asarray(getattr(values, "value", values))
    plain = raw if raw.dtype.kind in "bSU" else in_unit(values, unit, name.lower())
    try:
        return np.broadcast_to(plain, number).copy()
    except ValueError:
        raise fail(
            f"has shape {plain.shape} for {number} exposures",
            column=name.lower(),
            advice="one value for each",
        ) from None


def _sources(given: Mapping[str, Any]) -> dict[str, np.ndarray]:
    columns = {str(name).upper(): values for name, values in given.items()}
    for name, rule in schema.SOURCES.items():
        if name not in columns and rule.missing is None and name != "SOURCE":
            raise fail("the column is missing", file=NAME, extension="SOURCES", column=name, advice="add it")
    number = len(np.atleast_1d(columns["NAME"]))
    columns.setdefault("SOURCE", np.arange(number))
    return {
        name: np.atleast_1d(np.asarray(columns[name]))
        if name in ("SOURCE", "NAME")
        else np.atleast_1d(in_unit(columns.get(name, np.full(number, np.nan)), rule.unit, name))
        for name, rule in schema.SOURCES.items()
    }

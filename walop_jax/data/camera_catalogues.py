"""Catalogues of single cameras as programs of photometry write them, by a map of the names of their columns.

A map is a small TOML file: those of SExtractor and photutils stand beside this file, others are the user's. It says
which columns are fluxes with their errors, positions on the sky or in pixels, and flags, and the meaning of the bits
of the flags. A quantity with several columns is read from the first one that the catalogue has.
"""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from walop_jax.data import plausible
from walop_jax.data.camera_headers import (
    LDAC_OBJECTS,
    OF_EXPOSURES,
    POINTING,
    Headers,
    differ,
    is_ldac,
    read_headers,
)
from walop_jax.data.celestial import frame_of, sky_of_pixels
from walop_jax.data.header_words import Words
from walop_jax.data.records import DataFlag
from walop_jax.data.schema import Column
from walop_jax.data.table_files import read_table_file
from walop_jax.data.units import Place, convert_unit, unit_of
from walop_jax.data.user_tables import (
    OF_STARS,
    InputTable,
    column_of_stars,
    empty_cells,
    in_memory,
    numeric_column,
    sky_positions,
)
from walop_jax.io.errors import PathLike, errors_naming, rows_text
from walop_jax.io.shapes import Vector
from walop_jax.io.text import parse_toml, read_text, some
from walop_jax.io.toml import Reader

SHIPPED = ("sextractor", "photutils")
BAD_PIXEL = int(DataFlag.BAD_PIXEL)
_OF_IMAGE = "_SKY"
"""End of the names of columns in the reference system of the image; other columns are in the system of the table."""
_FAINTEST_MAGNITUDE = 40.0
_NEGATIVE = 5.0  # standard errors
_UNITS: Mapping[str, str] = {
    "ct": "ct", "count": "ct", "counts": "ct", "adu": "ct", "dn": "ct",
    "electron": "electron", "electrons": "electron", "e-": "electron", "e": "electron",
}  # fmt: skip
"""Units of fluxes by their names in catalogues."""
_OF_A_PIXEL = re.compile(r"\s*/\s*pix(els?)?$")
"""End of the unit of a level of the sky that is stated for a pixel."""


@dataclasses.dataclass(frozen=True)
class ColumnMap:
    """Names of the columns of a program.

    `flux` are pairs of a flux and its error, `sky` pairs of right ascension and declination (or a column of
    coordinates of astropy), `pixel` pairs of coordinates that count from `first_pixel`. `bits` gives each bit of `flag`
    the bit of FLAG that it stands for, 0 for none. `level` are columns of the background that was subtracted,
    `magnitude` columns that are no fluxes. `unit` is that of fluxes without one.
    """

    program: str
    flux: tuple[tuple[str, str], ...]
    sky: tuple[tuple[str, ...], ...] = ()
    pixel: tuple[tuple[str, str], ...] = ()
    first_pixel: int = 1
    flag: tuple[str, ...] = ()
    level: tuple[str, ...] = ()
    bits: Mapping[str, int] = dataclasses.field(default_factory=dict)
    kept: Mapping[str, str] = dataclasses.field(default_factory=dict)
    magnitude: tuple[str, ...] = ()
    unit: str = "count"


@dataclasses.dataclass(frozen=True)
class CameraCatalogue:
    """The stars of one camera (n): positions (deg), fluxes with errors (electrons), level of the sky, and bits of FLAG.

    `flux_name` is the column of the fluxes; `sky` is None where no level is stated. `blended` marks stars whose flags
    only say that another star is near. `of_stars` are columns that belong to the stars, `of_exposure` values that all
    of them have in common; `instrument` is INSTRUME as stated ("": not stated), `worded` what the words of an
    observatory make of the headers. Fluxes that were not measured are NaN.
    """

    path: Path
    ra: Vector
    dec: Vector
    flux: Vector
    error: Vector
    flux_name: str
    sky: Vector | None
    flag: Int[np.ndarray, " n"]
    blended: Bool[np.ndarray, " n"]
    of_stars: Mapping[str, np.ndarray]
    of_exposure: Mapping[str, Any]
    instrument: str
    headers: Headers
    worded: Mapping[str, Any]
    remarks: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ra)


def read_map(source: PathLike) -> ColumnMap:
    """A map of columns that comes with the package, by name, or of a TOML file; `DataError` names a wrong key."""
    shipped = str(source) in SHIPPED
    text = (files("walop_jax.data") / f"{source}.toml").read_text("utf-8") if shipped else read_text(source)
    with errors_naming(source):
        reader, table = Reader(""), parse_toml(text)
        values = reader.values(typing.get_type_hints(ColumnMap), table, "")
        for key, what in (("program", "the program"), ("flux", "columns")):
            if not values.get(key):
                raise reader.fault("", f"{key} is missing: it names {what}")
        for bit, meaning in values.get("bits", {}).items():
            if not bit.isdigit() or int(bit).bit_count() != 1:
                raise reader.fault("bits", f"{bit!r} is no single bit: 1, 2, 4, 8, …")
            if meaning not in (0, *DataFlag):
                listed = ", ".join(str(int(flag)) for flag in DataFlag)
                raise reader.fault("bits", f"{bit} = {meaning}: give a bit of FLAG ({listed}), or 0")
        if odd := set(values.get("kept", {})) - set(values.get("bits", {})):
            raise reader.fault("kept", f"{min(odd)} is no bit of [bits]; give its meaning there as well")
        for pair in values.get("sky", ()):
            if len(pair) > 2:
                raise reader.fault("", f"sky = {list(pair)} must be two columns, or one of coordinates")
    return ColumnMap(**values)


def read_camera_catalogue(
    path: PathLike,
    columns: PathLike | None = None,
    gain: float | None = None,
    words: Words | None = None,
    *,
    drop_blends: bool = False,
) -> CameraCatalogue:
    """The catalogue of a camera, read by a map of columns (None: the map of the package that fits).

    `words` of its headers are columns about the exposure and its pointing, in place of header words with the names of
    these columns. Stars that are flagged only as having a neighbour are kept unless `drop_blends`, with a remark; stars
    without a position are left out, with a remark.

    `gain` is in electrons per count (None: from the unit of the column, else 1, with a remark). Fluxes come back in
    electrons.

    Raises `DataError` for a file without fluxes, for magnitudes in their place, for flags whose bits the map does not
    know, and where there is neither a position on the sky nor a WCS.
    """
    source, headers = _table(Path(path))
    place = Place(source.path, "")
    worded = {} if words is None else headers.worded(words, (*OF_EXPOSURES, *POINTING))
    maps = [read_map(columns)] if columns is not None else [read_map(name) for name in SHIPPED]
    column_map = next((candidate for candidate in maps if _pair(source, candidate.flux)), None)
    if column_map is None:
        raise _no_flux(source, maps, place)
    flux, error, *sky = _fluxes(source, column_map, gain, place)
    of_exposure = {name: _of_all(source, headers, worded, name, place) for name in OF_EXPOSURES}
    mjd = time_of(of_exposure)
    ra, dec = _positions(source, column_map, headers, mjd, place)
    flag, blended = _flags(source, column_map, place, drop_blends=drop_blends)
    bad = ~(np.isfinite(flux) & np.isfinite(error) & (error > 0))
    of_stars = {name: column_of_stars(source, name) for name in OF_STARS if name in source.names}
    if bad.any():
        what = "fluxes are not finite, or have no error above 0: not used"
        source.remarks.append(f"{int(bad.sum())} of {len(bad)} {what}")
    if low := int(np.sum(flux < -_NEGATIVE * error)):
        source.remarks.append(f"{low} of {len(bad)} fluxes are below 0 by more than {_NEGATIVE:g} errors")
    doubts = [*plausible.of_columns(_numbers(of_exposure), plausible.today())]
    doubts += plausible.of_counts(flux[:, None], error[:, None], ~bad & (flag == 0), cameras=["this camera"])
    pair = _pair(source, column_map.flux)
    names = {"N": pair[0], "N_ERR": pair[1]}
    source.remarks.extend(f"{names.get(column, column)} {what}" for column, what in doubts)
    located = np.flatnonzero(np.isfinite(ra) & np.isfinite(dec))
    numbers = np.stack([ra, dec, flux, error])[:, located]
    rows = located[np.sort(np.unique(numbers, axis=1, return_index=True)[1])]
    if copies := len(located) - len(rows):
        source.remarks.append(f"{copies} of {len(ra)} rows are copies of another row: left out")
    return CameraCatalogue(
        path=source.path,
        ra=ra[rows],
        dec=dec[rows],
        flux=np.where(bad, np.nan, flux)[rows],
        error=np.where(bad, np.nan, error)[rows],
        flux_name=_pair(source, column_map.flux)[0],
        sky=sky[0][rows] if sky else None,
        flag=np.where(bad, flag | BAD_PIXEL, flag)[rows],
        blended=blended[rows],
        of_stars={name: values[rows] for name, values in of_stars.items()},
        of_exposure={name: value for name, value in of_exposure.items() if value is not None},
        instrument=str(_of_all(source, headers, worded, "INSTRUME", place) or ""),
        headers=headers,
        worded=worded,
        remarks=(*source.remarks, *source.hints({"TEFF", "SOURCE_ID", "N_FLAG"})),
    )


def time_of(of_exposure: Mapping[str, Any]) -> float:
    """The MJD of an exposure; NaN where it is not stated."""
    try:
        return float(of_exposure.get("MJD") or np.nan)
    except (TypeError, ValueError):
        return float("nan")


def _numbers(of_exposure: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The numbers among the values of an exposure, as columns of one row."""
    plain = {name: value for name, value in of_exposure.items() if isinstance(value, int | float | np.number)}
    return {name: np.array([value], float) for name, value in plain.items() if not isinstance(value, bool)}


def _table(path: Path) -> tuple[InputTable, Headers]:
    """The table of a file, and its headers."""
    chosen = Path(f"{path}[{LDAC_OBJECTS}]") if is_ldac(path) else path
    table_path, table, how = read_table_file(chosen, ())
    read = in_memory(table, str(table_path))
    read.remarks.extend(how)
    return read, read_headers(path, read.table.meta)


def _pair(source: InputTable, pairs: Sequence[Sequence[str]]) -> Sequence[str]:
    """The first of pairs of columns that are both there; none: ()."""
    names = set(source.names)
    return next((pair for pair in pairs if {_plain(name)[0] for name in pair} <= names), ())


def _plain(name: str) -> tuple[str, int]:
    """A name in capitals, and which of the values in a row is meant, from 1: FLUX_APER[2]; 0: not said."""
    match = re.fullmatch(r"(.+)\[(\d+)\]", name)
    return (match[1].upper(), int(match[2])) if match else (name.upper(), 0)


def _one(source: InputTable, name: str, place: Place) -> Any:
    """A column with one value in a row."""
    plain, number = _plain(name)
    column = source.column(plain)
    values = getattr(column, "shape", (0,))[1:]
    if values and values != (1,):
        if not 1 <= number <= values[0]:
            advice = f"name it in a map of columns (--columns): {plain}[1] … {plain}[{values[0]}]"
            raise place.fail(f"has {values[0]} apertures", plain, advice)
        return column[:, number - 1]
    return column


def _no_flux(source: InputTable, maps: Sequence[ColumnMap], place: Place) -> Exception:
    """The error for a catalogue without fluxes: magnitudes, or names that no map has."""
    of_maps = {name.upper() for column_map in maps for name in column_map.magnitude}
    magnitudes = [name for name in source.names if name in of_maps]
    if magnitudes or any(unit_of(source.table[name]) == "mag" for name in source.table.colnames):
        listed = some(magnitudes or list(source.names), 4)
        advice = f"write {maps[0].flux[0][0]} and {maps[0].flux[0][1]} as well: intensities add up, magnitudes do not"
        return place.fail(f"has magnitudes and no fluxes with errors ({listed})", "", advice)
    expected = " or ".join(f"{', '.join(m.flux[0])} of {m.program}" for m in maps)
    lone = [pair[0] for column_map in maps for pair in column_map.flux if pair[0].upper() in source.names]
    what = f"has {lone[0]} without its error" if lone else f"has no fluxes with errors, such as {expected}"
    advice = "name the columns of another program in a TOML file: --columns FILE.toml (walop-jax docs files)"
    return place.fail(f"{what}; it has {some(list(source.names), 8)}", "", advice)


def _fluxes(
    source: InputTable, column_map: ColumnMap, gain: float | None, place: Place
) -> tuple[Vector, ...]:
    """Fluxes, errors and the level of the sky, if there is one (electrons); a level without a unit has the unit of the
    flux.
    """
    pair = _pair(source, column_map.flux)
    unused = [other[0] for other in column_map.flux if other != pair and other[0].upper() in source.names]
    names = [*pair, *[name for name in column_map.level if name.upper() in source.names][:1]]
    stated = [_OF_A_PIXEL.sub("", unit_of(_one(source, name, place)).strip()) for name in names]
    given = [unit or next(filter(None, stated), column_map.unit) for unit in stated]
    plain = [_UNITS.get(unit.lower(), unit) for unit in given]
    counts = plain[0] != "electron"
    for name, unit in zip(names[1:], plain[1:], strict=True):
        if (unit != "electron") != counts:
            what = f"is in {given[names.index(name)]}, {names[0]} in {given[0]}"
            raise place.fail(what, _plain(name)[0], "give both in counts, or both in electrons")
    wanted = "ct" if counts else "electron"
    flux, error, *sky = (
        convert_unit(_plain_numbers(source, name, place), unit, wanted, _plain(name)[0], place)
        for name, unit in zip(names, plain, strict=True)
    )
    measured = np.isfinite(flux) & np.isfinite(error) & (error > 0)
    if not measured.any():
        what, advice = "has no flux with an error above 0", "give standard errors of the fluxes"
        raise place.fail(what, _plain(names[1])[0], advice)
    size, errors = np.abs(flux[measured]), error[measured]
    if size.max() < _FAINTEST_MAGNITUDE and np.median(errors - 0.1 * size) < 0.0:
        low, high, typical = flux[measured].min(), flux[measured].max(), np.median(errors)
        what = f"lies between {low:.3g} and {high:.3g} with errors of {typical:.2g}: these are magnitudes"
        raise place.fail(what, _plain(names[0])[0], "name a column of fluxes")
    if counts and gain is None:
        what = "is in counts: taken as electrons; --gain gives electrons per count"
        source.remarks.append(f"{names[0]} {what}")
    if not counts and gain is not None:
        source.remarks.append(f"{names[0]} is in electrons: the gain is not used")
    if unused:
        source.remarks.append(f"fluxes are {names[0]}, not {some(unused, 3)}")
    factor = gain if counts and gain is not None else 1.0
    return tuple(factor * values for values in (flux, error, *sky))


def _plain_numbers(source: InputTable, name: str, place: Place) -> Vector:
    """A column without its unit."""
    unitless = in_memory({name: np.ma.asarray(_one(source, name, place))}, str(source.path))
    return numeric_column(unitless, name.upper(), Column("float", missing=np.nan))


def _positions(
    source: InputTable, column_map: ColumnMap, headers: Headers, mjd: float, place: Place
) -> tuple[Vector, Vector]:
    """Right ascension and declination (deg, ICRS), NaN where they are not known.

    From the sky, in the reference system of the columns or of the header, or from pixels by the WCS of the header.
    """
    names = _pair(source, (*column_map.sky, ("RA", "DEC")))
    pixels = _pair(source, column_map.pixel)
    if len(names) == 1:
        directions = source.column(_plain(names[0])[0])
        if not hasattr(directions, "icrs"):
            raise place.fail("holds no coordinates of astropy", names[0], "name two columns, in degrees")
        ra, dec = (np.asarray(angle.deg, float) for angle in (directions.icrs.ra, directions.icrs.dec))
    elif names:
        columns = [_plain(name)[0] for name in names]
        of_image = all(name.endswith(_OF_IMAGE) for name in columns)
        ra, dec = sky_positions(source, columns, headers.frame(of_image, mjd))
    elif pixels and "CRVAL1" in headers.wcs:
        x, y = (_plain_numbers(source, name, place) for name in pixels)
        ra, dec = sky_of_pixels(headers.wcs, x, y, column_map.first_pixel, place, mjd)
        frame = frame_of(headers.wcs, place, mjd)
        if not frame.is_icrs:
            source.remarks.append(f"the WCS of the header is in {frame}: converted to ICRS")
    else:
        expected = column_map.sky[0] if column_map.sky else ("RA", "DEC")
        what = f"has neither {' and '.join(expected)} nor pixels with the WCS of their image"
        advice = "write these, or a catalogue with the header (FITS_LDAC); other names go into a TOML file (--columns)"
        raise place.fail(f"{what}; it has {some(list(source.names), 8)}", "", advice)
    unknown = ~(np.isfinite(ra) & np.isfinite(dec))
    listed = ", ".join(names or pixels)
    if unknown.all():
        raise place.fail("is finite in no row", listed, "give the positions of the stars")
    if unknown.any():
        what = f"{listed} is not finite in {rows_text(np.flatnonzero(unknown))}"
        source.remarks.append(f"{what}: these stars are left out")
    return ra, dec


def _flags(
    source: InputTable, column_map: ColumnMap, place: Place, *, drop_blends: bool
) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Bits of FLAG, and the stars whose bits are `kept`; with `drop_blends` these are in FLAG as well."""
    name = next((name.upper() for name in column_map.flag if name.upper() in source.names), None)
    flag, rule = np.zeros(source.rows, np.int64), Column("int", missing=0, true=BAD_PIXEL)
    if name is None:
        source.remarks.append("no flags of the stars: blends and saturated ones are not known")
        return flag, flag > 0
    values = undefined = numeric_column(source, name, rule)
    if source.column(name).dtype.kind == "b":
        source.remarks.append(f"{name} holds truth values: true is taken as a bad pixel")
        return values, np.zeros(source.rows, bool)
    blended, about = np.zeros(source.rows, bool), []
    for bit, meaning in column_map.bits.items():
        there = values & int(bit) > 0
        if bit in column_map.kept and there.any():
            about.append(f"{int(there.sum())} {column_map.kept[bit]} (bit {bit})")
            blended |= there
        if bit not in column_map.kept or drop_blends:
            flag |= np.where(there, meaning, 0)
        undefined = undefined & ~int(bit)
    odd = np.flatnonzero((undefined != 0) | (values < 0))
    if odd.size:
        what = f"is {values[odd[0]]} in {rows_text(odd)}, which is no flag of {column_map.program}"
        advice = "give the meaning of its bits in a map of columns: --columns FILE.toml, table [bits]"
        raise place.fail(what, name, advice)
    if empty := int(empty_cells(source, name, rule).sum()):
        source.remarks.append(f"{name} is empty in {empty} rows: taken as good")
    if about:
        what = "left out" if drop_blends else "used, and marked in BLENDED; --drop-blends leaves them out"
        source.remarks.append(f"{name}: of {len(flag)} stars {' and '.join(about)}: {what}")
    return flag, blended


def _of_all(source: InputTable, headers: Headers, worded: Mapping[str, Any], name: str, place: Place) -> Any:
    """The value of a column, or of a word of the headers, of the exposure; None: none.

    Raises `DataError` for several values in a column, and for headers that contradict it or each other.
    """
    value = worded[name] if name in worded else headers.value(name)
    value = value.strip() if isinstance(value, str) else value
    if name not in source.names:
        return value
    values = np.unique(np.ma.compressed(np.ma.asarray(source.column(name))))
    if len(values) > 1:
        raise place.fail("is not the same in all rows", name, "give the catalogue of one exposure")
    if not len(values):
        return value
    if value is not None and differ(name, [values[0], value]):
        what = f"is {values[0]} in the column and {value} in the header"
        raise place.fail(what, name, "correct the one that is wrong")
    return values[0]

"""Catalogues of single cameras as programs of photometry write them, by a map of the names of their columns.

A map is a small TOML file: those of SExtractor and photutils stand beside this file, others are the user's. It says
which columns are fluxes with their errors, positions on the sky or in pixels, and flags, and the meaning of the bits
of the flags. A quantity with several columns is read from the first one that the catalogue has.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import typing
from collections import ChainMap
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from jaxtyping import Float, Int

from walop_jax.data.header_words import Words, of_header
from walop_jax.data.records import DataFlag
from walop_jax.data.schema import Column
from walop_jax.data.table_files import read_table_file
from walop_jax.data.units import Place, convert_unit, degrees_of, unit_of
from walop_jax.data.user_tables import (
    OF_STARS,
    InputTable,
    column_of_stars,
    empty_cells,
    in_memory,
    numeric_column,
    sky_positions,
)
from walop_jax.io.errors import DataError, PathLike, errors_naming, rows_text
from walop_jax.io.fits_reading import open_fits
from walop_jax.io.text import parse_toml, read_text, some
from walop_jax.io.toml import Reader

Numbers = Float[np.ndarray, " n"]

SHIPPED = ("sextractor", "photutils")
BAD_PIXEL = int(DataFlag.BAD_PIXEL)
POINTING = ("RA", "DEC", "ROTATOR")
OF_EXPOSURES = ("FILTER", "MJD", "TEMP", "HA", "CHWP_ANGLE", "CHWP_IN", "CHWP_TURN")
"""Columns, or words of a header, about the exposure: they go with its stars."""
_LDAC, _HEADER = "LDAC_OBJECTS", "LDAC_IMHEAD"
_FAINTEST_MAGNITUDE = 40.0
_NEGATIVE = 5.0  # standard errors
_UNITS: Mapping[str, str] = {
    "ct": "ct", "count": "ct", "counts": "ct", "adu": "ct", "dn": "ct",
    "electron": "electron", "electrons": "electron", "e-": "electron", "e": "electron",
}  # fmt: skip
"""Units of fluxes by their names in catalogues."""
_OF_A_PIXEL = re.compile(r"\s*/\s*pix(els?)?$")
"""End of the unit of a level of the sky that is stated in a pixel: it is that of a level."""


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
    magnitude: tuple[str, ...] = ()
    unit: str = "count"


@dataclasses.dataclass(frozen=True)
class CameraCatalogue:
    """The stars of one camera: positions (deg), fluxes with errors (electrons), level of the sky, and bits of FLAG.

    `flux_name` is the column of the fluxes; `sky` is None where no level is stated. `of_stars` are columns that go with
    the stars, `of_exposure` the values that all of them share, `pointing` RA, DEC and ROTATOR as stated; `header` is
    that of the image, empty where the file has none. Fluxes that were not measured are NaN.
    """

    path: Path
    ra: Numbers
    dec: Numbers
    flux: Numbers
    error: Numbers
    flux_name: str
    sky: Numbers | None
    flag: Int[np.ndarray, " n"]
    of_stars: Mapping[str, np.ndarray]
    of_exposure: Mapping[str, Any]
    pointing: Mapping[str, Any]
    header: Mapping[str, Any]
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
        for pair in values.get("sky", ()):
            if len(pair) > 2:
                raise reader.fault("", f"sky = {list(pair)} must be two columns, or one of coordinates")
    return ColumnMap(**values)


def read_camera_catalogue(
    path: PathLike, columns: PathLike | None = None, gain: float | None = None, words: Words | None = None
) -> CameraCatalogue:
    """The catalogue of a camera, by a map of columns (None: the one of those that come with the package that fits).

    `words` of the header of its image are columns about the exposure and its pointing, in place of those named so.

    `gain` is in electrons per count (None: that of the column's unit, else 1, with a remark). Fluxes are in electrons
    then.

    Raises `DataError` for a file without fluxes, for magnitudes in their place, for flags whose bits the map does not
    know, and where there is neither a position on the sky nor a WCS.
    """
    source, header = _table(Path(path))
    place, stated = Place(source.path, ""), header
    if words is not None:
        stated = ChainMap(of_header(header, words, (*OF_EXPOSURES, *POINTING), source.path), header)
    maps = [read_map(columns)] if columns is not None else [read_map(name) for name in SHIPPED]
    column_map = next((candidate for candidate in maps if _pair(source, candidate.flux)), None)
    if column_map is None:
        raise _no_flux(source, maps, place)
    flux, error, *sky = _fluxes(source, column_map, gain, place)
    ra, dec = _positions(source, column_map, header, place)
    flag = _flags(source, column_map, place)
    bad = ~(np.isfinite(flux) & np.isfinite(error) & (error > 0))
    of_stars = {name: column_of_stars(source, name) for name in OF_STARS if name in source.names}
    of_exposure = {name: _of_all(source, stated, name, place) for name in OF_EXPOSURES}
    if bad.any():
        what = "fluxes are not finite, or have no error above 0: not used"
        source.remarks.append(f"{int(bad.sum())} of {len(bad)} {what}")
    if low := int(np.sum(flux < -_NEGATIVE * error)):
        source.remarks.append(f"{low} of {len(bad)} fluxes are below 0 by more than {_NEGATIVE:g} errors")
    rows = np.sort(np.unique(np.stack([ra, dec, flux, error]), axis=1, return_index=True)[1])
    if copies := len(ra) - len(rows):
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
        of_stars={name: values[rows] for name, values in of_stars.items()},
        of_exposure={name: value for name, value in of_exposure.items() if value is not None},
        pointing={name: stated.get(name) for name in POINTING},
        header=header,
        remarks=(*source.remarks, *source.hints({"TEFF", "SOURCE_ID", "N_FLAG"})),
    )


def _table(path: Path) -> tuple[InputTable, Any]:
    """The table of a file, and the header of the image that it was made from, or of the table."""
    header: Any = {}
    try:
        with open_fits(path) as opened:
            names = [hdu.name for hdu in opened.hdus]
            if _HEADER in names:
                cards = np.asarray(opened.hdus[names.index(_HEADER)].data[0][0]).astype(str).ravel()
                header = fits.Header.fromstring("".join(card.ljust(80) for card in cards))
            elif len(opened.hdus) > 1:
                header = dict(opened.hdus[1].header)
            if _LDAC in names:
                path = Path(f"{path}[{_LDAC}]")
    except DataError:
        if path.suffix.lower() in (".fits", ".fit", ".ldac"):
            raise
    table_path, table, how = read_table_file(path, ())
    read = in_memory(table, str(table_path))
    read.remarks.extend(how)
    return read, header or {str(key).upper(): value for key, value in read.table.meta.items()}


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
) -> tuple[Numbers, ...]:
    """Fluxes, errors and the level of the sky, if there is one (electrons); without a unit they have the flux's."""
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


def _plain_numbers(source: InputTable, name: str, place: Place) -> Numbers:
    """A column without its unit."""
    unitless = in_memory({name: np.ma.asarray(_one(source, name, place))}, str(source.path))
    return numeric_column(unitless, name.upper(), Column("float", missing=np.nan))


def _positions(
    source: InputTable, column_map: ColumnMap, header: Mapping[str, Any], place: Place
) -> tuple[Numbers, Numbers]:
    """Right ascension and declination (deg): from the sky, or from pixels by the WCS of the header."""
    names = _pair(source, (*column_map.sky, ("RA", "DEC")))
    pixels = _pair(source, column_map.pixel)
    if len(names) == 1:
        directions = source.column(_plain(names[0])[0])
        if not hasattr(directions, "icrs"):
            raise place.fail("holds no coordinates of astropy", names[0], "name two columns, in degrees")
        ra, dec = (np.asarray(angle.deg, float) for angle in (directions.icrs.ra, directions.icrs.dec))
    elif names:
        ra, dec = sky_positions(source, [_plain(name)[0] for name in names])
    elif pixels and "CRVAL1" in header:
        plane = WCS(fits.Header(header) if not isinstance(header, fits.Header) else header)
        x, y = (_plain_numbers(source, name, place) for name in pixels)
        ra, dec = plane.celestial.all_pix2world(x, y, column_map.first_pixel)
        ra, dec = np.mod(np.asarray(ra, float), 360.0), np.asarray(dec, float)
    else:
        expected = column_map.sky[0] if column_map.sky else ("RA", "DEC")
        what = f"has neither {' and '.join(expected)} nor pixels with the WCS of their image"
        advice = "write these, or a catalogue with the header (FITS_LDAC); other names go into a TOML file (--columns)"
        raise place.fail(f"{what}; it has {some(list(source.names), 8)}", "", advice)
    unknown = ~(np.isfinite(ra) & np.isfinite(dec))
    place.refuse(unknown, "is not finite", ", ".join(names or pixels), "remove these rows")
    return ra, dec


def _flags(source: InputTable, column_map: ColumnMap, place: Place) -> Int[np.ndarray, " n"]:
    """Bits of FLAG."""
    name = next((name.upper() for name in column_map.flag if name.upper() in source.names), None)
    flag, rule = np.zeros(source.rows, np.int64), Column("int", missing=0, true=BAD_PIXEL)
    if name is None:
        source.remarks.append("no flags of the stars: blends and saturated ones are not known")
        return flag
    values = undefined = numeric_column(source, name, rule)
    if source.column(name).dtype.kind == "b":
        source.remarks.append(f"{name} holds truth values: true is taken as a bad pixel")
        return values
    for bit, meaning in column_map.bits.items():
        flag |= np.where(values & int(bit) > 0, meaning, 0)
        undefined = undefined & ~int(bit)
    odd = np.flatnonzero((undefined != 0) | (values < 0))
    if odd.size:
        what = f"is {values[odd[0]]} in {rows_text(odd)}, which is no flag of {column_map.program}"
        advice = "give the meaning of its bits in a map of columns: --columns FILE.toml, table [bits]"
        raise place.fail(what, name, advice)
    if empty := int(empty_cells(source, name, rule).sum()):
        source.remarks.append(f"{name} is empty in {empty} rows: taken as good")
    return flag


def _of_all(source: InputTable, header: Mapping[str, Any], name: str, place: Place) -> Any:
    """The value of a column, or of a word of the header, of the exposure; None: none. Refuses several values."""
    if name not in source.names:
        value = header.get(name)
        return value.strip() if isinstance(value, str) else value
    values = np.unique(np.ma.compressed(np.ma.asarray(source.column(name))))
    if len(values) > 1:
        raise place.fail("is not the same in all rows", name, "give the catalogue of one exposure")
    return values[0] if len(values) else None


def angle_of(catalogue: CameraCatalogue, name: str) -> float | None:
    """An angle of the pointing (deg): a number, or a text in hours (RA) or degrees; None: none is stated."""
    value = catalogue.pointing[name]
    if value is None or isinstance(value, bool) or value == "":
        return None
    for angle in (float, lambda text: float(degrees_of(str(text), "hourangle" if name == "RA" else "deg"))):
        with contextlib.suppress(ValueError):
            return angle(value)
    advice = f"give --{name.lower()} (deg) to walop-jax gather, or the word that holds it (--words)"
    raise Place(catalogue.path, "header").fail(f"{value!r} is no angle", name, advice)


def centre_of(header: Mapping[str, Any]) -> dict[str, float] | None:
    """RA and DEC of the centre of an image and the position angle of its axis x (deg), by its WCS; None: no WCS."""
    if "CRVAL1" not in header or "NAXIS1" not in header or not header.get("CTYPE1", "").startswith("RA"):
        return None
    plane = WCS(fits.Header(header) if not isinstance(header, fits.Header) else header).celestial
    middle = [0.5 * (float(header[f"NAXIS{k}"]) + 1.0) for k in (1, 2)]
    centre_pixel: Any = plane.pixel_to_world(middle[0] - 1.0, middle[1] - 1.0)
    beside: Any = plane.pixel_to_world(middle[0], middle[1] - 1.0)
    centre = centre_pixel.icrs
    angle = float(centre.position_angle(beside.icrs).deg)
    return {"RA": float(centre.ra.deg), "DEC": float(centre.dec.deg), "ROTATOR": angle}

"""Tables that astronomers bring along (FITS, CSV, ECSV): columns by name, checked, with units taken care of.

Column names know no upper and lower case. A cell that is empty or masked is NaN, or the value that the column
has where it is absent. Columns that nothing has asked for are named in a remark (`InputTable.about`).
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Collection, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.celestial import Frame, frame_of_names, made_icrs
from walop_jax.data.schema import MISSING, Column, distinct, plain_column, values_of
from walop_jax.data.table_files import read_table_file, table_of_hdu
from walop_jax.data.units import Place, check_units, degrees_of, is_sexagesimal, partner_of, unit_of
from walop_jax.io.errors import PathLike, fail
from walop_jax.io.fits_reading import one_line
from walop_jax.io.plain_tables import numbered
from walop_jax.io.text import in_ascii, some

_LISTED = 12  # columns, in a message
_LIKE = 0.7  # of names, for "did you mean"
_COLOUR = re.compile(
    r"T_?EFF|TEMPERATURE|COLOU?R|BP.?RP|PHOT_(BP|RP)_MEAN_MAG|SP(EC(TRAL)?)?_?TYPE|(?<![A-Z])[UBVRIGZYJHK]([-_]|_M_)[UBVRIGZYJHK](?![A-Z])"
)
"""Names, in capitals, of columns that say which colour a star has."""
_IDENTITY = re.compile(r"SOURCE_?ID|GAIA_?(E?DR\d)?_?(ID|NAME)?$|ID_?GAIA|DR\d_?(ID|NAME)$")

OF_STARS: Mapping[str, tuple[str, str]] = {
    "SOURCE_ID": ("", "source identifier, of Gaia"),
    "BP_RP": ("mag", "colour of Gaia"),
    "BP_RP_ERR": ("mag", "standard error of BP_RP"),
    "TEFF": ("K", "colour temperature"),
    "TEFF_ERR": ("K", "standard error of TEFF"),
    "PHOT_G_MEAN_MAG": ("mag", "magnitude G of Gaia"),
    "PARALLAX": ("mas", "parallax"),
    "PARALLAX_ERROR": ("mas", "standard error of PARALLAX"),
}
"""Columns about the stars themselves, with unit and description: they go with a star into every result."""


@dataclasses.dataclass(frozen=True)
class InputTable:
    """A table as it was read, to be handed back with columns added; `rows` is its length.

    `used` are the columns that were asked for and are there, `lacking` those that are not; `remarks` say how the table
    was read, and on its oddities.
    """

    path: Path
    rows: int
    table: Any
    remarks: list[str] = dataclasses.field(default_factory=list)
    used: set[str] = dataclasses.field(default_factory=set)
    lacking: set[str] = dataclasses.field(default_factory=set)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its columns in capitals."""
        return tuple(str(name).upper() for name in self.table.colnames)

    def column(self, name: str) -> Any:
        """A column, by its name in capitals; None if it is not there."""
        if name not in self.names:
            self.lacking.add(name)
            return None
        self.used.add(name)
        return self.table.columns[self.names.index(name)]

    def about(self, added: Collection[str] = ()) -> tuple[str, ...]:
        """Remarks, and sentences on columns that are not used, or are replaced by some of those `added`."""
        replaced = [name for name in self.names if name in added]
        unused = [name for name in self.names if name not in self.used and name not in replaced]
        sentences = list(self.remarks)
        renamed = [name for name in replaced if name in self.used]
        if renamed:
            sentences.append(f"{renamed[0]} of the table is {self.new_name(renamed[0])} in the result")
        if gone := [name for name in replaced if name not in self.used]:
            sentences.append(f"{_columns(gone)} replaced by the result")
        header = {str(key).upper(): value for key, value in self.table.meta.items()}
        for name in sorted(self.lacking & set(header) - set(self.names)):
            sentences.append(f"{name} = {header[name]} of the header is not used: give a column {name}")
        if unused:
            about = some(self.hints(self.lacking, unused), 3, "; ")
            sentences.append(f"{_columns(unused)} not used{f' ({about})' if about else ''}")
        return tuple(sentences)

    def hints(self, lacking: Set[str], names: Collection[str] | None = None) -> list[str]:
        """Names of `lacking` that unused columns may have been meant to have; of `names` those alike as well."""
        sure, alike = [], []
        for name in [n for n in self.names if n not in self.used] if names is None else names:
            if {"TEFF", "BP_RP"}.isdisjoint(self.used) and "TEFF" in lacking and _COLOUR.search(name):
                sure.append(f"{name}: the colour of a star is read from TEFF (K) or BP_RP (mag, of Gaia)")
            elif "SOURCE_ID" in lacking - self.used and _IDENTITY.search(name):
                sure.append(f"{name}: the identity of a star is read from SOURCE_ID")
            elif "FLAG" in name and "N_FLAG" in lacking:
                alike.append(f"{name}: flags are read from N_FLAG or FLAG, any bit means not used")
            elif names is not None and (like := difflib.get_close_matches(name, sorted(lacking), 1, _LIKE)):
                alike.append(f"{name}: did you mean {like[0]}?")
        return [*sure, *alike]

    def new_name(self, name: str) -> str:
        """The name of a column of the user's that is used and has the name of one that is added."""
        new = f"N_{name}"
        while new in self.names:
            new = f"OLD_{new.removeprefix('N_')}"
        return new


def _columns(names: Sequence[str]) -> str:
    return f"column{'s' if len(names) > 1 else ''} {', '.join(names)} {'are' if len(names) > 1 else 'is'}"


def read_input_table(path: PathLike, needed: Collection[str] = ("X", "Y")) -> InputTable:
    """Read a table with whatever columns it has; those `needed` (in capitals) tell it from others in its file.

    Raises `DataError` if the file is missing, damaged, no table, has no rows, or names a column twice.
    """
    resolved, table, remarks = read_table_file(Path(path), needed)
    return _input_table(resolved, table, remarks)


def in_memory(columns: Any, name: str = "the table") -> InputTable:
    """A table given in memory, copied.

    It is an astropy table, a data frame, a structured array, a table of an open FITS file, or columns by name (arrays,
    quantities, …). The index of a data frame is a column where it has a name. `name` is what errors call the table.
    Raises `DataError` if it has no rows, or columns of different lengths.
    """
    from astropy.io import fits
    from astropy.table import Table

    try:
        if isinstance(columns, Table):
            table = Table(columns)  # quantities become columns with a unit
        elif isinstance(columns, fits.FITS_rec | fits.BinTableHDU):
            hdu = fits.BinTableHDU(columns) if isinstance(columns, fits.FITS_rec) else columns
            table = Table(table_of_hdu(hdu))
        elif getattr(getattr(columns, "dtype", None), "names", None):
            table = Table(columns)
        elif hasattr(columns, "to_numpy") and hasattr(columns, "columns"):  # a data frame
            levels = getattr(getattr(columns, "index", None), "names", ())
            named = [level for level in levels if level is not None and level not in columns.columns]
            table = Table.from_pandas(columns.reset_index(named) if named else columns)
        else:
            arrays = {
                str(key): values if np.ndim(values) and hasattr(values, "jd1") else np.atleast_1d(values)
                for key, values in dict(columns).items()
            }
            rows = max((len(values) for values in arrays.values()), default=0)
            single = {key for key, values in dict(columns).items() if np.ndim(values) == 0}
            table = Table({k: np.repeat(v, rows, axis=0) if k in single else v for k, v in arrays.items()})
    except (TypeError, ValueError) as error:
        advice = "give columns of one length"
        raise fail(f"is no table: {one_line(error)}", file=name, advice=advice) from error
    return _input_table(Path(name), table)


def _input_table(path: Path, table: Any, remarks: Sequence[str] = ()) -> InputTable:
    if len(table) == 0:
        raise fail("has no rows", file=path, advice="nothing to be done")
    distinct((str(name).upper() for name in table.colnames), Place(path, ""))
    return InputTable(path, len(table), table, list(remarks))


def numeric_column(source: InputTable, name: str, rule: Column) -> np.ndarray:
    """A column in the unit and of the kind of `rule`; `DataError`, with rows, for what cannot be converted."""
    place, column = Place(source.path, ""), source.column(name)
    if column is not None:
        if (partner := partner_of(name)) in source.names and rule.kind == "float":
            beside = unit_of(source.table.columns[source.names.index(partner)])
            check_units({partner: beside, name: unit_of(column)}, rule.unit, place)
        return values_of(column, name, rule, place, lenient=True)
    if rule.missing is None:
        raise place.fail("the column is missing", name, f"add it, or name it so; {_what_is_there(source)}")
    return np.full(source.rows, rule.missing)


_FEWEST_STARS = 10  # stars from which on the shape of a field tells hours from degrees
_FLAT = 0.25  # of the extent in declination: hours taken as degrees have a fifteenth


def sky_positions(
    source: InputTable, names: Sequence[str] = ("RA", "DEC"), frame: Frame | None = None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Right ascensions and declinations (deg, ICRS) of a table; as sexagesimal texts they are in hours and degrees.

    They are in the reference system that their names state (…_J2000, …_B1950), else in `frame` (None: that of the
    header of the table), and are converted, with a remark.

    Empty cells are NaN. Raises `DataError` for values that are no angles or out of range, and for right ascensions
    without a unit that are hours: none beyond 24, of a field that would be a fifteenth as wide as high.
    """
    ra, dec = (_angles(source, *pair) for pair in zip(names, ("hourangle", "deg"), strict=True))
    place = Place(source.path, "")
    place.refuse(np.abs(ra) > 360.0, "is beyond ±360°", names[0], "right ascensions in degrees are needed")
    place.refuse(np.abs(dec) > 90.0, "is beyond ±90°", names[1], "declinations in degrees are needed")
    column, stated = source.column(names[0]), ra[np.isfinite(ra)]
    with_unit = unit_of(column) or column.dtype.kind not in "fiu"
    if with_unit or not stated.size or np.abs(stated - 12.0).max() > 12.0:
        return _in_icrs(source, names, frame, ra, dec)
    from_first = np.mod(stated - stated.min() + 12.0, 24.0)  # a field about 0 h is no wider than others
    width = np.std(from_first) * np.cos(np.deg2rad(np.nanmedian(dec)))
    if len(ra) < _FEWEST_STARS:
        what = "has no unit: taken as degrees; hours need the unit hourangle, or texts hh:mm:ss"
        source.remarks.append(f"{names[0]} {what}")
    elif width < _FLAT * np.nanstd(dec):
        what = f"lies between {stated.min():.4g} and {stated.max():.4g}, has no unit, and looks like hours"
        raise place.fail(what, names[0], "degrees are needed: multiply by 15, or give the unit hourangle")
    return _in_icrs(source, names, frame, ra, dec)


def _in_icrs(
    source: InputTable, names: Sequence[str], frame: Frame | None, ra: np.ndarray, dec: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    frame = frame_of_names(names) or frame
    if frame is None:
        header, mjd = source.table.meta, np.array(np.nan)
        if "MJD" in source.names and str(header.get("RADESYS", "")).strip().upper() == "GAPPT":
            mjd = numeric_column(source, "MJD", Column("float", "d", missing=np.nan))
        ra, dec, frame = made_icrs(header, ra, dec, mjd, Place(source.path, "header"))
    else:
        ra, dec = frame.to_icrs(ra, dec)
    remark = f"{', '.join(names)} are in {frame}: converted to ICRS"
    if not frame.is_icrs and remark not in source.remarks:
        source.remarks.append(remark)
    return ra, dec


def _angles(source: InputTable, name: str, unit: str) -> Float[np.ndarray, " n"]:
    """A column of angles in degrees; `unit` (hourangle, deg) is that of sexagesimal ones."""
    column = source.column(name)
    if column is not None and column.dtype.kind in "OSU":
        texts = np.char.strip(np.ma.filled(np.ma.asarray(column).astype(str), ""))
        if any(map(is_sexagesimal, texts.tolist())):
            angles, stated = np.full(len(texts), np.nan), texts != ""
            try:
                angles[stated] = degrees_of(texts[stated].tolist(), unit)
                return angles
            except ValueError as error:
                advice = "write hh:mm:ss.s and ±dd:mm:ss"
                raise Place(source.path, "").fail(one_line(error), name, advice) from None
    return numeric_column(source, name, Column("float", "deg"))


def column_of_stars(source: InputTable, name: str) -> np.ndarray:
    """A column of `OF_STARS`: numbers (NaN: unknown), identifiers as texts ("": unknown)."""
    unit, _ = OF_STARS[name]
    if name != "SOURCE_ID":
        return numeric_column(source, name, Column("float", unit, missing=np.nan))
    values, empty, _ = plain_column(source.column(name), name, Column("str"), Place(source.path, ""))
    refuse_rounded(values, empty, name, Place(source.path, ""))
    if values.dtype.kind == "f":
        whole = np.isfinite(values) & ~empty
        return np.where(whole, np.where(whole, values, 0).astype(np.int64).astype(str), "").astype(object)
    return numeric_column(source, name, Column("str", missing=""))


def refuse_rounded(values: np.ndarray, missing: np.ndarray, name: str, place: Place) -> None:
    """Refuse identifiers that are floats too large to be distinct."""
    if values.dtype.kind == "f":
        digits = np.finfo(values.dtype).nmant + 1
        what = f"is a float beyond 2**{digits}, where neighbouring numbers are one"
        advice = "write identifiers as integers or as text"
        place.refuse(~missing & (np.abs(values) >= 2.0**digits), what, name, advice)


def _what_is_there(source: InputTable) -> str:
    return f"the table has {some([str(name) for name in source.table.colnames], _LISTED)}"


def vector_columns(
    source: InputTable, names: Sequence[str], rule: Column, cameras: Sequence[str]
) -> list[np.ndarray]:
    """Columns with `rule.width` numbers in a row, or that many side by side (`spellings`), which text formats need.

    Raises `DataError` as `numeric_column` does, for a row of another width, and where only some of them have a unit
    that is converted.
    """
    single = dataclasses.replace(rule, width=1)
    columns_of = {name: _side_by_side(source, name, rule.width or 1, cameras) for name in names}
    columns = {name_of: source.column(name_of) for name in names for name_of in columns_of[name]}
    units = {name_of: unit_of(column) for name_of, column in columns.items() if column is not None}
    values = [
        numeric_column(source, name, rule)
        if columns_of[name] == [name]
        else np.stack([numeric_column(source, name_of, single) for name_of in columns_of[name]], axis=1)
        for name in names
    ]
    check_units(units, rule.unit, Place(source.path, ""))
    return values


def _side_by_side(source: InputTable, name: str, width: int, cameras: Sequence[str]) -> list[str]:
    """The columns that hold `width` numbers in a row: one of that name, or one for each number."""
    forms = spellings(name, width, cameras)
    spelling = next((form for form in forms if any(column in source.names for column in form)), None)
    if spelling is None:
        source.lacking.update(name for form in forms[:3] for name in form)
        listed = ", or ".join(f"{form[0]} … {form[-1]}" for form in forms[1:3])
        advice = f"add it, or {listed}; {_what_is_there(source)}"
        raise Place(source.path, "").fail("the column is missing", name, advice)
    return spelling


def spellings(name: str, width: int, cameras: Sequence[str]) -> list[list[str]]:
    """Forms of a column with `width` numbers: N_ERR; N0_ERR …; by cameras O1_ERR … (of SKY O1_SKY …); N_ERR0 …"""
    head, _, tail = name.partition("_")
    end = f"_{tail}" if tail else ""
    of_camera = end if head == "N" else f"_{name}"
    by_camera = [f"{camera.upper()}{of_camera}" for camera in cameras]
    ends = [f"{name}{k}" for k in range(width)]
    return [[name], numbered(name, width), by_camera, ends]


def empty_cells(source: InputTable, name: str, rule: Column) -> Bool[np.ndarray, " n"]:
    """True where a column has no value: masked, or a text that says so."""
    values, empty, _ = plain_column(source.column(name), name, rule, Place(source.path, ""))
    if values.dtype.kind in "OSU":
        empty = empty | np.isin(np.char.lower(np.char.strip(values.astype(str))), MISSING)
    return np.any(empty.reshape(source.rows, -1), axis=1)


def extended(source: InputTable, added: Mapping[str, Any], header: Mapping[str, Any] | None = None) -> Any:
    """The table with columns added, an astropy table.

    An old column of that name is replaced, or gets a `new_name` if it was used. A value of `added` is an array, alone
    or with its description and its unit; `header` adds to the header of the table, as do the remarks (CSV has none).
    """
    table = source.table.copy(copy_data=False)
    for key in [key for key in table.meta if key.upper() in ("CHECKSUM", "DATASUM", "EXTNAME", "REMARK")]:
        del table.meta[key]
    table.meta.update(header or {})
    if remarks := source.about(added):
        table.meta["REMARK"] = [in_ascii(text) for text in remarks]
    present = {str(name).upper(): name for name in table.colnames}
    for name, values in added.items():
        if name in present and name in source.used:
            table.rename_column(present[name], source.new_name(name))
        elif name in present:
            table.remove_column(present[name])
        values, *about = values if isinstance(values, tuple) else (values,)
        table[name] = values
        for attribute, text in zip(("description", "unit"), about, strict=False):
            if text:
                setattr(table[name], attribute, text)
    return table

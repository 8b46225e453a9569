"""Files of tables as other programs write them: packed, FITS with several extensions, dialects of CSV."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.data.schema import EXPOSURES, MISSING, undefined
from walop_jax.io.errors import DataError, fail, rows_text
from walop_jax.io.fits_reading import UNREADABLE, one_line, open_fits, unpacked
from walop_jax.io.plain_tables import table_format
from walop_jax.io.text import check_input, some, unpacking

_PACKED = (".gz", ".bz2", ".xz")
_ALSO = {".tsv": "ascii.csv", ".txt": "ascii.csv", ".dat": "ascii.csv", ".xml": "votable"}
_SEXTRACTOR = b"#   1 "
"""The begin of a text (ASCII_HEAD) of SExtractor: its first column, by number."""
_SEPARATORS = (",", ";", "\t", "|")
_NAMES = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}
_CLASSES = bytes.maketrans(b'123456789,;\t|\n" ', b"ddddddddd" + b"s" * 7)  # digits and what separates cells
_LOOKED_AT = 200  # lines, for their separators of decimals
_NUMBER = re.compile(r"[+-]?\d[\d.,]*([eE][+-]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_OF_PRIMARY = (*EXPOSURES, "INSTRUME", "RADESYS", "RADECSYS", "EQUINOX", "MJD-OBS", "DATE-OBS")
"""Words of a primary header that say something of a table behind it."""
_SCALES = ("UTC", "TAI", "TT", "TDB", "TCB", "TCG", "UT1")


def read_table_file(path: Path, needed: Collection[str]) -> tuple[Path, Any, tuple[str, ...]]:
    """The file, the astropy table in it, and remarks on how it was read.

    `needed` are columns, in capitals, that decide between several tables of a FITS file (`file.fits[NAME]` is one of
    them by name or number) and between separators of a text. Raises `DataError` if the file is missing, damaged or no
    table.
    """
    bracket = None if path.exists() else re.fullmatch(r"(.+)\[([^\[\]]+)\]", str(path))
    path, extension = (path, "") if bracket is None else (Path(bracket[1]), bracket[2].strip())
    path = check_input(path)
    from astropy.table import Table  # imported here: it takes a third of a second

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if _begins(path, b"SIMPLE  ="):  # whatever its name is
                return path, *_from_fits(path, extension, needed)
            if _begins(path, _SEXTRACTOR):
                return path, _astropy_table(_content(path)[0].decode(), "ascii.sextractor"), ()
            if path.suffix.lower() in (".cat", ".ldac"):
                what = (
                    "begins neither as ASCII_HEAD nor as FITS_LDAC of SExtractor: its columns have no names"
                )
                raise fail(what, file=path, advice="write it again with one of these as CATALOG_TYPE")
            kind = "" if path.suffix.lower() == ".zip" else _format(path)
            if kind == "fits":
                return path, *_from_fits(path, extension, needed)
            if kind == "parquet":
                return path, Table.read(path, format=kind), ()
            content, inside = _content(path)
            kind = kind or _format(Path(inside))
            if kind == "ascii.csv":
                return path, *_from_csv(_decoded(content, path), path, needed)
            return path, _astropy_table(content, kind), ()
    except DataError:
        raise
    except ImportError as error:
        what = f"needs {error.name or 'a library'}, which is not installed"
        raise fail(what, file=path, advice="pip install 'walop-jax[parquet]'") from error
    except UNREADABLE as error:
        what = f"cannot be read as a table: {one_line(error)}"
        raise fail(what, file=path, advice="write it again") from error


def _format(path: Path) -> str:
    plain = path.with_suffix("") if path.suffix.lower() in _PACKED else path
    return _ALSO.get(plain.suffix.lower()) or table_format(plain)


def _content(path: Path) -> tuple[bytes, str]:
    """The bytes of a file, unpacked, and the name of the file that they are of."""
    packed = unpacking(path)
    if packed is None:
        return path.read_bytes(), path.name
    with packed[0] as stream:
        return unpacked(stream, path), packed[1]


def _begins(path: Path, start: bytes) -> bool:
    packed = unpacking(path)
    with path.open("rb") if packed is None else packed[0] as stream:
        return stream.read(len(start)) == start


def _astropy_table(content: bytes | str, kind: str, **options: Any) -> Any:
    from astropy.table import Table  # imported here: it takes a third of a second

    if isinstance(content, bytes) and kind == "votable":
        return Table.read(io.BytesIO(content), format=kind)
    text = content.decode() if isinstance(content, bytes) else content
    return Table.read(f"{text}\n", format=kind, **options)  # a text of one line would be the name of a file


# ------------------------------------------------------------------------------------------------------------- FITS


def _from_fits(path: Path, extension: str, needed: Collection[str]) -> tuple[Any, tuple[str, ...]]:
    """The table of a FITS file that is named, or the only one that has the columns that are needed."""
    with open_fits(path) as opened:
        tables = {n: hdu for n, hdu in enumerate(opened.hdus) if type(hdu).__name__ == "BinTableHDU"}
        labels = {n: hdu.name or str(n) for n, hdu in tables.items()}
        listed = ", ".join(labels.values())
        if not tables:
            raise fail("has no table", file=path, advice="write one, or use a CSV file")
        chosen = list(tables)
        if extension:
            chosen = [n for n in tables if extension.upper() in (labels[n].upper(), str(n))]
            if not chosen:
                raise fail(f"has no table {extension!r}", file=path, advice=f"there is {listed}")
        elif len(tables) > 1:
            chosen = [n for n in tables if set(needed) <= {name.upper() for name in tables[n].columns.names}]
            if not chosen:
                what = f"none of the tables {listed} has {' and '.join(needed)}"
                raise fail(what, file=path, advice=f"name one: {path.name}[{labels[next(iter(tables))]}]")
        if len(chosen) > 1:
            several = ", ".join(labels[n] for n in chosen)
            what = f"has several tables that could be meant ({several})"
            raise fail(what, file=path, advice=f"name one: {path.name}[{labels[chosen[0]]}]")
        hdu = tables[chosen[0]]
        table = table_of_hdu(hdu)
        _add_words(table, opened.hdus[0].header, path)
    unread = [label for n, label in labels.items() if n != chosen[0]]
    remark = f"the table {labels[chosen[0]]} is read, not {some(unread, 5)}"
    return table, (remark,) if unread and not extension else ()


def _add_words(table: Any, primary: Any, path: Path) -> None:
    """Add the words of the primary header that a table may need and has not, to its own, which count before them."""
    own = {str(key).upper(): value for key, value in table.meta.items()}
    one, other = (str(words.get("INSTRUME", "")).strip() for words in (own, primary))
    if one and other and one.upper() != other.upper():
        what = f"is {one} in the header of the table and {other} in the primary header"
        raise fail(what, file=path, column="INSTRUME", advice="correct the one that is wrong")
    table.meta.update({name: primary[name] for name in _OF_PRIMARY if name in primary and name not in own})


def table_of_hdu(hdu: Any) -> Any:
    """The astropy table of an extension: undefined values are masked, times are astropy times."""
    from astropy.table import Table

    table = Table.read(hdu, character_as_bytes=False)
    _hide_undefined(table, hdu)
    _times(table, hdu)
    return table


def _hide_undefined(table: Any, hdu: Any) -> None:
    """Mask undefined values; astropy compares TNULL with scaled values."""
    from astropy.table import MaskedColumn

    for index, name in enumerate(hdu.columns.names):
        missing = undefined(hdu, index)
        if hdu.columns[index].null not in (None, "") or missing.any():
            old = table[name]
            values = np.ma.getdata(np.ma.asarray(old))
            table[name] = MaskedColumn(values, mask=missing, unit=old.unit, description=old.description)


def _times(table: Any, hdu: Any) -> None:
    """Make times of what astropy writes of them: two parts of a Julian date, with its scale in the header."""
    from astropy.time import Time

    for column in hdu.columns:
        scale = str(column.coord_type or "").upper()
        if scale in _SCALES and np.shape(table[column.name])[1:] == (2,):
            days, fraction = np.moveaxis(np.ma.filled(np.ma.asarray(table[column.name]), np.nan), -1, 0)
            table[column.name] = Time(days, fraction, format="jd", scale=scale.lower())


# -------------------------------------------------------------------------------------------------------------- CSV


def _decoded(content: bytes, path: Path) -> str:
    """The text of a file in UTF-8, or in UTF-16 with its mark; line ends are made those of Unix."""
    encoding = "utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        what = f"is not text in UTF-8 (byte {error.start})"
        raise fail(what, file=path, advice="save it as UTF-8") from None
    if "\0" in text:
        raise fail("holds NUL characters", file=path, advice="is it text? Save it as CSV in UTF-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _from_csv(text: str, path: Path, needed: Collection[str]) -> tuple[Any, tuple[str, ...]]:
    """The table of a text with a line of names, whatever stands between its columns."""
    if text.startswith("# %ECSV"):
        return _astropy_table(text, "ascii.ecsv"), ()
    remarks = []
    text, comments, separator = _body(text)
    header, _, body = text.partition("\n")
    if comments and _NUMBER.fullmatch(re.split(r"[,;\t| ]", header.strip())[0]):
        header, body = comments[-1], text  # the line of names is a comment, as numpy writes it
        text = f"{header}\n{body}"
    separator = separator or _separator_of(header, needed)
    if separator != ",":
        body, decimals = _with_points(body, separator, path)
        remarks.append(f"columns are separated by {_NAMES.get(separator, separator)}{decimals}")
        text = f"{header}\n{body}"
    kind = "ascii.tab" if separator == "\t" else "ascii.basic"  # which refuse rows that are too short
    try:
        options = {"delimiter": separator} if kind == "ascii.basic" else {}
        table = _astropy_table(text + "\n", kind, guess=False, **options)
    except UNREADABLE as error:
        what = f"cannot be read as a table: {one_line(error)}"
        advice = f"line 1 should name the columns, separated as the values are; it is {header[:60]!r}"
        if uneven := re.search(r"inconsistent with data columns.*line (\d+)", str(error)):
            what = f"has not as many cells as line 1 in {rows_text([int(uneven[1])])}"
            advice = "write empty cells too"
        commas = "decimal commas need semicolons between columns"
        raise fail(what, file=path, advice=f"{advice}; {commas}") from error
    for index, name in enumerate(table.colnames):
        if name.upper() == "ID" and table[name].dtype.kind in "if":
            _keep_texts(table, index, text, separator)
    return table, tuple(remarks)


def _keep_texts(table: Any, index: int, text: str, separator: str) -> None:
    """Make a column of numbers one of texts if numbers are fewer: 007 and 7 are two identifiers."""
    numbers = table.columns[index]
    letters = text.encode().translate(_CLASSES)
    if numbers.dtype.kind == "i" and b"s00" not in letters and b"s0d" not in letters:
        return
    rows = csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=True)
    texts = [row[index].strip() for row in rows if row][1:]
    values = np.unique(np.ma.compressed(np.ma.masked_invalid(numbers)))
    if len({cell for cell in texts if cell.lower() not in MISSING}) > len(values):
        table.replace_column(table.colnames[index], np.array(texts))


def _body(text: str) -> tuple[str, list[str], str]:
    """The text without comments and empty lines ahead of it; the comments; the separator that a spreadsheet states."""
    comments, separator = [], ""
    while text:
        line, _, following = text.partition("\n")
        stated = re.fullmatch(r'"?sep=(.|\\t)"?,*', line.strip(" \n"), re.IGNORECASE)
        if stated:
            separator = stated[1].replace("\\t", "\t")
        elif line.startswith("#"):
            comments.append(line.lstrip("# "))
        elif line.strip(' ,;\t"'):
            break
        text = following
    if "\n#" in text:
        text = re.sub(r"(?m)^#.*\n?", "", text)
    return text, comments, separator


def _separator_of(header: str, needed: Collection[str]) -> str:
    """Separator of the names in a line such that those needed are among them; else one that occurs, a comma first."""
    occurring = [separator for separator in _SEPARATORS if separator in header]
    for separator in occurring:
        if set(needed) <= {name.strip(" \"'").upper() for name in header.split(separator)}:
            return separator
    names = {name.upper() for name in header.split()}
    blank = not occurring and len(names) > 1 and set(needed) <= names
    return " " if blank else (occurring or [","])[0]


def _with_points(rest: str, separator: str, path: Path) -> tuple[str, str]:
    """Lines with decimal commas as such with points, and words for that; `DataError` where both are there."""
    lines = rest.split("\n", _LOOKED_AT)[:_LOOKED_AT]
    parts = (line.split(separator if separator != " " else None) for line in lines)
    cells = [cell.strip(' "') for line in parts for cell in line]
    numbers = [cell for cell in cells if _NUMBER.fullmatch(cell)]
    if not any("," in cell for cell in numbers):
        return rest, ""
    odd = [c for c in numbers if "." in c or ("," in c and not _DECIMAL_COMMA.fullmatch(c))]
    if odd:
        what = f"holds numbers with commas and {'with points' if '.' in odd[0] else 'several commas'}: {odd[0]!r}"
        advice = "write them with a decimal point and without separators of thousands"
        raise fail(what, file=path, advice=advice)
    between = re.escape(separator) if separator != " " else r"\s"
    comma = re.compile(rf'(?m)(^|[{between}" ])([+-]?\d+),(\d+(?:[eE][+-]?\d+)?)(?=$|[{between}" ])')
    return comma.sub(r"\1\2.\3", rest), ", decimals by commas"

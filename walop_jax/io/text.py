"""Text: numbers with errors (two digits of the error, and the value to match), and files of text.

Files to be read are ordinary ones; text, TOML, plain data as JSON without NaN and infinities, and packed files.
"""

from __future__ import annotations

import bz2
import datetime
import gzip
import io
import json
import lzma
import math
import os
import re
import stat
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from walop_jax.io.errors import PathLike, fail

_MOST_PLACES = 8
_WRITTEN_OUT = 1e7
_TINY = 1e-15  # probabilities below are not to be taken at their word
_SUPERSCRIPTS = "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"
RAISED = str.maketrans("-0123456789", _SUPERSCRIPTS)
_LOWERED = str.maketrans(_SUPERSCRIPTS, "-0123456789")


def with_error(value: float, sigma: float) -> str:
    """Value and error, two digits of the error: 0.23227 ± 0.00024."""
    return " ± ".join(value_and_error(value, sigma)) if sigma > 0 else value_and_error(value, sigma)[0]


def value_and_error(value: float | str | None, sigma: float | None) -> tuple[str, str]:
    """Value and error as two texts, both to the second digit of the error; the error is empty where there is none."""
    if isinstance(value, str):
        return value, ""
    if value is None or not math.isfinite(value):
        return "–", ""
    if sigma is None or not 0 < sigma < math.inf:
        return with_minus_sign(f"{value:.7g}"), ""
    # Rounded first: 0.0996 has its second digit where 0.10 has it.
    places = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))
    if places > _MOST_PLACES:
        digits = max(0, places + math.floor(math.log10(abs(value) or sigma)))
        return with_minus_sign(f"{value:.{digits}e}"), with_minus_sign(f"{sigma:.1e}")
    shown = max(0, places)
    return with_minus_sign(f"{round(value, places) + 0.0:.{shown}f}"), f"{round(sigma, places):.{shown}f}"


def in_its_unit(number: str, unit: str) -> str:
    """A number as text with its unit, and without a blank behind it where it has none."""
    return f"{number} {unit}".rstrip()


def date_of(mjd: float) -> str:
    """The calendar date (UTC) of a Modified Julian Date: 2026-06-29."""
    return (datetime.datetime(1858, 11, 17) + datetime.timedelta(days=float(mjd))).date().isoformat()


def with_minus_sign(text: str) -> str:
    """A number with a true minus sign; that of a power of ten stays as it is typed: −0.3, but 1.6e-05."""
    return re.sub("(?<!e)-", "−", text)


def rounded(value: float | None, form: str = ".4g") -> str:
    """A number, or a dash where there is none; powers of ten only beyond 10⁷ and below 10⁻⁴."""
    if value is None or not math.isfinite(value):
        return "–"
    text = format(value, form)
    if "e+" in text and abs(value) < _WRITTEN_OUT:
        text = f"{float(text):.0f}"
    return with_minus_sign(text.removesuffix("."))


def two_digits(value: float | None) -> str:
    """A number to two digits, zeros included: 0.40, 2.0, 120."""
    return rounded(value, "#.2g")


def beside(value: float, limit: float, form: str = "#.{}g") -> tuple[str, str]:
    """A number and the limit that decides on it, as texts: to two digits, and to as many more as tell them apart.

    `form` takes the number of digits. The limit keeps its two digits where these say it exactly.

    >>> beside(0.0503, 0.05), beside(0.083, 0.05)
    (('0.0503', '0.050'), ('0.083', '0.050'))
    """

    def both(digits: int) -> tuple[str, str]:
        return rounded(value, form.format(digits)), rounded(limit, form.format(digits))

    texts = first = both(2)
    for digits in range(3, 10):
        if value == limit or texts[0] != texts[1]:
            break
        texts = both(digits)
    exact = math.isfinite(limit) and math.isclose(float(first[1].replace("−", "-")), limit, rel_tol=1e-12)
    return texts[0], first[1] if exact and texts[0] != first[1] else texts[1]


NOISE = 1e-8
"""Fraction below which an effect on q, u or p is rounding noise of float64 optics, and no result."""


def per_cent(fraction: float | None) -> str:
    """A fraction in per cent to two digits, without the sign: 0.23; `< 10⁻⁶` for what is rounding noise."""
    if fraction is not None and 0.0 < abs(fraction) < NOISE:
        return f"< 10{str(round(math.log10(100.0 * NOISE))).translate(RAISED)}"
    return two_digits(None if fraction is None else 100.0 * fraction)


def per_cent_range(low: float, high: float) -> str:
    """A range of fractions in per cent, as `two_digits_range` writes it."""
    if not math.isfinite(low):
        return ""
    if low < NOISE:
        return (
            "0" if high == 0.0 else per_cent(high) if high < NOISE else f"{per_cent(low)} … {per_cent(high)}"
        )
    return two_digits_range(100.0 * low, 100.0 * high)


def two_digits_range(low: float, high: float) -> str:
    """A range to two digits, or one number where its ends are nearly the same; empty where there is none."""
    if not math.isfinite(low):
        return ""
    return two_digits(low) if high < 1.05 * low else f"{two_digits(low)} … {two_digits(high)}"


def probability(p: float | None) -> str:
    """`= 0.43`, `= 2.1 × 10⁻⁷` or `< 10⁻¹⁵`."""
    if p is None or not math.isfinite(p):
        return "unknown"
    if p < _TINY:
        return "< 10⁻¹⁵"
    if p >= 1e-3:
        return f"= {p:.2g}"
    mantissa, exponent = f"{p:.1e}".split("e")
    return f"= {mantissa} × 10{str(int(exponent)).translate(RAISED)}"


# ---------------------------------------------------------------------------------------------------------------- files

_DEEPEST = 30
_DEEP = "not valid TOML here: tables nested too deep"
_LARGEST = 1 << 24
"""Bytes of a text file beyond which it is none of ours."""


def read_text(path: PathLike) -> str:
    """The text of a file, without its byte-order mark; `DataError` if it is missing, beyond 16 MiB or not in UTF-8."""
    try:
        if check_input(path).stat().st_size > _LARGEST:
            raise fail("is larger than 16 MiB", file=path, advice="is this the right file?")
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise fail(f"cannot be read: {error.strerror or error}", file=path) from None
    except UnicodeDecodeError:
        raise fail("is not text in UTF-8", file=path) from None


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text; ValueError for one that is not valid or nests tables and lists without reason."""
    try:
        content = tomllib.loads(text)
    except ValueError as error:
        raise ValueError(f"not valid TOML: {error}") from None
    except RecursionError:
        raise ValueError(_DEEP) from None
    level: list[Any] = [content]
    for _ in range(_DEEPEST):
        inner = (entry.values() if isinstance(entry, dict) else entry for entry in level)
        level = [value for entry in inner for value in entry if isinstance(value, dict | list)]
    if level:
        raise ValueError(_DEEP)
    return content


def read_json(path: PathLike) -> Any:
    """The content of a JSON file that this program has written; `DataError` as for `read_text`, or if it is none."""
    text = read_text(path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        advice = "run the command that made it again"
        raise fail(f"cannot be read: {error}", file=path, advice=advice) from error


def json_text(value: Any) -> str:
    """The JSON text of a value, indented, with a final newline; null for numbers that are not finite."""
    return json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def some(items: Sequence[str], most: int, between: str = ", ") -> str:
    """The first of some texts, and how many more there are."""
    suffix = f" and {len(items) - most} more" if len(items) > most else ""
    return f"{between.join(items[:most])}{suffix}"


def plain(value: Any) -> Any:
    """The value with mappings as dicts, sequences as lists, numbers that are not finite as None, texts `encodable`.

    Paths are texts.
    """
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return encodable(os.fspath(value)) if isinstance(value, str | os.PathLike) else value


def encodable(text: str) -> str:
    """The text with the bytes of a path that are not UTF-8, which no output takes, written as \\xff."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


_SPELT = {
    "χ²": "chi2", "×": "x", "·": "*", "°": " deg", "±": "+-", "−": "-", "–": "-",
    "—": "-", "…": "...", "µ": "u", "σ": "sigma", "δ": "delta", "η": "eta", "κ": "kappa", "λ": "lambda",
    "φ": "phi", "ε": "epsilon", "θ": "theta", "α": "alpha", "γ": "gamma", "π": "pi", "Δ": "Delta",
    "√": "sqrt", "½": "1/2", "′": "'", "→": "->", "≥": ">=", "≤": "<=",
}  # fmt: skip


def in_ascii(text: str) -> str:
    """The text on one line in ASCII: signs spelt out where that is usual, escaped (\\u00e9) otherwise."""
    for sign, word in _SPELT.items():
        text = text.replace(sign, word)
    text = re.sub(f"[{_SUPERSCRIPTS}]+", lambda found: f"^{found[0].translate(_LOWERED)}", text)
    return " ".join(text.encode("ascii", "backslashreplace").decode("ascii").split())


_OTHERS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_input(path: PathLike) -> Path:
    """Return `path` if it is that of an ordinary file, or of a link to one.

    Raises `DataError` if nothing is there, and for folders, named pipes, sockets and devices: opening a pipe waits
    for a writer, and a device may never end.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise fail("there is no such file", file=path, advice="check the name") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise fail(f"cannot be read: {reason}", file=path, advice="check the name") from None
    if stat.S_ISDIR(mode):
        raise fail("is a folder", file=path, advice="give the name of a file in it")
    if not stat.S_ISREG(mode):
        what = _OTHERS.get(stat.S_IFMT(mode), "no ordinary file")
        raise fail(f"is {what}", file=path, advice="copy its content to a file first")
    return path


_PACKED = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ\x00": lzma.open}


def unpacking(path: Path) -> tuple[io.BufferedIOBase, str] | None:
    """A stream of the content of a packed file (gzip, bzip2, xz, zip) and the name of that; None if it is not packed.

    Raises `DataError` for an archive that does not hold just one file.
    """
    with path.open("rb") as raw:
        head = raw.read(6)
    if head.startswith(b"PK\x03\x04"):
        archive = zipfile.ZipFile(path)
        entries = [entry for entry in archive.infolist() if not entry.is_dir()]
        names = [entry.filename for entry in entries if not entry.filename.startswith("__MACOSX/")]
        if "[Content_Types].xml" in names:
            raise fail("is a workbook of a spreadsheet program", file=path, advice="save the sheet as CSV")
        if len(names) != 1:
            what = f"holds {len(names)} files ({some(names, 5)})"
            raise fail(what, file=path, advice="unpack it, and give one of them")
        if entries[0].flag_bits & 1:
            raise fail("is encrypted", file=path, advice="unpack it first")
        return archive.open(names[0]), names[0]  # pyright: ignore[reportReturnType]
    opener = next((opener for start, opener in _PACKED.items() if head.startswith(start)), None)
    return None if opener is None else (opener(path, "rb"), path.stem)

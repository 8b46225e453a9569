"""The structure of a FITS file, from its header cards alone, before a library believes them.

What a header announces (number of axes, rows, columns, groups) is held against the length of the file: a count that
is negative or beyond all bounds makes readers loop or ask for any amount of memory. FITS standard 4.0, sections
4.4.1 (sizes), 7.3 (binary tables).
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path

from walop_jax.io.errors import DataError, fail

BLOCK = 2880
_CARD = 80
_MOST_BLOCKS = 1000  # of one header: 36 000 cards
_MOST_HDUS = 1000
_MOST = 999  # axes, and columns of a table
BROKEN = "the copy is damaged or incomplete; transfer or write the file again"

_INTEGER = re.compile(r"\s*([+-]?\d+)\s*(/.*)?$")
_STRING = re.compile(r"\s*'((?:[^']|'')*)'")
_FORMAT = re.compile(r"(\d*)([LXBIJKAEDCMPQ])")
_WIDTHS = {"L": 1, "B": 1, "I": 2, "J": 4, "K": 8, "A": 1, "E": 4, "D": 8, "C": 8, "M": 16, "P": 8, "Q": 16}
_COUNTED = re.compile(r"BITPIX|NAXIS\d*|PCOUNT|GCOUNT|TFIELDS")


@dataclasses.dataclass(frozen=True)
class Header:
    """The cards of a header by keyword, as they stand behind the equals sign; `label` names the extension."""

    cards: Mapping[str, str]
    label: str
    path: Path

    def fail(self, what: str, keyword: str = "") -> DataError:
        """Build the error of something wrong in this header."""
        return fail(what, file=self.path, extension=self.label, column=keyword, advice=BROKEN)

    def count(self, keyword: str, most: int, default: int | None = None) -> int:
        """The whole number of a keyword between 0 and `most`; `DataError` for anything else."""
        if keyword not in self.cards and default is not None:
            return default
        match = _INTEGER.match(self.cards.get(keyword, ""))
        if match is None or len(match[1]) > 20:
            raise self.fail(f"is {self.cards.get(keyword, 'missing').strip()[:30]}, no whole number", keyword)
        if not 0 <= int(match[1]) <= most:
            raise self.fail(f"is {int(match[1])}, not in 0 … {most}", keyword)
        return int(match[1])


def check_structure(stream: io.BufferedIOBase, path: Path) -> None:
    """Follow the headers of a FITS file from end to end without reading its data.

    Raises `DataError` for what is no FITS file, a header without end, counts that are negative or impossible, columns
    that do not fill a row of their table, a file shorter than its headers say, and bytes that no header announces.
    """
    size = stream.seek(0, os.SEEK_END)
    place = number = 0
    while place < size:
        if number == _MOST_HDUS:
            raise fail(f"has more than {_MOST_HDUS} extensions", file=path, advice=BROKEN)
        stream.seek(place)
        header, length = _read_header(stream, path, number)
        place += length + _data_length(header, size, primary=number == 0)
        if place > size:
            what = f"truncated: {size} bytes where {place} are announced"
            raise fail(what, file=path, extension=header.label, advice=BROKEN)
        number += 1
    if number == 0:
        raise fail("cannot be read as FITS: it is empty", file=path, advice=BROKEN)


def header_keywords(stream: io.BufferedIOBase, path: Path) -> tuple[str, ...]:
    """Keywords of the primary header; `DataError` if there is none."""
    return tuple(_read_header(stream, path, 0)[0].cards)


def _read_header(stream: io.BufferedIOBase, path: Path, number: int) -> tuple[Header, int]:
    """The header that begins where the stream stands, and its length in bytes."""
    cards: dict[str, str] = {}
    twice = ""
    label = "PRIMARY" if number == 0 else f"HDU {number}"
    for block in range(1, _MOST_BLOCKS + 1):
        content = stream.read(BLOCK)
        if block == 1:
            _check_beginning(content, path, number)
        if len(content) < BLOCK:
            raise fail("truncated: the header does not end", file=path, extension=label, advice=BROKEN)
        text = content.decode("latin-1")
        for start in range(0, BLOCK, _CARD):
            keyword, value = text[start : start + 8].rstrip(), text[start + 8 : start + _CARD]
            if keyword == "END" and not value.strip():
                name = _STRING.match(cards.get("EXTNAME", ""))
                shown = name[1].strip() if name and name[1].strip().isprintable() else ""
                header = Header(cards, shown or label, path)
                if twice:
                    raise header.fail("is there twice", twice)
                return header, block * BLOCK
            if not value.startswith("= "):
                continue
            if keyword in cards and _COUNTED.fullmatch(keyword):
                twice = twice or keyword
            cards.setdefault(keyword, value[2:])
    what = f"the header has more than {_MOST_BLOCKS * BLOCK // _CARD} cards"
    raise fail(what, file=path, extension=label, advice=BROKEN)


def _check_beginning(content: bytes, path: Path, number: int) -> None:
    if number == 0 and not content.startswith(b"SIMPLE  ="):
        raise fail("cannot be read as FITS: it does not begin with SIMPLE", file=path, advice=BROKEN)
    if number > 0 and not content.startswith(b"XTENSION="):
        what = "bytes after the last extension cannot be read: no XTENSION stands there"
        raise fail(what, file=path, advice=BROKEN)


def _data_length(header: Header, size: int, *, primary: bool) -> int:
    """Length of the data behind a header, in bytes, padded to whole blocks; `size` is that of the file."""
    bits = _INTEGER.match(header.cards.get("BITPIX", ""))
    if bits is None or bits[1].lstrip("+") not in ("8", "16", "32", "64", "-32", "-64"):
        what = f"is {header.cards.get('BITPIX', 'missing').strip()[:30]}, not 8, 16, 32, 64, -32 or -64"
        raise header.fail(what, "BITPIX")
    if primary and header.cards.get("GROUPS", "").split("/")[0].strip() == "T":
        raise header.fail("random groups are not read", "GROUPS")
    axes = header.count("NAXIS", _MOST)
    lengths = [header.count(f"NAXIS{n}", size) for n in range(1, axes + 1)]
    parameters, groups = header.count("PCOUNT", size, 0), header.count("GCOUNT", 1, 1)
    kind = _STRING.match(header.cards.get("XTENSION", ""))
    if kind is not None and kind[1].strip() == "BINTABLE":
        _check_columns(header, lengths)
    values = math.prod(lengths) if lengths else 0
    length = abs(int(bits[1])) // 8 * groups * (parameters + values)
    return -(-length // BLOCK) * BLOCK


def _check_columns(header: Header, lengths: list[int]) -> None:
    """The columns of a binary table must fill its rows."""
    if len(lengths) != 2:
        raise header.fail(f"is {len(lengths)}, a binary table has 2", "NAXIS")
    width = 0
    for n in range(1, header.count("TFIELDS", _MOST) + 1):
        string = _STRING.match(header.cards.get(f"TFORM{n}", ""))
        form = _FORMAT.match(string[1].strip()) if string else None
        if form is None or len(form[1]) > 18:
            raise header.fail("is no format of a column", f"TFORM{n}")
        repeat = int(form[1] or 1)
        width += -(-repeat // 8) if form[2] == "X" else repeat * _WIDTHS[form[2]]
    if width != lengths[0]:
        raise header.fail(f"is {lengths[0]}, the columns take {width} bytes in a row", "NAXIS1")
    if width == 0 and lengths[1] > 0:
        raise header.fail(f"announces {lengths[1]} rows without a column", "NAXIS2")

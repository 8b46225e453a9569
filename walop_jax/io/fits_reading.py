"""Opening a FITS file so that what comes out of it is what was written, or an error.

A file is read once from end to end: for its SHA-256, for the FITS checksums (Seaman, Pence & Rots 2012, an
appendix of the FITS standard: the 32-bit words of an HDU, summed in ones' complement, are all ones), and
for its length. astropy would check the sums too, but in small blocks, and would only warn. The sums find
every damaged byte, but not two changes that cancel each other; the SHA-256 is what tells two files apart.

Before astropy believes the header cards, what they announce (number of axes, rows, columns, groups) is held against the
length of the file: a count that is negative or beyond all bounds makes readers loop or ask for any amount of memory
(FITS standard 4.0, sections 4.4.1, sizes, and 7.3, binary tables).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import lzma
import math
import os
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.io.errors import DataError, fail
from walop_jax.io.text import check_input, unpacking

_CHUNK = 1 << 23  # a multiple of four, so that words never straddle two chunks
LARGEST_UNPACKED = 1 << 31
"""Bytes of the content of a packed file that are read at most: a small file may unpack to any size."""

UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
    fits.VerifyError,
)
"""Errors that astropy raises on a damaged file, some of it only when a header or a column is used."""


@dataclasses.dataclass(frozen=True)
class OpenFile:
    """A FITS file that has passed its checks: its HDUs, its hash, and what is worth remarking."""

    path: Path
    sha256: str
    hdus: list[Any]
    compressed: bool
    remarks: tuple[str, ...]


@contextlib.contextmanager
def open_fits(path: str | os.PathLike[str], advice: str | None = None) -> Iterator[OpenFile]:
    """Open a FITS file (plain, or packed with gzip, bzip2, xz or zip) after checking that it is whole.

    A file without checksums is remarked on: damage to it cannot be noticed. Raises `DataError` as `check_input` and
    `check_structure` do, and if a checksum that the file carries does not agree with its bytes; with `advice`, for
    what astropy cannot read while the block uses it.
    """
    path = check_input(path)
    with contextlib.ExitStack() as stack:
        try:
            raw = stack.enter_context(path.open("rb"))
            packed = unpacking(path)
            content = raw if packed is None else unpacked(stack.enter_context(packed[0]), path, fits=True)
            check_structure(io.BytesIO(content) if isinstance(content, bytes) else raw, path)
            caught = stack.enter_context(warnings.catch_warnings(record=True))
            warnings.simplefilter("always")
            # Opened here because astropy does not close a file that it fails to read.
            stream = (
                io.BytesIO(content) if isinstance(content, bytes) else stack.enter_context(path.open("rb"))
            )
            hdus = stack.enter_context(
                fits.open(stream, lazy_load_hdus=False, disable_image_compression=True)
            )
            units = list(hdus)
            raw.seek(0)
            sha256 = _verify(path, units, io.BytesIO(content) if isinstance(content, bytes) else raw)
        except DataError:
            raise
        except UNREADABLE as error:
            raise fail(f"cannot be read as FITS: {one_line(error)}", file=path, advice=BROKEN) from error
        if isinstance(content, bytes):
            raw.seek(0)
            sha256 = hashlib.file_digest(raw, "sha256").hexdigest()
        remarks = tuple(f"{path}: {one_line(entry.message)}" for entry in caught)
        # A packed file carries a checksum of all its bytes.
        unprotected = _unprotected(path, units) if packed is None else []
        try:
            yield OpenFile(path, sha256, units, packed is not None, (*remarks, *unprotected))
        except UNREADABLE as error:
            if advice is None or isinstance(error, DataError):
                raise
            raise fail(f"cannot be read: {one_line(error)}", file=path, advice=advice) from error


def primary_keywords(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Keywords of the primary header, unchecked, to see what a file is; none if it is no FITS file."""
    try:
        packed = unpacking(check_input(path))
        with Path(path).open("rb") if packed is None else packed[0] as content:
            return header_keywords(content, Path(path))
    except UNREADABLE:
        return ()


def _unprotected(path: Path, hdus: list[Any]) -> list[str]:
    """A remark on the extensions whose data no checksum protects."""
    names = [
        hdu.name or f"HDU {n}" for n, hdu in enumerate(hdus) if not {"CHECKSUM", "DATASUM"} & set(hdu.header)
    ]
    if not names:
        return []
    where = "" if len(names) == len(hdus) else f" [{', '.join(names)}]"
    advice = "write the file with checksums (astropy: writeto(…, checksum=True))"
    return [f"{path}{where}: no checksum, so that damage to the file cannot be noticed; {advice}"]


def one_line(message: object) -> str:
    """Put a message of another library on one line, shortened."""
    return " ".join(str(message).split())[:300] or type(message).__name__


def unpacked(stream: io.BufferedIOBase, path: Path, *, fits: bool = False) -> bytes:
    """Read the content of a packed file, `LARGEST_UNPACKED` at most; with `fits`, only if it begins as FITS does."""
    if fits:
        header_keywords(stream, path)  # of what is no FITS file nothing more is unpacked
        stream.seek(0)
    content = stream.read(LARGEST_UNPACKED + 1)
    if len(content) > LARGEST_UNPACKED:
        raise fail("unpacks to more than 2 GiB", file=path, advice="unpack it first")
    return content


def _verify(path: Path, hdus: list[Any], stream: io.BufferedIOBase) -> str:
    """Read the file once; check the checksums; return the SHA-256 of the bytes."""
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    digest = hashlib.sha256()
    for number, hdu in enumerate(hdus):
        info = hdu.fileinfo() if hasattr(hdu, "fileinfo") else None
        if info is None:  # astropy's stand-in for an extension whose header it cannot understand
            raise fail(f"the header of extension {number} is damaged", file=path, advice=BROKEN)
        name = hdu.name or f"HDU {number}"
        start, data, end = info["hdrLoc"], info["datLoc"], info["datLoc"] + info["datSpan"]
        header_sum = _sum(stream, data - start, digest)
        data_sum = _sum(stream, end - data, digest)
        declared = hdu.header.get("DATASUM")
        if declared is not None and str(declared).strip() != str(data_sum):
            raise fail("the data do not agree with DATASUM", file=path, extension=name, advice=BROKEN)
        if "CHECKSUM" in hdu.header and _fold(header_sum + data_sum) not in (0, 0xFFFFFFFF):
            advice = f"{BROKEN}, or renew the checksum if the header was edited on purpose"
            raise fail("the bytes do not agree with CHECKSUM", file=path, extension=name, advice=advice)
    if stream.tell() != size:
        raise fail(
            f"{size - stream.tell()} bytes after the last extension cannot be read", file=path, advice=BROKEN
        )
    return digest.hexdigest()


def _sum(stream: io.BufferedIOBase, length: int, digest: Any) -> int:
    """Add up big-endian 32-bit words in ones' complement (carries come back in at the bottom)."""
    total = 0
    while length > 0:
        chunk = stream.read(min(length, _CHUNK))
        if not chunk:
            raise EOFError("unexpected end of file")
        digest.update(chunk)
        # All chunks are whole blocks.
        total += int(np.frombuffer(chunk, ">u4").sum(dtype=np.uint64))
        length -= len(chunk)
    return _fold(total)


def _fold(total: int) -> int:
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


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

"""Opening a FITS file: its content as it was written, or an error.

A file is read once from end to end: for its SHA-256, for the FITS checksums (Seaman, Pence & Rots 2012, an
appendix of the FITS standard: the 32-bit words of an HDU, summed in ones' complement, are all ones), and
for its length. astropy would check the sums too, but in small blocks, and would only warn. The sums find
every damaged byte, but not two changes that cancel each other; the SHA-256 is what distinguishes two files.

Before astropy makes anything of the header cards, the sizes in them (number of axes, rows, columns, groups) are held
against the length of the file: a count that is negative or beyond all bounds makes readers loop or ask for any amount
of memory (FITS standard 4.0, sections 4.4.1, sizes, and 7.3, binary tables).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import lzma
import math
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.io.errors import DataError, PathLike, fail
from walop_jax.io.text import check_input, unpacking

_CHUNK = 1 << 23  # a multiple of four, so that words never straddle two chunks
LARGEST_UNPACKED = 1 << 31
"""Bytes of the content of a packed file that are read at most: a small file may unpack to any size."""

UNREADABLE = (
    OSError, EOFError, ValueError, TypeError, LookupError, AttributeError, OverflowError, struct.error, zlib.error,
    lzma.LZMAError, zipfile.BadZipFile, fits.VerifyError,
)  # fmt: skip
"""Errors that astropy raises on a damaged file, some of it only when a header or a column is used."""


@dataclasses.dataclass(frozen=True)
class OpenFile:
    """A FITS file that has passed its checks: its HDUs, its hash, and remarks."""

    path: Path
    sha256: str
    hdus: list[Any]
    compressed: bool
    remarks: tuple[str, ...]


@contextlib.contextmanager
def open_fits(path: PathLike, advice: str | None = None) -> Iterator[OpenFile]:
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
            content = None if packed is None else unpacked(stack.enter_context(packed[0]), path, fits=True)
            checked = raw if content is None else io.BytesIO(content)
            check_structure(checked, path)
            caught = stack.enter_context(warnings.catch_warnings(record=True))
            warnings.simplefilter("always")
            # Opened here because astropy does not close a file that it fails to read.
            stream = stack.enter_context(path.open("rb")) if content is None else io.BytesIO(content)
            opened = fits.open(stream, lazy_load_hdus=False, disable_image_compression=True)
            hdus = stack.enter_context(opened)
            units = list(hdus)
            for hdu in units:
                if isinstance(hdu, fits.BinTableHDU):
                    _check_columns(hdu, path)
            sha256 = _verify(path, units, checked)
        except DataError:
            raise
        except UNREADABLE as error:
            raise fail(f"cannot be read as FITS: {one_line(error)}", file=path, advice=BROKEN) from error
        if content is not None:
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


def primary_keywords(path: PathLike) -> tuple[str, ...]:
    """Keywords of the primary header, unchecked, which tell the kind of a file; none if it is no FITS file."""
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
        header_keywords(stream, path)  # a file of another format is not unpacked further
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
        if info is None:  # astropy puts None in the place of an extension whose header it cannot understand
            raise fail(f"the header of extension {number} is damaged", file=path, advice=BROKEN)
        name = hdu.name or f"HDU {number}"
        start, data, end = info["hdrLoc"], info["datLoc"], info["datLoc"] + info["datSpan"]
        header_sum = _sum(stream, data - start, digest)
        data_sum = _sum(stream, end - data, digest)
        declared = hdu.header.get("DATASUM")
        if declared is not None and str(declared).strip() != str(data_sum):
            advice = f"{BROKEN}, or with checksum=True if the data were edited on purpose"
            raise fail("the data do not agree with DATASUM", file=path, extension=name, advice=advice)
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
_LONGEST = 1000 * BLOCK  # of a header: 36 000 cards
_MOST = 999  # axes, and columns of a table
BROKEN = "the copy is damaged or incomplete; transfer or write the file again"


def check_structure(stream: io.BufferedIOBase, path: Path) -> None:
    """Follow the headers of a FITS file from end to end without reading its data.

    Raises `DataError` for other formats, counts that are negative or impossible, a file shorter than its headers
    say, and bytes that no header announces.
    """
    size = stream.seek(0, os.SEEK_END)
    place = number = 0
    while place < size or number == 0:
        stream.seek(place)
        header = _Header(stream.read(_LONGEST), path, number)
        place += header.length + header.data_length(size)
        if place > size:
            raise header.fail(f"truncated: {size} bytes where {place} are announced")
        number += 1


def header_keywords(stream: io.BufferedIOBase, path: Path) -> tuple[str, ...]:
    """Keywords of the primary header; `DataError` if there is none."""
    return tuple(_Header(stream.read(_LONGEST), path, 0).cards)


class _Header:
    """The header at the beginning of `content`, that of extension `number`; `DataError` where there is none."""

    def __init__(self, content: bytes, path: Path, number: int) -> None:
        self.path, self.number, self.label = path, number, f"HDU {number}" if number else "PRIMARY"
        first = b"XTENSION=" if number else b"SIMPLE  ="
        if not content.startswith(first):
            before = "bytes after the last extension cannot be read" if number else "cannot be read as FITS"
            raise fail(f"{before}: it does not begin with {first[:8].decode()}", file=path, advice=BROKEN)
        stream = io.BytesIO(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                warnings.filterwarnings("error", message="Unexpected bytes trailing END")
                self.cards = fits.Header.fromfile(stream)
                self.label = str(self.cards.get("EXTNAME") or self.label)
        except (*UNREADABLE, UserWarning) as error:
            missing = "END" in str(error)
            raise self.fail("truncated: the header does not end" if missing else one_line(error)) from error
        self.length = stream.tell()

    def fail(self, what: str, keyword: str = "") -> DataError:
        """Build the error of something wrong in this header."""
        return fail(what, file=self.path, extension=self.label, column=keyword, advice=BROKEN)

    def count(self, keyword: str, most: int, default: int | None = None, least: int = 0) -> int:
        """The whole number of a keyword between `least` and `most`; `DataError` for anything else."""
        if keyword in self.cards and self.cards.count(keyword) > 1:
            raise self.fail("is there twice", keyword)
        try:
            value = self.cards.get(keyword, default)
        except UNREADABLE as error:
            raise self.fail(one_line(error), keyword) from error
        if type(value) is not int:
            raise self.fail(
                f"is {'missing' if value is None else repr(value)[:30]}, no whole number", keyword
            )
        if not least <= value <= most:
            raise self.fail(f"is {value}, not in {least} … {most}", keyword)
        return value

    def data_length(self, size: int) -> int:
        """Length of the data behind the header, in bytes, padded to whole blocks; `size` is that of the file."""
        bits = self.count("BITPIX", 64, least=-64)
        if bits not in (8, 16, 32, 64, -32, -64):
            raise self.fail(f"is {bits!r}, not 8, 16, 32, 64, -32 or -64", "BITPIX")
        if not self.number and self.cards.get("GROUPS") is True:
            raise self.fail("random groups are not read", "GROUPS")
        lengths = [self.count(f"NAXIS{n}", size) for n in range(1, self.count("NAXIS", _MOST) + 1)]
        groups, parameters = self.count("GCOUNT", 1, 1), self.count("PCOUNT", size, 0)
        self.count("TFIELDS", _MOST, 0)
        values = math.prod(lengths) if lengths else 0
        return -(-abs(bits) // 8 * groups * (parameters + values) // BLOCK) * BLOCK


def _check_columns(hdu: Any, path: Path) -> None:
    """The columns of a binary table must be all there, and fill its rows."""
    head = hdu.header
    try:
        width, columns = hdu.columns.dtype.itemsize, len(hdu.columns)
    except UNREADABLE as error:
        what = f"the columns cannot be read: {one_line(error)}"
        raise fail(what, file=path, extension=hdu.name, advice=BROKEN) from error
    if (width, columns) != (head["NAXIS1"], head["TFIELDS"]) or (width == 0 and head["NAXIS2"] > 0):
        what = f"is {head['NAXIS1']}, the columns take {width} bytes in a row"
        raise fail(what, file=path, extension=hdu.name, column="NAXIS1", advice=BROKEN)

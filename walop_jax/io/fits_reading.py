"""Opening a FITS file so that what comes out of it is what was written, or an error.

A file is read once from end to end: for its SHA-256, for the FITS checksums (Seaman, Pence & Rots 2012, an
appendix of the FITS standard: the 32-bit words of an HDU, summed in ones' complement, are all ones), and
for its length. astropy would check the sums too, but in small blocks, and would only warn. The sums find
every damaged byte, but not two changes that cancel each other; the SHA-256 is what tells two files apart.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gzip
import hashlib
import io
import os
import struct
import warnings
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.io.errors import DataError, fail
from walop_jax.io.fits_structure import BLOCK, BROKEN, check_structure, header_keywords
from walop_jax.io.inputs import check_input

_CHUNK = 1 << 23  # a multiple of four, so that words never straddle two chunks
_LARGEST_GZIP = 1 << 31

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
    fits.VerifyError,
)
"""What astropy raises on a damaged file, some of it only when a header or a column is used."""


@dataclasses.dataclass(frozen=True)
class OpenFile:
    """A FITS file that has passed its checks: its HDUs, its hash, and what is worth remarking."""

    path: Path
    sha256: str
    hdus: list[Any]
    compressed: bool
    remarks: tuple[str, ...]


@contextlib.contextmanager
def open_fits(path: str | os.PathLike[str]) -> Iterator[OpenFile]:
    """Open a FITS file (plain, or compressed with gzip) after checking that it is whole.

    A file without checksums is remarked on: damage to it cannot be noticed. Raises `DataError` as `check_input` and
    `check_structure` do, and if a checksum that the file carries does not agree with its bytes.
    """
    path = check_input(path)
    with contextlib.ExitStack() as stack:
        try:
            raw = stack.enter_context(path.open("rb"))
            compressed = raw.read(2) == b"\x1f\x8b"
            content = _decompressed(path) if compressed else raw
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
        # A file packed with gzip carries a CRC-32 of all its bytes.
        unprotected = [] if compressed else _unprotected(path, units)
        yield OpenFile(path, sha256, units, compressed, (*remarks, *unprotected))


def primary_keywords(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Keywords of the primary header, unchecked, to see what a file is; none if it is no FITS file."""
    try:
        with check_input(path).open("rb") as raw:
            if raw.read(2) == b"\x1f\x8b":
                with gzip.open(path) as content:
                    return header_keywords(content, Path(path))
            raw.seek(0)
            return header_keywords(raw, Path(path))
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


def _decompressed(path: Path) -> bytes:
    """Unpack a gzip file into memory, with a limit: a small file may unpack to any size."""
    with gzip.open(path) as stream:
        header_keywords(stream, path)  # of what is no FITS file nothing more is unpacked
        stream.seek(0)
        content = stream.read(_LARGEST_GZIP + 1)
    if len(content) > _LARGEST_GZIP:
        raise fail("unpacks to more than 2 GiB", file=path, advice="unpack it with gunzip")
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
    if length <= _CHUNK:
        chunk = _chunk(stream, length)
        digest.update(chunk)
        return _fold(_words(chunk))
    total = 0
    # Much is hashed in another thread while it is added up here.
    with ThreadPoolExecutor(1) as other:
        hashed = other.submit(digest.update, b"")
        while length > 0:
            chunk = _chunk(stream, min(length, _CHUNK))
            hashed.result()
            hashed = other.submit(digest.update, chunk)
            total += _words(chunk)
            length -= len(chunk)
        hashed.result()
    return _fold(total)


def _chunk(stream: io.BufferedIOBase, length: int) -> bytes:
    chunk = stream.read(length)
    if len(chunk) < length:
        raise EOFError("unexpected end of file")
    return chunk


def _words(chunk: bytes) -> int:
    """The sum of a chunk's big-endian 32-bit words, the last one filled up with zeros."""
    return int(np.frombuffer(chunk.ljust(-(-len(chunk) // 4) * 4, b"\0"), ">u4").sum(dtype=np.uint64))


def _fold(total: int) -> int:
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def data_sum(path: Path, offset: int, length: int) -> int:
    """Return the FITS data sum of a stretch of a file, for a writer of data larger than memory."""
    with path.open("rb") as stream:
        stream.seek(offset)
        return _sum(stream, length, hashlib.sha256())


def checksum_text(header: bytes, data: int) -> str:
    """Return the CHECKSUM that completes a header in which it is `'0' * 16`, given the sum of the data.

    FITS standard 4.0, appendix J.1: each byte of the complement is split over four letters, kept clear of
    punctuation, and the string is turned by one because it starts at the twelfth byte of its card.
    """
    value = 0xFFFFFFFF ^ _fold(_sum(io.BytesIO(header), len(header), hashlib.sha256()) + data)
    letters = [0] * 16
    for place, byte in enumerate(value.to_bytes(4, "big")):
        four = [byte // 4 + 48 + (byte % 4 if n == 0 else 0) for n in range(4)]
        while any(_punctuation(letter) for letter in four):
            for n in (0, 2):
                if _punctuation(four[n]) or _punctuation(four[n + 1]):
                    four[n], four[n + 1] = four[n] + 1, four[n + 1] - 1
        letters[place::4] = four
    return bytes(letters[-1:] + letters[:-1]).decode("ascii")


def _punctuation(letter: int) -> bool:
    return 0x3A <= letter <= 0x40 or 0x5B <= letter <= 0x60


def padded(length: int) -> int:
    """Round a number of bytes up to whole FITS blocks."""
    return -(-length // BLOCK) * BLOCK

"""Headers made to hang or exhaust a reader, and things that are no files: refused at once, with the card named."""

from __future__ import annotations

import gzip
import os
import signal
import socket

import pytest

from walop_jax.commands.inputs import read
from walop_jax.data.calset import read_calibration_set
from walop_jax.io.errors import DataError
from walop_jax.io.text import read_text

HUGE = 2**63
# card, what stands there in the file, what is written over it, what the message must say
CARDS = {
    "negative rows": ("NAXIS2", -64, "[EXPOSURES] NAXIS2: is -64, not in 0"),
    "huge rows": ("NAXIS2", HUGE, f"NAXIS2: is {HUGE}, not in 0"),
    "a digit of rows": ("NAXIS2", 800, "[EXPOSURES]: truncated"),
    "negative width": ("NAXIS1", -8, "[EXPOSURES] NAXIS1: is -8"),
    "another width": ("NAXIS1", 1, "[EXPOSURES] NAXIS1: is 1, the columns take"),
    "negative groups": ("GCOUNT", -1, "[EXPOSURES] GCOUNT: is -1, not in 0 … 1"),
    "many groups": ("GCOUNT", 1000, "[EXPOSURES] GCOUNT: is 1000, not in 0 … 1"),
    "negative heap": ("PCOUNT", -2880, "[EXPOSURES] PCOUNT: is -2880"),
    "huge heap": ("PCOUNT", HUGE, f"[EXPOSURES] PCOUNT: is {HUGE}"),
    "huge fields": ("TFIELDS", HUGE, f"[EXPOSURES] TFIELDS: is {HUGE}, not in 0 … 999"),
    "negative fields": ("TFIELDS", -1, "[EXPOSURES] TFIELDS: is -1"),
    "a field too many": ("TFIELDS", 1000, "[EXPOSURES] TFIELDS: is 1000, not in 0 … 999;"),
    "an axis too many": ("NAXIS", 1000, "[EXPOSURES] NAXIS: is 1000, not in 0 … 999;"),
    "more fields": ("TFIELDS", 16, "[EXPOSURES]: the columns cannot be read"),
    "many axes": ("NAXIS", HUGE, f"[EXPOSURES] NAXIS: is {HUGE}, not in 0 … 999"),
    "three axes": ("NAXIS", 3, "[EXPOSURES] NAXIS3: is missing"),
    "text for rows": ("NAXIS2", "'eight'", "[EXPOSURES] NAXIS2: is 'eight', no whole number"),
    "odd bits": ("BITPIX", 7, "[EXPOSURES] BITPIX: is 7"),
    "wide column": ("TFORM1", "'99999999999999999J'", "[EXPOSURES]: the columns cannot be read"),
    "nonsense format": ("TFORM1", "'no'", "[EXPOSURES]: the columns cannot be read: Format 'no'"),
}


@pytest.fixture(autouse=True)
def _at_once():
    """What waits or loops fails after 20 s instead of hanging the suite."""
    signal.alarm(20)
    yield
    signal.alarm(0)


def overwrite(content: bytes, keyword: str, value: object, hdu: int = 1) -> bytes:
    """The file with a card of one extension written over, everything else left as it is."""
    start = -1
    for _ in range(hdu):
        start = content.index(b"XTENSION", start + 1)
    place = content.index(keyword.ljust(8).encode() + b"= ", start)
    card = f"{keyword:8}= {value!s:>20}".ljust(80).encode("latin-1")
    return content[:place] + card + content[place + 80 :]


@pytest.mark.parametrize("reader", [read_calibration_set, read])
@pytest.mark.parametrize("name", CARDS)
def test_impossible_counts_are_refused_by_name(handmade, name, reader):
    keyword, value, fragment = CARDS[name]
    path = handmade.write(checksum=False)
    path.write_bytes(overwrite(path.read_bytes(), keyword, value))
    with pytest.raises(DataError) as caught:
        reader(path)
    assert fragment in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("keyword", ["NAXIS", "GCOUNT"])
def test_primary_header_is_looked_at_too(handmade, keyword):
    path = handmade.write(checksum=False)
    content = path.read_bytes()
    extend = content.index(b"EXTEND  =")
    groups = f"{'GROUPS':8}= {'T':>20}".ljust(80) + f"{'GCOUNT':8}= {-1:>20}".ljust(80)
    if keyword == "GCOUNT":  # random groups, the oldest way to hold nothing and announce much
        content = content[:extend] + groups.encode() + content[extend + 160 :]
    else:
        place = content.index(b"NAXIS   =")
        content = content[:place] + f"{'NAXIS':8}= {-1:>20}".ljust(80).encode() + content[place + 80 :]
    path.write_bytes(content)
    with pytest.raises(DataError, match="GROUPS" if keyword == "GCOUNT" else "NAXIS: is -1"):
        read_calibration_set(path)


def test_header_without_end_is_not_followed_for_ever(tmp_path):
    path = tmp_path / "endless.fits"
    head = b"SIMPLE  =                    T".ljust(80) + b"COMMENT".ljust(80) * 35
    path.write_bytes(head + (b"COMMENT".ljust(80) * 36) * 1100)
    with pytest.raises(DataError, match="the header does not end"):
        read_calibration_set(path)
    path.write_bytes(head)
    with pytest.raises(DataError, match="the header does not end"):
        read_calibration_set(path)


def test_card_given_twice(handmade):
    path = handmade.write(checksum=False)
    content = path.read_bytes()
    place = content.index(b"TUNIT")
    path.write_bytes(content[:place] + b"TFIELDS =                   15".ljust(80) + content[place + 80 :])
    with pytest.raises(DataError, match=r"\[EXPOSURES\] TFIELDS: is there twice"):
        read_calibration_set(path)


@pytest.mark.parametrize("reader", [read_calibration_set, read, read_text])
@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder", "nothing"])
def test_what_is_no_file_is_not_opened(tmp_path, kind, reader):
    path = tmp_path / "set.fits"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as opened:
            opened.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    words = {"pipe": "a named pipe", "folder": "folder|holds no results", "nothing": "no such file"}
    with pytest.raises(DataError, match=words.get(kind, f"is a {kind}")) as caught:
        reader(path)
    assert str(path) in str(caught.value)


def test_gzip_of_anything_is_not_unpacked(tmp_path):
    """A gigabyte of zeros packs into a megabyte: the first block says that it is no FITS file."""
    path = tmp_path / "bomb.fits.gz"
    path.write_bytes(gzip.compress(b"\0" * (1 << 22)) * 64)
    with pytest.raises(DataError, match="cannot be read as FITS"):
        read_calibration_set(path)


def test_missing_checksums_are_remarked_on(handmade):
    assert not any("checksum" in remark for remark in read_calibration_set(handmade.write()).remarks)
    (remark,) = [r for r in read_calibration_set(handmade.write(checksum=False)).remarks if "checksum" in r]
    assert "damage to the file cannot be noticed" in remark


def test_messages_stay_on_one_line_whatever_a_header_holds(handmade):
    path = handmade.write(checksum=False)
    path.write_bytes(overwrite(path.read_bytes(), "NAXIS2", "\x1b[2J\n\x85 8"))
    with pytest.raises(DataError, match="NAXIS2: Unparsable card") as caught:
        read_calibration_set(path)
    assert str(caught.value).isprintable()

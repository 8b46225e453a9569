"""Text exports "Polarization Transmission" of an optical design program, read line by line.

A file holds one configuration of the design in one state of polarisation, some field points, and for each of them
the transmission at every wavelength and a weighted total; a part on chief rays follows. Read are title,
`Configuration n of m`, state, positions, transmissions at all wavelengths. The total only serves as a check: a
weighted mean lies among its terms. That chief rays do not trace or are vignetted is what sound exports say of every
field point, for the pupil is split where the chief ray goes: it is no sign of anything. Names of files mean nothing.

Layout as in github.com/HeisenbergK/NewWALOPCalibrate2Dens (README).
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
from jaxtyping import Float

from walop_jax.io.errors import DataError, fail
from walop_jax.io.text import check_input

HEADING = "Polarization Transmission Data"
"""First line of every export."""

_SLACK = Decimal("1e-8")  # of a total that was rounded
_AGAIN = "export the file again"
_NUMBER = re.compile(r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?")
_CONFIGURATION = re.compile(r"Configuration\s+(\d+)\s+of\s+\d+")
_FOLDER = re.compile(r"config\w*?[ _-]*(\d+)", re.IGNORECASE)
# A comma between the coordinates has a blank behind it, a decimal comma has none.
_POSITION = re.compile(r"Field Pos\s*:\s*(\S+?)[,;]\s+(\S+)\s*\((.*)\)")
_VALUE = re.compile(r"Transmission at\s+(\S+?)\s*:\s*(.*)")
_TOTAL = re.compile(r"Total Transmission\s*:\s*(.*)")


@dataclasses.dataclass(frozen=True)
class TransmissionExport:
    """One export: a configuration of the design in one state of polarisation.

    `angle` of the electric vector in degrees from +X toward +Y, −inf for unpolarised light; `x`, `y` in degrees,
    `wavelength` in µm, `transmission` a fraction, `step` the last decimal place that is printed of it.
    """

    path: Path
    title: str
    configuration: int
    angle: float
    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    wavelength: Float[np.ndarray, " w"]
    transmission: Float[np.ndarray, "p w"]
    step: Float[np.ndarray, "p w"]


@dataclasses.dataclass
class _Block:
    """What stands under one `Field Pos`."""

    line: int
    position: tuple[float, float]
    values: dict[float, Decimal] = dataclasses.field(default_factory=dict)
    total: Decimal | None = None


def read_export(path: str | os.PathLike[str]) -> TransmissionExport | None:
    """Read one text export; None for a text that does not begin like one.

    UTF-8, UTF-16 with its mark and the one-byte encodings of Windows are read, with any line ends and with a
    decimal point or comma.

    Raises `DataError`, with the line, for an export that is cut off, inconsistent, or not about linear
    polarisation at field angles in degrees.
    """
    path = Path(path)
    lines = _lines(path)
    first = next((n for n, line in enumerate(lines) if line), 0)
    if lines[first] != HEADING:
        return None
    start = next((n for n, line in enumerate(lines) if line.startswith("Field Pos")), len(lines))
    title, configuration, angle = _header(lines[first:start], first, path)
    blocks = _blocks(lines, start, path)
    wavelength = np.array(list(blocks[0].values))
    for block in blocks:
        if list(block.values) != list(blocks[0].values):
            raise _fault(path, block.line, "has other wavelengths than the first field point", _AGAIN)
    xy = np.array([block.position for block in blocks])
    printed = [list(block.values.values()) for block in blocks]
    step = np.array([[10.0 ** int(value.as_tuple().exponent) for value in row] for row in printed])
    transmission = np.array(printed, dtype=np.float64)
    x, y = xy.T
    return TransmissionExport(path, title, configuration, angle, x, y, wavelength, transmission, step)


def _lines(path: Path) -> list[str]:
    try:
        content = check_input(path).read_bytes()
        marked = content.startswith((b"\xff\xfe", b"\xfe\xff"))
        # All that is read is ASCII, so any one-byte encoding (and UTF-8) may pass for Latin-1.
        text = content.decode("utf-16") if marked else content.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    except OSError as error:
        raise fail(
            f"cannot be read: {error.strerror or error}", file=path, advice="look at its rights"
        ) from error
    except UnicodeDecodeError as error:
        raise fail("is cut off within a letter", file=path, advice=_AGAIN) from error
    if "\0" in text:
        raise fail("is not a text, or UTF-16 without its mark", file=path, advice="save it as UTF-8")
    if not text.strip():
        raise fail("is empty", file=path, advice=f"{_AGAIN}, or remove it")
    return [line.strip() for line in text.splitlines()]


def _header(lines: list[str], offset: int, path: Path) -> tuple[str, int, float]:
    """Title, configuration and angle of the electric vector (degrees, −inf: unpolarised)."""
    cards = {key.strip(): (n, text.strip()) for n, line in enumerate(lines, offset + 1)
             for key, colon, text in [line.partition(":")] if colon}  # fmt: skip
    found = [int(match[1]) for line in lines if (match := _CONFIGURATION.fullmatch(line))]
    if len(found) != 1:
        raise _fault(path, offset + 1, "does not say which configuration it is of", _AGAIN)
    folder = _FOLDER.fullmatch(path.parent.name)
    if folder and int(folder[1]) != found[0]:
        raise fail(
            f"says configuration {found[0]} in a folder {path.parent.name!r}", file=path, advice="move it"
        )
    title = cards.get("Title", (0, ""))[1]
    if "Field is unpolarized." in lines:
        return title, found[0], -math.inf
    state = []
    for name in ("X-Field", "Y-Field", "X-Phase", "Y-Phase"):
        if name not in cards:
            raise _fault(path, offset + 1, f"says neither {name} nor that the field is unpolarised", _AGAIN)
        # Adding 0 turns −0 into 0, and so the angle −180° into 180°.
        state.append(float(_number(cards[name][1], name, path, cards[name][0])) + 0.0)
    x, y, x_phase, y_phase = state
    if x_phase != y_phase or x == y == 0:
        what = "has no electric field" if x == y == 0 else "is elliptical light (X-Phase and Y-Phase differ)"
        raise _fault(path, cards["X-Field"][0], what, "export linear states, signs in X-Field and Y-Field")
    return title, found[0], math.degrees(math.atan2(y, x))


def _blocks(lines: list[str], start: int, path: Path) -> list[_Block]:
    """The field points of an export, from line `start` (counted from 0) on."""
    blocks: list[_Block] = []
    for n, line in enumerate(lines[start:], start + 1):
        if line.startswith("Chief Ray Transmission"):
            break
        if line.startswith("Field Pos"):
            if blocks:
                _check(blocks[-1], path)
            blocks.append(_Block(n, _position(line, path, n)))
            if any(block.position == blocks[-1].position for block in blocks[:-1]):
                raise _fault(path, n, "the field point is there twice", "give each field point once")
        elif match := _VALUE.fullmatch(line):
            wavelength = round(float(_number(match[1], "the wavelength", path, n)), 4)
            value = _number(match[2], "the transmission", path, n)
            if wavelength in blocks[-1].values:
                raise _fault(path, n, f"{wavelength} µm is there twice", _AGAIN)
            if not 0 <= value <= 1:
                raise _fault(path, n, f"the transmission {match[2]} is not in 0 … 1", "fractions are wanted")
            blocks[-1].values[wavelength] = value
        elif match := _TOTAL.fullmatch(line):
            blocks[-1].total = _number(match[1], "the total", path, n)
        elif line:
            raise _fault(
                path, n, f"{line!r} says something unknown", f"{_AGAIN}, or without this field point"
            )
    else:
        raise _fault(path, len(lines), "ends ahead of its part on chief rays: it is cut off", _AGAIN)
    _check(blocks[-1], path)
    return blocks


def _position(line: str, path: Path, n: int) -> tuple[float, float]:
    match = _POSITION.fullmatch(line)
    if not match or match[3] != "deg":
        raise _fault(path, n, f"{line!r} is not a pair of angles", "export field angles in degrees, X and Y")
    x, y = (float(_number(match[k], "the position", path, n)) + 0.0 for k in (1, 2))
    return x, y


def _check(block: _Block, path: Path) -> None:
    """Refuse a field point that is cut off, or whose total does not lie among its transmissions."""
    values = block.values.values()
    if not values or block.total is None:
        raise _fault(path, block.line, "the field point is cut off", _AGAIN)
    if not min(values) - _SLACK <= block.total <= max(values) + _SLACK:
        raise _fault(path, block.line, f"a total of {block.total} is no mean of its transmissions", _AGAIN)


def _number(text: str, what: str, path: Path, line: int) -> Decimal:
    if not _NUMBER.fullmatch(text):
        raise _fault(
            path, line, f"{what} is {text!r}, not a number", f"{_AGAIN}, or without this field point"
        )
    return Decimal(text.replace(",", "."))


def _fault(path: Path, line: int, what: str, advice: str) -> DataError:
    return fail(what, file=f"{path}, line {line}", advice=advice)

"""Make a calibration set (KIND `flux`) of text exports "Polarization Transmission" of an optical design program.

    python zemax.py FOLDER -o SET.fits

reads all text exports (*.txt) in a folder and below it, each once. Every wavelength becomes a monochromatic filter,
every state of polarisation an exposure; N is 10⁶ times the transmission and N_ERR a share of it. Rows that lack a
camera are left out, and so are rows with a transmission of exactly 0, with a warning in both cases.

A file holds one configuration of the design in one state of polarisation, some field points, and for each of them
the transmission at every wavelength and a weighted total; a part on chief rays follows. Read are title,
`Configuration n of m`, state, positions, transmissions at all wavelengths. The total only serves as a check: a
weighted mean lies among its terms. That chief rays do not trace or are vignetted is what sound exports say of every
field point, for the pupil is split where the chief ray goes: it is no sign of anything. Names of files mean nothing.

Layout as in github.com/HeisenbergK/NewWALOPCalibrate2Dens (README).

State       `X-Field` and `Y-Field` of an export are the amplitudes of the electric vector along X and Y, hence
            CLP_ANGLE = atan2(Y, X), good to four decimals of the amplitudes: 11.25° is 11.25038°. `Field is
            unpolarized.` means polariser out. Transmissions are those of light of unit intensity in either case;
            N = 10⁶ × transmission. MJD has no meaning, it distinguishes exposures.
Cameras     O1, E1, O2, E2 are the configurations 1, 3, 2, 4 of the WALOP-North design. Its data say that 1 and 3
            are the beams of one prism (extinct at 90° and 0°), 2 and 4 those of the other. That O2 is 2 and not 4
            is the choice of the set named below: with it m33 is negative over nine tenths of the field, while a
            plate at +22.5° makes it positive. Another design may number its beams otherwise: `configurations`.
Field       X and Y are those of the program, degrees, signs as they stand.
Vignetting  A transmission of exactly 0 is a ray bundle that does not arrive: the row is left out.
Source      Cameras, order of rows and conventions were found by holding exports of WALOP-North against a calibration
            set that was made of them elsewhere; N agrees to the single precision of that set (test_zemax.py).
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import re
import sys
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
from jaxtyping import Float

import walop_jax as walop
from walop_jax import CalibrationSet, DataError, FilterCurve

HEADING = "Polarization Transmission Data"
"""First line of every export."""

_SLACK = Decimal("1e-8")  # of a total that was rounded
_AGAIN = "export the file again"
_WITHOUT = f"{_AGAIN}, or without this field point"
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
    """Content under one `Field Pos`."""

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
        content = path.read_bytes()
        marked = content.startswith((b"\xff\xfe", b"\xfe\xff"))
        # All that is read is ASCII, so any one-byte encoding (and UTF-8) may pass for Latin-1.
        text = content.decode("utf-16") if marked else content.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    except OSError as error:
        what = f"cannot be read: {error.strerror or error}"
        raise _refused(path, what, "look at its name and its rights") from error
    except UnicodeDecodeError as error:
        raise _refused(path, "is cut off within a letter", _AGAIN) from error
    if "\0" in text:
        raise _refused(path, "is not a text, or UTF-16 without its mark", "save it as UTF-8")
    if not text.strip():
        raise _refused(path, "is empty", f"{_AGAIN}, or remove it")
    return [line.strip() for line in text.splitlines()]


def _header(lines: list[str], offset: int, path: Path) -> tuple[str, int, float]:
    """Title, configuration and angle of the electric vector (degrees, −inf: unpolarised)."""
    cards = {key.strip(): (n, text.strip()) for n, line in enumerate(lines, offset + 1)
             for key, colon, text in [line.partition(":")] if colon}  # fmt: skip
    configurations = [int(match[1]) for line in lines if (match := _CONFIGURATION.fullmatch(line))]
    if len(configurations) != 1:
        raise _fault(path, offset + 1, "does not name its configuration", _AGAIN)
    folder = _FOLDER.fullmatch(path.parent.name)
    if folder and int(folder[1]) != configurations[0]:
        what = f"says configuration {configurations[0]} in a folder {path.parent.name!r}"
        raise _refused(path, what, "move it")
    title = cards.get("Title", (0, ""))[1]
    if "Field is unpolarized." in lines:
        return title, configurations[0], -math.inf
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
    return title, configurations[0], math.degrees(math.atan2(y, x))


def _blocks(lines: list[str], start: int, path: Path) -> list[_Block]:
    """The field points of an export, from line `start` (counted from 0) on."""
    blocks: list[_Block] = []
    for n, line in enumerate(lines[start:], start + 1):
        if line.startswith("Chief Ray Transmission"):
            break
        if line.startswith("Field Pos"):
            if blocks:
                _check(blocks[-1], path)
            match = _POSITION.fullmatch(line)
            if not match or match[3] != "deg":
                advice = "export field angles in degrees, X and Y"
                raise _fault(path, n, f"{line!r} is not a pair of angles", advice)
            x, y = (float(_number(match[k], "the position", path, n)) + 0.0 for k in (1, 2))
            blocks.append(_Block(n, (x, y)))
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
            raise _fault(path, n, f"{line!r} says something unknown", _WITHOUT)
    else:
        raise _fault(path, len(lines), "ends ahead of its part on chief rays: it is cut off", _AGAIN)
    _check(blocks[-1], path)
    return blocks


def _check(block: _Block, path: Path) -> None:
    """Refuse a field point that is cut off, or whose total does not lie among its transmissions."""
    values = block.values.values()
    if not values or block.total is None:
        raise _fault(path, block.line, "the field point is cut off", _AGAIN)
    if not min(values) - _SLACK <= block.total <= max(values) + _SLACK:
        raise _fault(path, block.line, f"a total of {block.total} is no mean of its transmissions", _AGAIN)


def _number(text: str, what: str, path: Path, line: int) -> Decimal:
    if not _NUMBER.fullmatch(text):
        raise _fault(path, line, f"{what} is {text!r}, not a number", _WITHOUT)
    return Decimal(text.replace(",", "."))


def _refused(place: object, what: str, advice: str) -> DataError:
    """An error that says where, what, and what to do."""
    return DataError(f"{place}: {what}; {advice}")


def _fault(path: Path, line: int, what: str, advice: str) -> DataError:
    return _refused(f"{path}, line {line}", what, advice)


# ------------------------------------------------------------------------------------------ made into a calibration set

INSTRUMENT = "WALOP-NORTH"

CAMERA_CONFIGURATIONS = (1, 3, 2, 4)
"""Configurations of the design that are the cameras O1, E1, O2, E2."""

RELATIVE_ERROR = 1e-3
"""Error that a transmission is given, as a share of it: how far the model of a design may be trusted."""

_UNIT = 1e6  # electrons for light of unit intensity
_CAMERA_NAMES = ("O1", "E1", "O2", "E2")


def import_transmissions(
    folder: str | os.PathLike[str],
    *,
    instrument: str = INSTRUMENT,
    configurations: Sequence[int] = CAMERA_CONFIGURATIONS,
    error: float = RELATIVE_ERROR,
) -> tuple[CalibrationSet, list[str]]:
    """Make a calibration set (KIND `flux`) of all text exports in a folder and its subfolders, with remarks.

    An exposure is a wavelength (a filter MONO-<Ångström>) and a state, unpolarised light first; rows that lack a
    camera are left out, exposures and points without any row too. MJD has no meaning, but distinguishes exposures.
    N_ERR is the share `error` of N, at least the rounding of the printed values. The remarks name what was left out.

    `configurations` are those of the four cameras O1, E1, O2, E2. Each file is read once.

    Raises `DataError` as `read_export` does, for data that are there twice, and if nothing can be made of them.
    """
    folder = Path(folder)
    if len(set(configurations)) != 4 or len(configurations) != 4:
        raise ValueError(
            f"{configurations} are not four different configurations, as in {CAMERA_CONFIGURATIONS}"
        )
    if not 0.0 <= error < 1.0:
        raise ValueError(f"{error} is not a share of a transmission, as in {RELATIVE_ERROR}")
    instrument = walop.Instrument.read(
        instrument
    ).name  # refuses one that does not exist, with the nearest names
    exports, remarks = _exports(folder)
    titles = sorted({export.title for export in exports})
    if not any(instrument.upper() in title.upper() for title in titles):
        remarks.append(f"{folder}: {instrument} is not among the titles of the exports ({', '.join(titles)})")
    angles = np.array(sorted({export.angle for export in exports}))
    wavelengths = np.array(sorted({float(w) for export in exports for w in export.wavelength}))
    yx = np.array(sorted({place for e in exports for place in zip(e.y.tolist(), e.x.tolist(), strict=True)}))
    values, step = _dense(exports, angles, wavelengths, yx, tuple(configurations))

    measured = np.isfinite(values)
    row = measured.all(axis=-1)
    missing = ", ".join(
        f"{np.sum(~measured[..., k])} of {_CAMERA_NAMES[k]} (configuration {configurations[k]})"
        for k in range(4)
    )
    if not np.any(row):
        advice = "export the same fields and states in all four"
        raise _refused(folder, f"no row has all four cameras, missing are {missing}", advice)
    if not np.all(row):
        what = f"{np.sum(~row)} of {row.size} rows (wavelength, state, field point) are left out because"
        remarks.append(f"{folder}: {what} a camera is missing: {missing}")
    dark = row & np.any(values == 0, axis=-1)
    if np.any(dark):
        what = f"{np.sum(dark)} of {np.sum(row)} rows are left out because a transmission is 0 (vignetted)"
        remarks.append(f"{folder}: {what}")
    row &= ~dark
    # Exposures and points without a row are left out too, what remains is numbered anew.
    values[~row] = np.nan
    exposed, places = row.any(axis=-1), row.reshape(-1, len(yx)).any(axis=0)
    counts, printed = (_UNIT * values_of[exposed][:, places].swapaxes(0, 1) for values_of in (values, step))
    curves = [FilterCurve(f"MONO-{1e4 * w:.0f}", np.array([w]), np.ones(1)) for w in wavelengths]
    colour, state = np.nonzero(exposed)
    y, x = yx[places].T
    try:
        calset = walop.from_arrays(
            counts,
            # A number that was rounded to a step is off by step / √12.
            np.maximum(error * counts, printed / math.sqrt(12.0)),
            x,
            y,
            np.where(np.isfinite(angles), angles, np.nan)[state],
            "flux",
            instrument=instrument,
            filters={curve.name: curve for curve in curves},
            origin="optical design program, polarization transmission",
            filter=[curves[number].name for number in colour],
            mjd=60000.0 + 1e-3 * np.arange(len(state)),
            exptime=1.0,
            temp=20.0,
            ha=0.0,
        )
    except DataError as fault:
        raise DataError(f"{folder}: {fault}") from fault
    return calset, [*remarks, *calset.remarks]


def _exports(folder: Path) -> tuple[list[TransmissionExport], list[str]]:
    if not folder.is_dir():
        raise _refused(folder, "is not a folder", "give the folder that holds the exports")
    texts = (f for f in folder.rglob("*") if f.suffix.lower() == ".txt" and f.name[0] != "." and f.is_file())
    files = sorted(texts)
    read = [read_export(file) for file in files]
    exports = [export for export in read if export is not None]
    if not exports:
        what = f"none of {len(files)} text files begins with {HEADING!r}"
        raise _refused(folder, what, "export that analysis as text, in English")
    ignored = [file.name for file, export in zip(files, read, strict=True) if export is None]
    what = f"{folder}: {len(ignored)} text files are no exports and not read"
    return exports, [f"{what}, {ignored[0]} for one"] if ignored else []


def _dense(
    exports: list[TransmissionExport],
    angles: Float[np.ndarray, " s"],
    wavelengths: Float[np.ndarray, " w"],
    yx: Float[np.ndarray, "p 2"],
    configurations: tuple[int, ...],
) -> tuple[Float[np.ndarray, "w s p 4"], Float[np.ndarray, "w s p 4"]]:
    """Transmissions of all exports and their printed steps, NaN where there are none; duplicates are refused."""
    values, step = np.full((2, len(wavelengths), len(angles), len(yx), 4), np.nan)
    owner = np.full(values.shape, -1)
    place = {(y, x): n for n, (y, x) in enumerate(yx.tolist())}
    for n, e in enumerate(exports):
        if e.configuration not in configurations:
            advice = f"the cameras are {list(configurations)}: remove the file, or name others (--cameras)"
            raise _refused(e.path, f"configuration {e.configuration} is no camera", advice)
        points = [place[key] for key in zip(e.y.tolist(), e.x.tolist(), strict=True)]
        rows = np.searchsorted(wavelengths, e.wavelength), np.searchsorted(angles, [e.angle])
        camera = np.array([configurations.index(e.configuration)])
        at = np.ix_(*rows, np.array(points), camera)
        if np.any(owner[at] >= 0):
            other = exports[int(owner[at].max())].path
            what = f"holds what stands in {other} too (configuration, state, field point, wavelength)"
            raise _refused(e.path, what, "remove one of them")
        values[at], step[at] = (transposed.T[:, None, :, None] for transposed in (e.transmission, e.step))
        owner[at] = n
    return values, step


def main(words: Sequence[str] | None = None) -> int:
    """The command line: 0, or 1 with a message for exports that cannot be used."""
    parser = argparse.ArgumentParser(
        description="Make a calibration set of exports of an optical design program."
    )
    parser.add_argument("folder", metavar="FOLDER", help='folder of "Polarization Transmission" text exports')
    parser.add_argument(
        "-o", "--output", metavar="SET.fits", required=True, help="calibration set to write (FITS)"
    )
    parser.add_argument("--instrument", default=INSTRUMENT, help="which instrument (default: %(default)s)")
    cameras = ",".join(map(str, CAMERA_CONFIGURATIONS))
    help_of_cameras = "configurations of the design that are the cameras (default: %(default)s)"
    parser.add_argument("--cameras", default=cameras, metavar="O1,E1,O2,E2", help=help_of_cameras)
    parser.add_argument(
        "--error", type=float, default=RELATIVE_ERROR, help="error of a transmission, as a share of it"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a set that exists")
    given = parser.parse_args(words)
    try:
        configurations = [int(number) for number in given.cameras.split(",")]
        calset, remarks = import_transmissions(
            given.folder, instrument=given.instrument, configurations=configurations, error=given.error
        )
        walop.write_calibration_set(given.output, calset, overwrite=given.overwrite)
    except ValueError as fault:
        print(f"zemax.py: error: {fault}", file=sys.stderr)
        return 1
    for remark in remarks:
        print(f"zemax.py: warning: {remark}", file=sys.stderr)
    exposures, points, rows = len(calset.exposures), len(calset.points), calset.intensities.rows
    told = f"{len(calset.filters)} wavelengths, {exposures} exposures of {points} points, {rows} rows to use"
    print(f"{given.output}: {calset.instrument}, {told}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

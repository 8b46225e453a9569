"""Text exports of an optical design program made into a calibration set (KIND `flux`).

State       `X-Field` and `Y-Field` of an export are the amplitudes of the electric vector along X and Y, hence
            CLP_ANGLE = atan2(Y, X), good to four decimals of the amplitudes: 11.25° is 11.25038°. `Field is
            unpolarized.` means polariser out. Transmissions are those of light of unit intensity in either case;
            N = 10⁶ × transmission. MJD has no meaning, it tells exposures apart.
Cameras     O1, E1, O2, E2 are the configurations 1, 3, 2, 4 of the WALOP-North design. Its data say that 1 and 3
            are the beams of one prism (extinct at 90° and 0°), 2 and 4 those of the other. That O2 is 2 and not 4
            is the choice of the set named below: with it m33 is negative over nine tenths of the field, while a
            plate at +22.5° makes it positive. Another design may number its beams otherwise: `configurations`.
Field       X and Y are those of the program, degrees, signs as they stand.
Vignetting  A transmission of exactly 0 is a ray bundle that does not arrive: FLAG 4.
Source      Cameras, order of rows and conventions were found by holding exports of WALOP-North against a calibration
            set that was made of them elsewhere; N agrees to the single precision of that set (test_zemax.py).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from walop_jax.data import schema
from walop_jax.data.calset import assembled
from walop_jax.data.records import CalibrationSet, DataFlag, Site
from walop_jax.data.zemax_text import HEADING, TransmissionExport, read_export
from walop_jax.instruments.description import described, shipped
from walop_jax.io.errors import fail, nearest

CAMERA_CONFIGURATIONS = (1, 3, 2, 4)
"""Configurations of the design that are the cameras O1, E1, O2, E2."""

RELATIVE_ERROR = 1e-3
"""Error that a transmission is given, as a share of it: how far the model of a design may be trusted."""

_UNIT = 1e6  # electrons for light of unit intensity
_CAMERA_NAMES = ("O1", "E1", "O2", "E2")


def import_transmissions(
    folder: str | os.PathLike[str],
    *,
    instrument: str | None = None,
    configurations: Sequence[int] = CAMERA_CONFIGURATIONS,
    error: float = RELATIVE_ERROR,
    tell: Callable[[str], None] = lambda text: None,
) -> CalibrationSet:
    """Make a calibration set (KIND `flux`) of all text exports in a folder and its subfolders.

    An exposure is a wavelength (a filter MONO-<Ångström>) and a state, unpolarised light first; rows that lack a
    camera are left out, exposures and points without any row too. MJD has no meaning, but tells exposures apart.
    N_ERR is the share `error` of N, at least the rounding of what is printed. `remarks` say what was left out.

    `instrument` is by default the one that the titles of the exports name; `configurations` are those of the
    cameras O1, E1, O2, E2; `tell` is told of the progress. Each file is read once.

    Raises `DataError` as `read_export` does, for data that are there twice, and if nothing can be made of them.
    """
    if len(set(configurations)) != 4:
        raise fail(
            f"{list(configurations)} are not four cameras", advice="give the configurations of O1, E1, O2, E2"
        )
    exports, remarks = _exports(Path(folder), tell)
    instrument = _instrument(exports, instrument, Path(folder), remarks)
    angles = np.array(sorted({export.angle for export in exports}))
    wavelengths = np.array(sorted({float(w) for export in exports for w in export.wavelength}))
    yx = np.array(sorted({place for e in exports for place in zip(e.y.tolist(), e.x.tolist(), strict=True)}))
    values, step = _dense(exports, angles, wavelengths, yx, tuple(configurations))

    seen = np.isfinite(values)
    row = seen.all(axis=-1)
    missing = ", ".join(
        f"{np.sum(~seen[..., k])} of {_CAMERA_NAMES[k]} (configuration {configurations[k]})" for k in range(4)
    )
    if not np.any(row):
        advice = "export the same fields and states in all four"
        raise fail(f"no row has all four cameras, missing are {missing}", file=folder, advice=advice)
    if not np.all(row):
        remarks.append(
            f"{folder}: {np.sum(~row)} of {row.size} rows (wavelength, state, field point) are left out because "
            f"a camera is missing: {missing}"
        )
    # Exposures and points without a row are left out too, what remains is numbered anew.
    taken, places = row.any(axis=-1), row.reshape(-1, len(yx)).any(axis=0)
    w, s, p = np.nonzero(row)
    counts = _UNIT * values[row]
    dark = np.any(counts == 0, axis=-1)
    if np.any(dark):
        remarks.append(
            f"{folder}: {np.sum(dark)} of {len(dark)} rows have a transmission of 0 (vignetted): flagged, not used"
        )
    table = {
        "EXPOSURE": (np.cumsum(taken).reshape(taken.shape) - 1)[w, s],
        "POINT": (np.cumsum(places) - 1)[p],
        "SOURCE": np.full(len(p), -1),
        "N": counts,
        # A number that was rounded to a step is off by step / √12.
        "N_ERR": np.maximum(error * counts, _UNIT * step[row] / math.sqrt(12.0)),
        "FLAG": np.where(dark, DataFlag.EDGE_OR_VIGNETTED, 0),
    }
    filters, states = np.nonzero(taken)
    return _calibration_set(
        instrument, folder, wavelengths[filters], angles[states], yx[places, ::-1], table, tuple(remarks)
    )


def _exports(folder: Path, tell: Callable[[str], None]) -> tuple[list[TransmissionExport], list[str]]:
    if not folder.is_dir():
        raise fail("is not a folder", file=folder, advice="give the folder that holds the exports")
    files = sorted(
        f for f in folder.rglob("*") if f.suffix.lower() == ".txt" and f.name[0] != "." and f.is_file()
    )
    found: list[TransmissionExport] = []
    other: list[Path] = []
    for n, file in enumerate(files):
        if n % 100 == 0:
            tell(f"reading {n} of {len(files)} files")
        export = read_export(file)
        if export is None:
            other.append(file)
        else:
            found.append(export)
    if not found:
        raise fail(f"none of {len(files)} text files begins with {HEADING!r}", file=folder,
                   advice="export that analysis as text, in English")  # fmt: skip
    if other:
        return found, [
            f"{folder}: {len(other)} text files are no exports and not read, {other[0].name} for one"
        ]
    return found, []


def _instrument(
    exports: list[TransmissionExport], wanted: str | None, folder: Path, remarks: list[str]
) -> str:
    """The instrument that was asked for, or the one that all titles name."""
    titles = sorted({export.title for export in exports})
    named = {name for title in titles for name in shipped() if name in title.upper()}
    if wanted is None and len(named) == 1:
        return named.pop()
    if wanted is None:
        raise fail(f"the titles name {len(named)} instruments ({', '.join(titles)})", file=folder,
                   advice=f"say which it is: --instrument {' or '.join(shipped())}")  # fmt: skip
    if wanted.upper() not in shipped():
        raise fail(f"there is no instrument {wanted!r}", advice=nearest(wanted, shipped()))
    if named - {wanted.upper()}:
        remarks.append(
            f"{folder}: the titles name {', '.join(sorted(named))}, {wanted.upper()} was asked for"
        )
    return wanted.upper()


def _dense(
    exports: list[TransmissionExport],
    angles: Float[np.ndarray, " s"],
    wavelengths: Float[np.ndarray, " w"],
    yx: Float[np.ndarray, "p 2"],
    configurations: tuple[int, ...],
) -> tuple[Float[np.ndarray, "w s p 4"], Float[np.ndarray, "w s p 4"]]:
    """Transmissions of all exports and the steps they are printed in, NaN where there are none.

    What is there twice is refused, and so is a configuration that is none of the cameras.
    """
    values, step = np.full((2, len(wavelengths), len(angles), len(yx), 4), np.nan)
    owner = np.full(values.shape, -1)
    place = {(y, x): n for n, (y, x) in enumerate(yx.tolist())}
    for n, e in enumerate(exports):
        if e.configuration not in configurations:
            advice = f"the cameras are {list(configurations)}: remove the file, or name others (--cameras)"
            raise fail(f"configuration {e.configuration} is no camera", file=e.path, advice=advice)
        points = [place[key] for key in zip(e.y.tolist(), e.x.tolist(), strict=True)]
        at = np.ix_(
            np.searchsorted(wavelengths, e.wavelength),
            np.searchsorted(angles, [e.angle]),
            np.array(points),
            np.array([configurations.index(e.configuration)]),
        )
        if np.any(owner[at] >= 0):
            raise fail(f"holds what stands in {exports[int(owner[at].max())].path} too (configuration, state, "
                       "field point, wavelength)", file=e.path, advice="remove one of them")  # fmt: skip
        values[at], step[at] = (part.T[:, None, :, None] for part in (e.transmission, e.step))
        owner[at] = n
    return values, step


def _calibration_set(
    instrument: str,
    folder: str | os.PathLike[str],
    wavelength: Float[np.ndarray, " e"],
    angle: Float[np.ndarray, " e"],
    xy: Float[np.ndarray, "p 2"],
    rows: dict[str, np.ndarray],
    remarks: tuple[str, ...],
) -> CalibrationSet:
    """Put the tables through the checks of any calibration set."""
    names = np.array([f"MONO-{1e4 * value:.0f}" for value in wavelength])
    n, clp_in = len(names), np.isfinite(angle)
    curve, first = np.unique(names, return_index=True)
    exposures = {name: np.full(n, column.missing) for name, column in schema.EXPOSURES.items()} | {
        "EXPOSURE": np.arange(n),
        "KIND": np.full(n, "flux"),
        "MJD": 60000.0 + 1e-3 * np.arange(n),
        "EXPTIME": np.ones(n),
        "FILTER": names,
        "CLP_IN": clp_in,
        "CLP_ANGLE": np.where(clp_in, angle, np.nan),
        "TEMP": np.full(n, 20.0),
        "HA": np.zeros(n),
    }
    tables = {
        "EXPOSURES": exposures,
        "POINTS": {"POINT": np.arange(len(xy)), "X": xy[:, 0], "Y": xy[:, 1]},
        "INTENSITIES": rows,
        "FILTERS": {
            "FILTER": curve,
            "WAVELENGTH": wavelength[first][:, None],
            "THROUGHPUT": np.ones((len(curve), 1)),
        },
    }
    return assembled(
        tables,
        Path(folder),
        version=1,
        instrument=instrument,
        site=Site(*described(instrument).place[:4]),
        origin="optical design program, polarization transmission",
        remarks=remarks,
    )

"""A small calibration set made by hand with astropy alone, so that the reader is not tested by the writer."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

NAN = float("nan")
HEADER = {
    "TELESCOP": "SAAO 1-m",
    "INSTRUME": "WALOP-SOUTH",
    "CALVERS": 1,
    "SITELAT": -32.3795,
    "SITELONG": 20.8107,
    "SITEELEV": 1798.0,
    "ORIGIN": "by hand",
}


def _tables() -> dict[str, dict[str, list]]:
    """name -> column -> [FITS format, unit, values]; 8 exposures (5 clp, flux, moon, standard), 3 points."""
    n_exp = 8
    rows = [(e, p) for e in range(n_exp) for p in range(3)]
    count = np.array([[1e5 + 1000 * e + 100 * p + 10 * k for k in range(4)] for e, p in rows])
    inside = [True] * 5 + [False] * 3
    return {
        "EXPOSURES": {
            "EXPOSURE": ["J", None, np.arange(n_exp) + 10],
            "KIND": ["12A", None, np.array(["clp"] * 5 + ["flux", "moon", "standard"])],
            "MJD": ["D", "d", 61043.85 + 0.01 * np.arange(n_exp)],
            "EXPTIME": ["E", "s", np.full(n_exp, 30.0)],
            "FILTER": ["12A", None, np.array(["SDSS-r"] * 7 + ["NARROW"])],
            "CLP_IN": ["L", None, np.array(inside)],
            "CLP_ANGLE": ["D", "deg", np.array([0.0, 36.0, 72.0, 108.0, 144.0, NAN, NAN, NAN])],
            "CHWP_IN": ["L", None, np.array([False, True] + [False] * 6)],
            "CHWP_ANGLE": ["D", "deg", np.array([NAN, 45.0] + [NAN] * 6)],
            "TEMP": ["E", "Celsius", np.full(n_exp, 10.0)],
            "HA": ["E", "h", np.linspace(-3, 3, n_exp)],
            "RA": ["D", "deg", np.array([NAN] * 6 + [115.0, 120.0])],
            "DEC": ["D", "deg", np.array([NAN] * 6 + [34.0, -30.0])],
            "ROTATOR": ["D", "deg", np.array([NAN] * 6 + [40.0, 75.0])],
            "TEFF": ["E", "K", np.array([5772.0] * 5 + [NAN] + [5772.0] * 2)],
        },
        "POINTS": {
            "POINT": ["J", None, np.array([5, 6, 7])],
            "X": ["D", "deg", np.array([-0.2, 0.0, 0.25])],
            "Y": ["D", "deg", np.array([0.1, 0.0, -0.25])],
        },
        "INTENSITIES": {
            "EXPOSURE": ["J", None, np.array([e + 10 for e, _ in rows])],
            "POINT": ["J", None, np.array([p + 5 for _, p in rows])],
            "SOURCE": ["J", None, np.array([3 if e == 7 else -1 for e, _ in rows])],
            "N": ["4D", "electron", count],
            "N_ERR": ["4D", "electron", np.sqrt(count)],
            "FLAG": ["I", None, np.zeros(len(rows), dtype=int)],
        },
        "SOURCES": {
            "SOURCE": ["J", None, np.array([3, 4])],
            "NAME": ["12A", None, np.array(["BD+25", "HD 1"])],
            "Q": ["D", None, np.array([0.01, 0.0])],
            "U": ["D", None, np.array([-0.02, 0.0])],
            "Q_ERR": ["D", None, np.array([2e-4, 2e-4])],
            "U_ERR": ["D", None, np.array([2e-4, 2e-4])],
            "TEFF": ["E", "K", np.array([7000.0, NAN])],
        },
        "FILTERS": {
            "FILTER": ["12A", None, np.array(["NARROW"])],
            "WAVELENGTH": ["4D", "um", np.array([[0.57, 0.58, 0.59, NAN]])],
            "THROUGHPUT": ["4D", None, np.array([[0.1, 0.9, 0.2, NAN]])],
        },
    }


def _two_cameras() -> dict[str, dict[str, list]]:
    """The same points and sources for another instrument: 6 exposures of a lamp and 2 of a standard.

    A retarder RET_1 that may be taken out, a rotating plate HWP that is always in, neither CLP nor CHWP.
    """
    tables = _tables()
    exposures, intensities = tables["EXPOSURES"], tables["INTENSITIES"]
    for name in ("CLP_IN", "CLP_ANGLE", "CHWP_IN", "CHWP_ANGLE"):
        del exposures[name]
    exposures["KIND"][2] = np.array(["lamp"] * 6 + ["standard"] * 2)
    exposures["RET_1_IN"] = ["L", None, np.array([True] * 4 + [False] * 2 + [True, False])]
    exposures["RET_1_ANGLE"] = ["D", "deg", np.array([0.0, 0.0, 30.0, 30.0, NAN, NAN, 60.0, NAN])]
    exposures["HWP_ANGLE"] = ["D", "deg", np.array([0.0, 22.5, 45.0, 67.5, 0.0, 22.5, 45.0, 360.0])]
    exposures["ROTATOR"][2] = np.array([NAN] * 6 + [40.0, 75.0])
    intensities["SOURCE"][2] = np.where(intensities["EXPOSURE"][2] >= 16, 3, -1)
    for name in ("N", "N_ERR"):
        intensities[name] = ["2D", "electron", intensities[name][2][:, :2]]
    return tables


class Handmade:
    """The set as plain columns: change what you like, then `write` it."""

    def __init__(self, folder: Path, *, two_cameras: bool = False) -> None:
        self.folder = folder
        self.header = dict(HEADER)
        self.tables = _two_cameras() if two_cameras else _tables()
        if two_cameras:
            self.header |= {"CALVERS": 2, "INSTRUME": "Bench of two"}

    def __getitem__(self, table: str) -> dict[str, list]:
        return self.tables[table]

    def values(self, table: str, column: str) -> np.ndarray:
        """The values of a column, to be changed in place."""
        return self.tables[table][column][2]

    def hdus(self) -> list:
        primary = fits.PrimaryHDU()
        primary.header.update(self.header)
        made = [primary]
        for name, columns in self.tables.items():
            cols = [
                fits.Column(name=column, format=code, unit=unit, array=values)
                for column, (code, unit, values) in columns.items()
            ]
            made.append(fits.BinTableHDU.from_columns(cols, name=name))
        return made

    def write(self, name: str = "set.fits", checksum: bool = True) -> Path:
        path = self.folder / name
        fits.HDUList(self.hdus()).writeto(path, checksum=checksum, overwrite=True)
        return path

    def refused(self, *fragments: str) -> None:
        """Write it and have it read: the error names the file and `fragments`, in one line."""
        from walop_jax.data.calset import read_calibration_set  # behind the checks of shapes
        from walop_jax.io.errors import DataError  # behind the checks of shapes

        path = self.write()
        with pytest.raises(DataError) as caught:
            read_calibration_set(path)
        message = str(caught.value)
        for fragment in (str(path), *fragments):
            assert fragment in message
        assert "\n" not in message

    def copy(self) -> Handmade:
        return copy.deepcopy(self)

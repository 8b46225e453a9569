"""Catalogues of the four cameras, as SExtractor and photutils write them, of a table with a row a star."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table

from walop_jax.sky.directions import Pointing

CAMERAS = ("O1", "E1", "O2", "E2")
CENTRE = {"RA": 97.5, "DEC": -44.0, "ROTATOR": 35.0}  # deg


def some_stars(count=300, seed=1) -> Table:
    """Stars over the field with made-up counts; their X, Y are those of the pointing `CENTRE`."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.3, 0.3, (2, count))
    ra, dec = Pointing(*CENTRE.values()).sky_of(x, y)
    n = 10 ** rng.uniform(4, 6, count)[:, None] * rng.uniform(0.8, 1.2, (count, 4))
    table = Table(
        {"SOURCE_ID": 5_000_000_000_000_000_000 + np.arange(count), "RA": ra, "DEC": dec, "X": x, "Y": y}
    )
    table["N"], table["N_ERR"], table["BP_RP"] = n, np.sqrt(n + 900), rng.uniform(0.5, 1.4, count)
    return table


def of_camera(stars, k: int, rng, scatter=0.1, keep=None) -> dict[str, np.ndarray]:
    """What a camera sees, in an order of its own: positions scatter by so many arcsec."""
    rows = rng.permutation(len(stars) if keep is None else np.flatnonzero(keep))
    offset = scatter / 3600.0 * rng.standard_normal((2, len(rows)))
    dec = np.asarray(stars["DEC"], float)[rows] + offset[1]
    columns = {
        "ALPHA_J2000": np.asarray(stars["RA"], float)[rows] + offset[0] / np.cos(np.deg2rad(dec)),
        "DELTA_J2000": dec,
        "FLUX_AUTO": np.asarray(stars["N"])[rows, k],
        "FLUXERR_AUTO": np.asarray(stars["N_ERR"])[rows, k],
        "FLAGS": np.zeros(len(rows), np.int16),
    }
    columns |= {
        name: np.asarray(stars[name])[rows] for name in ("SOURCE_ID", "BP_RP") if name in stars.colnames
    }
    return columns


def ldac(path: Path, columns: dict[str, np.ndarray], words=CENTRE) -> Path:
    """FITS_LDAC: the header of the image as a table of one row, then the objects."""
    header = fits.Header(words)
    cards = np.array([[card.image for card in header.cards]])
    image = fits.BinTableHDU.from_columns(
        [fits.Column("Field Header Card", f"{cards.size * 80}A", dim=f"(80, {cards.size})", array=cards)],
        name="LDAC_IMHEAD",
    )
    objects = fits.table_to_hdu(_table(columns))
    objects.name = "LDAC_OBJECTS"
    fits.HDUList([fits.PrimaryHDU(), image, objects]).writeto(path, checksum=True)
    return path


def ascii_head(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """ASCII_HEAD: a line of comment for each column, then numbers."""
    table = _table(columns)
    lines = [f"#{k + 1:4d} {name:<22} about it" for k, name in enumerate(table.colnames)]
    lines += [" ".join(str(value) for value in row) for row in table.iterrows()]
    path.write_text("\n".join(lines) + "\n")
    return path


def photutils(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """What aperture_photometry of photutils writes as ECSV, positions as coordinates of astropy."""
    count = len(columns["FLAGS"])
    made = QTable({"id": np.arange(count) + 1, "xcenter": np.zeros(count) * units.pix})
    made["sky_center"] = SkyCoord(columns["ALPHA_J2000"], columns["DELTA_J2000"], unit="deg")
    made["aperture_sum"] = columns["FLUX_AUTO"] * units.electron
    made["aperture_sum_err"] = columns["FLUXERR_AUTO"] * units.electron
    for name in ("SOURCE_ID", "BP_RP"):
        if name in columns:
            made[name.lower()] = columns[name]
    made.write(path, format="ascii.ecsv")
    return path


def _table(columns):
    return QTable(columns)


def four(stars, folder: Path, write=ldac, seed=5, words=None, **options) -> list[Path]:
    """The files of the four cameras; `words` are those of the headers of LDAC in place of the pointing."""
    rng, more = np.random.default_rng(seed), () if words is None else (words,)
    end = {ldac: "fits", ascii_head: "cat", photutils: "ecsv"}[write]
    return [
        write(folder / f"{name}.{end}", of_camera(stars, k, rng, **options), *more)
        for k, name in enumerate(CAMERAS)
    ]

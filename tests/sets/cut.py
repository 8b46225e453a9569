"""Cut the small sets of this folder from the calibration sets of an independent simulator.

    python tests/sets/cut.py FOLDER [TO]

FOLDER holds the four sets of WALOP-South with known truth, `walop_south_{a,b,c,d}.fits`, each with `_truth.fits`
and `_truth.json`. A cut keeps 5 × 5 of the 12 × 12 field points, edges included, all places of standard stars, and
every eighth point of the true matrix; of set b also every third polariser angle only. Rows that stay are those of
the original to the bit, with their numbers, and so are the filters and the sources.
"""

from __future__ import annotations

import gzip
import io
import shutil
import sys
from pathlib import Path

import numpy as np
from astropy.io import fits

SETS = "abcd"
GRID = (0, 3, 6, 8, 11)
"""Columns and rows of the 12 × 12 points that a cut keeps."""
EACH_ANGLE = {"b": 3}
EACH_TRUTH = 8


def cut_set(source: Path, target: Path, each_angle: int = 1) -> None:
    """Write the rows of a calibration set that belong to a cut, and the exposures and points that they need."""
    with fits.open(source) as hdus:
        exposures, points, rows = (hdus[name].data for name in ("EXPOSURES", "POINTS", "INTENSITIES"))
        line, column = np.divmod(np.arange(144), 12)
        kept = np.isin(column, GRID) & np.isin(line, GRID)
        kept = np.append(kept, np.ones(len(points) - 144, bool))  # the places of standards follow the grid
        point = points["POINT"][kept]
        taken = (exposures["KIND"] != "clp") | (np.arange(len(exposures)) % each_angle == 0)
        exposure = exposures["EXPOSURE"][taken]
        here = np.isin(rows["POINT"], point) & np.isin(rows["EXPOSURE"], exposure)
        keep = {"EXPOSURES": taken, "POINTS": kept, "INTENSITIES": here}
        _write(target, hdus, keep)


def cut_truth(source: Path, target: Path) -> None:
    """Write every eighth row of a table of true matrices."""
    with fits.open(source) as hdus:
        _write(target, hdus, {hdus[1].name: np.arange(len(hdus[1].data)) % EACH_TRUTH == 0})


def _write(target: Path, hdus: fits.HDUList, keep: dict[str, np.ndarray]) -> None:
    """Compress a file of the kept rows."""
    out = fits.HDUList()
    for hdu in hdus:
        rows = keep.get(hdu.name) if hdu.data is not None else None
        header = hdu.header.copy()
        header.remove("CHECKSUM", ignore_missing=True)  # carries a date; gzip has a checksum of its own
        header.remove("DATASUM", ignore_missing=True)
        out.append(type(hdu)(data=hdu.data if rows is None else hdu.data[rows], header=header))
    content = io.BytesIO()
    out.writeto(content)
    target.write_bytes(gzip.compress(content.getvalue(), 9, mtime=0))


def main(folder: Path, to: Path) -> None:
    """Cut all four sets."""
    for name in SETS:
        stem = f"walop_south_{name}"
        cut_set(folder / f"{stem}.fits", to / f"{stem}.fits.gz", EACH_ANGLE.get(name, 1))
        cut_truth(folder / f"{stem}_truth.fits", to / f"{stem}_truth.fits.gz")
        shutil.copyfile(folder / f"{stem}_truth.json", to / f"{stem}_truth.json")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).parent)

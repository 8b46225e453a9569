"""Rows of a calibration set that a fit left out as outliers: the table `clipped.ecsv` in the folder of its run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.records import CalibrationSet, DataFlag
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.io.errors import fail

COLUMNS = ("EXPOSURE", "POINT", "X", "Y", "KIND", "CAMERA", "DISTANCE")


@dataclasses.dataclass(frozen=True, eq=False)
class Clipped:
    """Intensities that lie far from a fit of all others, and took no part in it.

    Entry r is the intensity of EXPOSURE `exposure[r]` at POINT `point[r]` of the set, in the camera with the number
    `camera[r]`: it lies `distance[r]` standard errors from the fit. `sigma` is the distance from which on intensities
    are left out. `used` rows took part before.
    """

    sigma: float
    used: int
    exposure: Int[np.ndarray, " r"]
    point: Int[np.ndarray, " r"]
    camera: Int[np.ndarray, " r"]
    distance: Float[np.ndarray, " r"]

    def __len__(self) -> int:
        return len(self.exposure)

    @property
    def share(self) -> float:
        """Fraction of the used rows that is left out."""
        return len(self) / max(self.used, 1)

    def __str__(self) -> str:
        share = f" ({100 * self.share:.2g} %)" if len(self) else ""
        return f"{len(self)} of {self.used} rows{share}, more than {self.sigma:g} standard errors off, are left out"

    def document(self) -> dict[str, Any]:
        """The entry of `summary.json` (docs: files)."""
        return {"sigma": self.sigma, "rows": len(self), "used": self.used}

    def taken_from(self, calset: CalibrationSet) -> CalibrationSet:
        """The set with these rows flagged (FLAG 2), so that they take no part.

        Raises ValueError for a set that lacks one of them.
        """
        table = TableIntensities.of(calset.intensities, calset.points)
        numbers = calset.exposures.exposure[table.exposure], calset.points.point[table.point]
        rows = set(zip(self.exposure.tolist(), self.point.tolist(), strict=True))
        found = np.array([pair in rows for pair in zip(*(n.tolist() for n in numbers), strict=True)], bool)
        if found.sum() < len(rows):
            raise ValueError(f"{len(rows) - found.sum()} of {len(rows)} rows are not in the calibration set")
        return dataclasses.replace(calset, intensities=table.flagged(found, DataFlag.BAD_PIXEL))

    def write(self, path: Path, calset: CalibrationSet, cameras: tuple[str, ...]) -> None:
        """Write the table, with the places and kinds of the set and the names of its cameras."""
        from astropy.table import Table  # imported here: it takes a third of a second

        exposures, points = calset.exposures, calset.points
        e = [int(np.flatnonzero(exposures.exposure == number)[0]) for number in self.exposure]
        p = [int(np.flatnonzero(points.point == number)[0]) for number in self.point]
        kinds, names = exposures.kind[e].astype(str), np.array(cameras, str)[self.camera]
        columns = (self.exposure, self.point, points.x[p], points.y[p], kinds, names, self.distance)
        named, meta = dict(zip(COLUMNS, columns, strict=True)), {"SIGMA": self.sigma, "USED": self.used}
        table = Table(named, meta=meta, units={"X": "deg", "Y": "deg"})
        table.write(path, format="ascii.ecsv", overwrite=True)


def read_clipped(path: Path) -> Clipped:
    """Read a table that `Clipped.write` made; numbers of cameras are 0. Raises `DataError` where it is damaged."""
    from astropy.table import Table

    try:
        table = Table.read(path, format="ascii.ecsv")
        exposure, point = (np.asarray(table[name], np.int64) for name in ("EXPOSURE", "POINT"))
        sigma, used = float(table.meta["SIGMA"]), int(table.meta["USED"])
        camera, distance = np.zeros(len(table), np.int64), np.asarray(table["DISTANCE"], np.float64)
        return Clipped(sigma, used, exposure, point, camera, distance)
    except Exception as error:
        what = f"cannot be read as a list of rows: {' '.join(str(error).split())[:200]}"
        raise fail(what, file=path, advice="run walop-jax refit --clip again") from error

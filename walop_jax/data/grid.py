"""The linear map from the pixels of an image to coordinates in the field, and its words in a FITS header."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import Points
from walop_jax.data.units import Place, convert_unit


@dataclasses.dataclass(frozen=True)
class Grid:
    """The linear map from pixels to field coordinates (FITS standard, section 8.1).

    (x, y) = `value` + `matrix` · (pixel − `reference`), in degrees, pixels counted from 1 as FITS does;
    `width` pixels in a row, `height` rows. Points run along the rows.
    """

    width: int
    height: int
    reference: tuple[float, float]
    value: tuple[float, float]
    matrix: tuple[tuple[float, float], tuple[float, float]]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.width * self.height

    def xy(self, start: int, stop: int) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Return the field coordinates (degrees) of the points `start:stop`."""
        row, column = np.divmod(np.arange(start, stop), self.width)
        return self.at(column, row)

    def at(self, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the field coordinates (degrees) of places in the image, columns and rows counted from 0."""
        i, j = column + (1.0 - self.reference[0]), row + (1.0 - self.reference[1])
        (xi, xj), (yi, yj) = self.matrix
        return self.value[0] + (xi * i + xj * j), self.value[1] + (yi * i + yj * j)

    @functools.cached_property
    def points(self) -> Points:
        """All pixels as field points, numbered from 0."""
        x, y = self.xy(0, self.pixels)
        return Points(point=np.arange(len(x), dtype=np.int32), x=x, y=y)


def read_grid(header: Any, place: Place) -> Grid:
    """Read the linear coordinates of the first two axes: CRPIX, CRVAL and CD, or CDELT with PC."""
    for axis, name in ((1, "X"), (2, "Y")):
        axis_type = str(header.get(f"CTYPE{axis}", "")).strip().upper()
        if axis_type != name:
            what = f"is {axis_type!r} where {name!r} is needed"
            raise place.fail(what, f"CTYPE{axis}", "field coordinates, linear")
    if float(header.get("CROTA2", 0.0)) != 0.0:
        raise place.fail("is an obsolete rotation", "CROTA2", "write PC or CD")

    def scale(n: int) -> float:
        unit = str(header.get(f"CUNIT{n}") or "deg")
        return float(convert_unit(np.ones(1), unit, "deg", f"CUNIT{n}", place)[0])

    def matrix(i: int, j: int) -> float:
        if any(f"CD{a}_{b}" in header for a in (1, 2) for b in (1, 2)):
            return float(header.get(f"CD{i}_{j}", 0.0))
        return float(header.get(f"CDELT{i}", 1.0)) * float(header.get(f"PC{i}_{j}", 1.0 if i == j else 0.0))

    x, y = scale(1), scale(2)
    grid = Grid(
        width=int(header["NAXIS1"]),
        height=int(header["NAXIS2"]),
        reference=(float(header.get("CRPIX1", 0.0)), float(header.get("CRPIX2", 0.0))),
        value=(x * float(header.get("CRVAL1", 0.0)), y * float(header.get("CRVAL2", 0.0))),
        matrix=((x * matrix(1, 1), x * matrix(1, 2)), (y * matrix(2, 1), y * matrix(2, 2))),
    )
    if np.linalg.det(np.array(grid.matrix)) == 0 or not np.all(np.isfinite(grid.matrix)):
        raise place.fail("the coordinates are singular", "CDELT, PC, CD", "write the pixel scale in degrees")
    return grid


def grid_cards(grid: Grid) -> dict[str, str | float]:
    """The header cards of the linear field coordinates of an image."""
    cards: dict[str, str | float] = {}
    for n, axis in enumerate("XY"):
        cards |= {f"CTYPE{n + 1}": axis, f"CUNIT{n + 1}": "deg"}
        cards |= {f"CRPIX{n + 1}": grid.reference[n], f"CRVAL{n + 1}": grid.value[n]}
        cards |= {f"CD{n + 1}_{m + 1}": grid.matrix[n][m] for m in range(2)}
    return cards

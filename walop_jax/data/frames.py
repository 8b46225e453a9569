"""Images of whole frames in a file: where their rows lie, and how they are read; `cells` makes field points of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.grid import Grid, read_grid
from walop_jax.data.records import DataFlag
from walop_jax.data.units import Place, check_units, convert_unit
from walop_jax.io.errors import fail


@dataclasses.dataclass(frozen=True)
class Cube:
    """Values of an image extension (exposures, rows, columns): where they lie in its file, and their reader."""

    place: Place
    path: Path
    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, int, int]
    scale: float
    zero: float
    blank: int | None

    def rows(self, plane: int, start: int, stop: int) -> Float[np.ndarray, "y x"]:
        """Read some rows of a plane, in the precision of the file; undefined integers (BLANK) become NaN.

        Raises `DataError` if they are not there.
        """
        _, height, width = self.shape
        first = self.offset + (plane * height + start) * width * self.dtype.itemsize
        try:
            stored = np.fromfile(self.path, self.dtype, count=(stop - start) * width, offset=first)
        except OSError as error:
            raise self.place.fail(f"cannot be read: {error}") from error
        if stored.size < (stop - start) * width:
            raise self.place.fail("the file is truncated", advice="copy it again")
        plain = (
            stored.dtype.itemsize == 4 and stored.dtype.kind == "f" and (self.scale, self.zero) == (1.0, 0.0)
        )
        values = stored.astype(np.float32 if plain else np.float64)
        if (self.scale, self.zero) != (1.0, 0.0):
            values = values * self.scale + self.zero
        if self.blank is not None:
            values[stored == self.blank] = np.nan
        return values.reshape(stop - start, width)


def image_names(cameras: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the image extensions of counts and of errors: N0, N1, …, and E0, E1, …; FLAG may be there too."""
    return tuple(f"N{k}" for k in range(cameras)), tuple(f"E{k}" for k in range(cameras))


@dataclasses.dataclass(frozen=True)
class Frames:
    """The frames of one file: a cube of counts and one of errors per camera, and flags if there are any."""

    grid: Grid
    exposures: int
    counts: tuple[Cube, ...]
    sigma: tuple[Cube, ...]
    flag: Cube | None

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.counts)

    def rows(
        self, exposure: int, start: int, stop: int
    ) -> tuple[Float[np.ndarray, "k y x"], Float[np.ndarray, "k y x"], Int[np.ndarray, "y x"]]:
        """Image rows of one exposure as they stand: counts and errors (electrons) of each camera, and flags."""
        counts, sigma = (
            np.stack([cube.rows(exposure, start, stop) for cube in cubes])
            for cubes in (self.counts, self.sigma)
        )
        if self.flag is None:
            return counts, sigma, np.zeros(counts.shape[1:], dtype=np.int64)
        flag = self.flag.rows(exposure if self.flag.shape[0] > 1 else 0, start, stop)
        # An undefined flag is no clean bill of health.
        return counts, sigma, np.nan_to_num(flag, nan=float(DataFlag.BAD_PIXEL)).astype(np.int64)


def frames_of(images: Mapping[str, Any], exposures: int, path: Path) -> Frames:
    """Describe the image extensions of a file, `images` by name, without reading their pixels.

    Raises `DataError` for a missing or compressed extension, a shape that does not fit the exposures or the
    other extensions, a coordinate system that is not linear in X and Y, and a unit that is not electrons.
    """
    grids: dict[Grid, str] = {}
    cubes: dict[str, Cube] = {}
    units: dict[str, str] = {}
    cameras = max([2, *(int(name[1:]) + 1 for name in images if name != "FLAG")])
    counts, errors = image_names(cameras)
    for name in (*counts, *errors, *(("FLAG",) if "FLAG" in images else ())):
        place = Place(path, name)
        if name not in images:
            advice = f"frames need {counts[0]}…{counts[-1]} and {errors[0]}…{errors[-1]}"
            raise place.fail("the image extension is missing", advice=advice)
        cubes[name] = _cube(images[name], exposures, place)
        if name != "FLAG":
            grids.setdefault(read_grid(images[name].header, place), name)
            unit = units[name] = str(images[name].header.get("BUNIT") or "").strip()
            size = float(convert_unit(np.ones(1), unit or "electron", "electron", "BUNIT", place)[0])
            cube = cubes[name]
            cubes[name] = dataclasses.replace(cube, scale=size * cube.scale, zero=size * cube.zero)
    check_units(units, "electron", Place(path, "BUNIT"))
    if len(grids) > 1:
        reference, second, *_ = grids.values()
        what = f"{reference} and {second} do not lie on the same grid"
        raise fail(what, file=path, advice="resample them first")
    grid, flag = next(iter(grids)), cubes.get("FLAG")
    if flag is not None and flag.shape[1:] != (grid.height, grid.width):
        raise fail("does not have the shape of N0", file=path, extension="FLAG", advice="write it anew")
    cubes_of, sigma_of = (tuple(cubes[name] for name in names) for names in (counts, errors))
    return Frames(grid, exposures, cubes_of, sigma_of, flag)


def _cube(hdu: Any, exposures: int, place: Place) -> Cube:
    header = hdu.header
    if "ZIMAGE" in header:
        advice = "unpack it with funpack: frames are read some rows at a time"
        raise place.fail("is compressed tile by tile", advice=advice)
    shape = tuple(int(header[f"NAXIS{n}"]) for n in range(int(header["NAXIS"]), 0, -1))
    shape = (1, *shape) if len(shape) == 2 else shape
    planes = (exposures, 1) if place.extension == "FLAG" else (exposures,)
    if len(shape) != 3 or shape[0] not in planes or 0 in shape:
        what = f"has shape {shape} where ({exposures}, ny, nx) is needed"
        raise place.fail(what, advice="one plane per row of EXPOSURES")
    path = Path(str(place.file)).absolute()
    kinds = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
    bitpix = int(header["BITPIX"])
    blank = header.get("BLANK")
    return Cube(
        place=Place(path, place.extension),
        path=path,
        offset=int(hdu.fileinfo()["datLoc"]),
        dtype=np.dtype(kinds[bitpix]),
        shape=(shape[0], shape[1], shape[2]),
        scale=float(header.get("BSCALE", 1.0)),
        zero=float(header.get("BZERO", 0.0)),
        blank=int(blank) if blank is not None and bitpix > 0 else None,
    )

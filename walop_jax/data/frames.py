"""Intensities that stand in whole frames, which may be far larger than memory: read in slabs on demand.

For passes over all pixels image rows come as they lie on disk (`RowReader`). Frames are mostly big-endian float32.
These come as the 32-bit words of the file, in arrays that JAX takes over without a copy, and `float64` turns them into
numbers inside a compiled function; anything else is converted here.
"""

from __future__ import annotations

import dataclasses
import functools
import threading
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from walop_jax.data.grid import Grid, read_grid
from walop_jax.data.records import Block, DataFlag, Intensities
from walop_jax.data.table_intensities import empty_block, usable
from walop_jax.data.units import Place, check_units, convert_unit
from walop_jax.io.errors import fail

_LONG = 1 << 28  # (exposure, pixel) pairs: gigabytes of frames, which are not counted without a word
_SLAB = 1 << 19  # values of one camera that are looked at together when whole frames are gone through


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
    stamp: tuple[int, int]

    def stored(self, start: int, stop: int) -> np.ndarray:
        """Some rows of all planes as in the file, mapped; `DataError` if that has gone or changed meanwhile."""
        self._check_stamp()
        try:
            # Mapped anew each time: no open file to keep, and pages are given back after the slab.
            raw = np.memmap(self.path, self.dtype, mode="r", offset=self.offset, shape=self.shape)
        except OSError as error:
            raise self.place.fail(f"cannot be read: {error}") from error
        return np.asarray(raw[:, start:stop])

    def read_into(self, planes: np.ndarray, start: int) -> None:
        """Read rows of all planes, from `start` on, into an array (plane, row, column) without gaps."""
        self._check_stamp()
        _, height, width = self.shape
        row = width * self.dtype.itemsize
        with self.path.open("rb", buffering=0) as file:
            for number, plane in enumerate(planes):
                file.seek(self.offset + (number * height + start) * row)
                target = memoryview(plane).cast("B")
                if file.readinto(target) != len(target):
                    raise self.place.fail("the file is truncated", advice="read it again")

    def _check_stamp(self) -> None:
        try:
            stat = self.path.stat()
        except OSError as error:
            raise self.place.fail(f"cannot be read: {error}") from error
        if (stat.st_size, stat.st_mtime_ns) != self.stamp:
            raise fail("the file has changed since it was opened", file=self.path, advice="read it again")

    def rows(self, start: int, stop: int) -> Float[np.ndarray, "e y x"]:
        """Read some rows of all planes; undefined integers (BLANK) become NaN. Raises what `stored` raises."""
        stored = self.stored(start, stop)
        values = stored.astype(np.float64)
        if (self.scale, self.zero) != (1.0, 0.0):
            values = values * self.scale + self.zero
        if self.blank is not None:
            values[stored == self.blank] = np.nan
        return values


def image_names(cameras: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the image extensions of counts and of errors: N0, N1, …, and E0, E1, …; FLAG may be there too."""
    return tuple(f"N{k}" for k in range(cameras)), tuple(f"E{k}" for k in range(cameras))


@dataclasses.dataclass(frozen=True)
class FrameStack:
    """The frames of one file: a cube of counts and one of errors per camera, and flags if there are any."""

    exposures: int
    counts: tuple[Cube, ...]
    sigma: tuple[Cube, ...]
    flag: Cube | None


@dataclasses.dataclass(frozen=True, eq=False)
class FrameIntensities(Intensities):
    """Frames of one or several files on the same grid of pixels, exposures one after the other."""

    grid: Grid
    stacks: tuple[FrameStack, ...]

    @functools.cached_property
    def exposures(self) -> int:
        """Number of exposures."""
        return sum(stack.exposures for stack in self.stacks)

    @property
    def cameras(self) -> int:
        """Number of cameras; nothing is read."""
        return len(self.stacks[0].counts)

    @functools.cached_property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Number of used (exposure, pixel) pairs; the first call reads all frames, slab by slab, and warns of many."""
        if (size := self.exposures * self.grid.pixels) > _LONG:
            what = f"counting the used pixels reads all {self.exposures} frames of every camera, {size:,} pixels each"
            warnings.warn(f"{what}: this takes minutes; `n_data` of a fit is that number", stacklevel=2)
        step = max(1, _SLAB // max(1, self.exposures))
        starts = range(0, self.grid.pixels, step)
        return sum(int(np.count_nonzero(self.block(start, start + step).used)) for start in starts)

    def block(self, start: int, stop: int) -> Block:
        """The pixels `start:stop`, dense in the exposures; `DataError` for an error not above zero on an open pixel."""
        start, stop, _ = slice(start, stop).indices(self.grid.pixels)
        stop = max(start, stop)
        block = empty_block(*self.grid.xy(start, stop), self.exposures, self.cameras)
        first = 0
        for stack in self.stacks if stop > start else ():
            rows = slice(first, first + stack.exposures)
            counts, sigma, flag = self.read(stack, start, stop)
            used, _, impossible = usable(counts, sigma, flag)
            if np.any(impossible):
                pixel, plane = (int(entry[0]) for entry in np.nonzero(impossible))
                row, column = divmod(start + pixel, self.grid.width)
                camera = int(np.argmax(sigma[pixel, plane] <= 0))
                where = f"plane {plane}, row {row}, column {column} (counted from 0)"
                what = f"is zero or negative in {where}, and {int(impossible.sum())} pixel(s) in all"
                advice = "give the true error, or set the FLAG image"
                raise stack.sigma[camera].place.fail(what, advice=advice)
            block.used[:, rows] = used
            block.counts[:, rows] = np.where(used[..., None], counts, 0.0)
            block.sigma[:, rows] = np.where(used[..., None], sigma, 1.0)
            first += stack.exposures
        return block

    def read(self, stack: FrameStack, start: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return counts and errors (points, exposures, cameras) and flags (points, exposures) as they stand."""
        top, bottom = start // self.grid.width, -(-stop // self.grid.width)
        inside = slice(start - top * self.grid.width, stop - top * self.grid.width)

        def columns(cube: Cube) -> np.ndarray:
            values = cube.rows(top, bottom)
            return values.reshape(len(values), -1)[:, inside].T

        counts, sigma = (np.stack(list(map(columns, s)), axis=-1) for s in (stack.counts, stack.sigma))
        if stack.flag is None:
            return counts, sigma, np.zeros(counts.shape[:2], dtype=np.int64)
        # An undefined flag is no clean bill of health.
        flag = np.nan_to_num(columns(stack.flag), nan=float(DataFlag.BAD_PIXEL)).astype(np.int64)
        return counts, sigma, np.broadcast_to(flag, counts.shape[:2])


def frame_stack(images: Mapping[str, Any], exposures: int, path: Path) -> tuple[Grid, FrameStack]:
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
    return grid, FrameStack(exposures, cubes_of, sigma_of, flag)


def _cube(hdu: Any, exposures: int, place: Place) -> Cube:
    header = hdu.header
    if "ZIMAGE" in header:
        advice = "unpack it with funpack: frames are read in slabs"
        raise place.fail("is compressed tile by tile", advice=advice)
    shape = tuple(int(header[f"NAXIS{n}"]) for n in range(int(header["NAXIS"]), 0, -1))
    shape = (1, *shape) if len(shape) == 2 else shape
    planes = (exposures, 1) if place.extension == "FLAG" else (exposures,)
    if len(shape) != 3 or shape[0] not in planes or 0 in shape:
        what = f"has shape {shape} where ({exposures}, ny, nx) is needed"
        raise place.fail(what, advice="one plane per row of EXPOSURES")
    path = Path(str(place.file)).absolute()
    info, stat = hdu.fileinfo(), path.stat()
    kinds = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
    bitpix = int(header["BITPIX"])
    blank = header.get("BLANK")
    return Cube(
        place=Place(path, place.extension),
        path=path,
        offset=int(info["datLoc"]),
        dtype=np.dtype(kinds[bitpix]),
        shape=(shape[0], shape[1], shape[2]),
        scale=float(header.get("BSCALE", 1.0)),
        zero=float(header.get("BZERO", 0.0)),
        blank=int(blank) if blank is not None and bitpix > 0 else None,
        stamp=(stat.st_size, stat.st_mtime_ns),
    )


# --------------------------------------------------------------------------------------- image rows as they lie on disk

_ALIGNED = 64  # bytes: what JAX takes over without a copy
_WORDS = np.dtype(">f4")


class RawRows(NamedTuple):
    """Some rows of all frames, padded to a size with closed pixels.

    `counts` and `sigma` (camera, exposure, row, column) are 32-bit words of the file or electrons in float64 (see
    `float64`), `open` says which pixels carry no flag.
    """

    counts: Any
    sigma: Any
    open: Bool[np.ndarray, "e h w"]


def float64(values: Array) -> Float[Array, ...]:
    """Numbers from the words of big-endian float32; float64 stays as it is."""
    if values.dtype != jnp.uint32:
        return values
    swapped = ((values & 0xFF) << 24) | ((values & 0xFF00) << 8) | ((values >> 8) & 0xFF00) | (values >> 24)
    return jax.lax.bitcast_convert_type(swapped, jnp.float32).astype(jnp.float64)


class RowReader:
    """Reads image rows of all frames into arrays of `height` × `width` pixels, which each thread uses again and again.

    Computations on the rows must be finished before the next ones are read.
    """

    def __init__(self, intensities: FrameIntensities, height: int, width: int) -> None:
        self.intensities, self.shape = intensities, (height, width)
        self._own = threading.local()

    def __call__(self, start: int, stop: int) -> RawRows:
        """The image rows `start:stop`. Raises `DataError` if a file has gone or changed since it was checked."""
        counts, sigma, closed = self._buffers()
        inside = (slice(0, stop - start), slice(0, self.intensities.grid.width))
        closed[:] = True
        first = 0
        for stack in self.intensities.stacks:
            rows = slice(first, first + stack.exposures)
            for array, stored in ((counts, stack.counts), (sigma, stack.sigma)):
                for camera, cube in enumerate(stored):
                    _read(cube, start, stop, array[camera, rows])
            if (flag := stack.flag) is None:
                closed[(rows, *inside)] = False
            else:  # an undefined flag, NaN, is no clean bill of health
                plain = (flag.scale, flag.zero, flag.blank) == (1.0, 0.0, None)
                closed[(rows, *inside)] = (flag.stored if plain else flag.rows)(start, stop) != 0
            first += stack.exposures
        return RawRows(jax.device_put(counts), jax.device_put(sigma), ~closed)

    def _buffers(self) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "e h w"]]:
        """This thread's arrays. Values of closed pixels are undefined and never used."""
        if not hasattr(self._own, "buffers"):
            frames = self.intensities
            cubes = [cube for stack in frames.stacks for cube in (*stack.counts, *stack.sigma)]
            as_stored = all((cube.dtype, cube.scale, cube.zero) == (_WORDS, 1.0, 0.0) for cube in cubes)
            dtype = np.uint32 if as_stored else np.float64
            shape = (frames.cameras, frames.exposures, *self.shape)
            counts, sigma = _zeros(shape, dtype), _zeros(shape, dtype)
            self._own.buffers = counts, sigma, np.ones(shape[1:], bool)
        return self._own.buffers


def _read(cube: Cube, start: int, stop: int, into: np.ndarray) -> None:
    """Read rows of a cube into the first rows and columns of an array (plane, row, column)."""
    height, width = stop - start, cube.shape[2]
    if into.dtype != np.uint32:
        into[:, :height, :width] = cube.rows(start, stop)
    elif width < into.shape[2]:
        into[:, :height, :width] = cube.stored(start, stop).view(np.uint32)
    else:
        cube.read_into(into[:, :height], start)


def _zeros(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.zeros(size + _ALIGNED, np.uint8)
    begin = -memory.ctypes.data % _ALIGNED
    return memory[begin : begin + size].view(dtype).reshape(shape)

"""Image rows of whole frames as they lie on disk: for passes over all pixels that convert them as they compute.

Frames are mostly big-endian float32. These come as the 32-bit words of the file, in arrays that JAX takes over without
a copy, and `float64` turns them into numbers inside a compiled function; anything else is converted here.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from walop_jax.data.frames import Cube, FrameIntensities

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
    """Numbers from the words of big-endian float32; what is float64 stays so."""
    if values.dtype != jnp.uint32:
        return values
    swapped = ((values & 0xFF) << 24) | ((values & 0xFF00) << 8) | ((values >> 8) & 0xFF00) | (values >> 24)
    return jax.lax.bitcast_convert_type(swapped, jnp.float32).astype(jnp.float64)


class RowReader:
    """Reads image rows of all frames into arrays of `height` × `width` pixels, which each thread uses again and again.

    What was made of the rows must be finished before the next ones are read.
    """

    def __init__(self, intensities: FrameIntensities, height: int, width: int) -> None:
        self.intensities, self.shape = intensities, (height, width)
        self._own = threading.local()

    def __call__(self, start: int, stop: int) -> RawRows:
        """The image rows `start:stop`.

        Raises `DataError` if a file has gone or changed since it was checked.
        """
        counts, sigma, closed = self._buffers()
        inside = (slice(0, stop - start), slice(0, self.intensities.grid.width))
        closed[:] = True
        first = 0
        for stack in self.intensities.stacks:
            here = slice(first, first + stack.exposures)
            for array, own in ((counts, stack.counts), (sigma, stack.sigma)):
                for camera, cube in enumerate(own):
                    _read(cube, start, stop, array[camera, here])
            closed[(here, *inside)] = False if stack.flag is None else _is_set(stack.flag, start, stop)
            first += stack.exposures
        return RawRows(jax.device_put(counts), jax.device_put(sigma), ~closed)

    def _buffers(self) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "e h w"]]:
        """This thread's arrays. Closed pixels hold zeros or what was there before, and are never used."""
        if not hasattr(self._own, "buffers"):
            frames = self.intensities
            cubes = [cube for stack in frames.stacks for cube in (*stack.counts, *stack.sigma)]
            dtype = np.uint32 if all(_is_plain(cube) for cube in cubes) else np.float64
            shape = (frames.cameras, frames.exposures, *self.shape)
            counts, sigma = _zeros(shape, dtype), _zeros(shape, dtype)
            self._own.buffers = counts, sigma, np.ones(shape[1:], bool)
        return self._own.buffers


def _is_plain(cube: Cube) -> bool:
    return cube.dtype == _WORDS and (cube.scale, cube.zero) == (1.0, 0.0)


def _is_set(flag: Cube, start: int, stop: int) -> Bool[np.ndarray, "e y x"]:
    if (flag.scale, flag.zero, flag.blank) == (1.0, 0.0, None):
        return flag.stored(start, stop) != 0  # whatever the order of the bytes
    return flag.rows(start, stop) != 0  # an undefined flag, NaN, is no clean bill of health


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

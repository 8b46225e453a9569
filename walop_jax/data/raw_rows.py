"""Image rows of whole frames as they lie on disk: for passes over all pixels that convert them as they compute.

Frames are mostly big-endian float32. These come as the 32-bit words of the file, in arrays that JAX takes over without
a copy, and `float64` turns them into numbers inside a compiled function; anything else is converted here.
"""

from __future__ import annotations

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


def raw_rows(intensities: FrameIntensities, start: int, stop: int, height: int, width: int) -> RawRows:
    """Read the image rows `start:stop` of all frames into arrays of `height` × `width` pixels.

    Raises `DataError` if a file has gone or changed since it was checked.
    """
    shape = (intensities.cameras, intensities.exposures, height, width)
    inside = (slice(0, stop - start), slice(0, intensities.grid.width))
    cubes = [cube for stack in intensities.stacks for cube in (*stack.counts, *stack.sigma)]
    dtype = np.uint32 if all(_is_plain(cube) for cube in cubes) else np.float64
    # Closed pixels beyond the frames hold zeros, which are never used.
    counts, sigma = (_empty(shape, dtype) for _ in range(2))
    closed = np.ones(shape[1:], bool)
    first = 0
    for stack in intensities.stacks:
        here = slice(first, first + stack.exposures)
        for array, own in ((counts, stack.counts), (sigma, stack.sigma)):
            for camera, cube in enumerate(own):
                array[(camera, here, *inside)] = _rows(cube, start, stop, dtype)
        if stack.flag is None:
            closed[(here, *inside)] = False
        else:
            closed[(here, *inside)] = _is_set(stack.flag, start, stop)
        first += stack.exposures
    for array in (counts, sigma):
        array[..., stop - start :, :] = 0
        array[..., intensities.grid.width :] = 0
    return RawRows(jax.device_put(counts), jax.device_put(sigma), ~closed)


def _is_plain(cube: Cube) -> bool:
    return cube.dtype == _WORDS and (cube.scale, cube.zero) == (1.0, 0.0)


def _is_set(flag: Cube, start: int, stop: int) -> Bool[np.ndarray, "e y x"]:
    if (flag.scale, flag.zero, flag.blank) == (1.0, 0.0, None):
        return flag.stored(start, stop) != 0  # whatever the order of the bytes
    return flag.rows(start, stop) != 0  # an undefined flag, NaN, is no clean bill of health


def _rows(cube: Cube, start: int, stop: int, dtype: type) -> np.ndarray:
    if dtype is np.float64:
        return cube.rows(start, stop)
    return cube.stored(start, stop).view(np.uint32)


def _empty(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.empty(size + _ALIGNED, np.uint8)
    begin = -memory.ctypes.data % _ALIGNED
    return memory[begin : begin + size].view(dtype).reshape(shape)

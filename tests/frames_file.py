"""Calibration sets written as whole frames, as a reduction of images would leave them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from astropy.io import fits

from walop_jax.data.frames import image_names
from walop_jax.data.grid import Grid, grid_cards
from walop_jax.data.records import CalibrationSet, DataFlag, Points
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set

SLAB = 1 << 18  # (exposure, pixel) pairs that are written at a time


def write_frames(
    path: Path, calset: CalibrationSet, grid: Grid, *, dtype: str = "f4", overwrite: bool = False
) -> None:
    """Write a set whose points are the pixels of `grid`, row by row, a slab of them at a time.

    Pixels without a measurement get bit 2 (bad pixel) of the FLAG image.
    """
    first = Points(*(getattr(calset.points, name)[:1] for name in ("point", "x", "y")))
    table = TableIntensities.dense(first, calset.intensities.block(0, 1))
    write_calibration_set(
        path, dataclasses.replace(calset, points=first, intensities=table), overwrite=overwrite
    )
    with fits.open(path, memmap=False) as hdus:
        del hdus["POINTS"], hdus["INTENSITIES"]
        hdus.writeto(path, overwrite=True)
    shape = (len(calset.exposures), grid.height, grid.width)
    counts, errors = image_names(calset.cameras)
    kinds = dict.fromkeys((*counts, *errors), np.dtype(f">{dtype}")) | {"FLAG": np.dtype(">i2")}
    cubes = {name: _room(path, name, kind, shape, grid) for name, kind in kinds.items()}
    step = max(1, SLAB // (shape[0] * grid.width))
    for top in range(0, grid.height, step):
        bottom = min(top + step, grid.height)
        block = calset.intensities.block(top * grid.width, bottom * grid.width)
        planes = (shape[0], bottom - top, grid.width)
        for k in range(calset.cameras):
            cubes[counts[k]][:, top:bottom] = block.counts[..., k].T.reshape(planes)
            cubes[errors[k]][:, top:bottom] = block.sigma[..., k].T.reshape(planes)
        cubes["FLAG"][:, top:bottom] = np.where(block.used.T, 0, DataFlag.BAD_PIXEL).reshape(planes)
    for cube in cubes.values():
        cube.flush()
    with fits.open(path, mode="update") as hdus:
        for name in kinds:
            hdus[name].add_checksum()


def _room(path: Path, name: str, kind: np.dtype, shape: tuple[int, int, int], grid: Grid) -> np.memmap:
    """Header and room of an image at the end of a file, mapped."""
    header = fits.Header()
    header["XTENSION"] = "IMAGE"
    header["BITPIX"] = 16 if kind.kind == "i" else -8 * kind.itemsize
    header["NAXIS"] = 3
    for axis, length in enumerate(reversed(shape), start=1):
        header[f"NAXIS{axis}"] = length
    header["PCOUNT"], header["GCOUNT"], header["EXTNAME"] = 0, 1, name
    header.update(grid_cards(grid))
    if name != "FLAG":
        header["BUNIT"] = "electron"
    header["CHECKSUM"], header["DATASUM"] = "0" * 16, "0".rjust(10)
    text = header.tostring().encode("ascii")
    start = path.stat().st_size
    with path.open("r+b") as stream:
        stream.seek(start)
        stream.write(text)
        stream.truncate(start + len(text) + -(-int(np.prod(shape)) * kind.itemsize // 2880) * 2880)
    return np.memmap(path, kind, mode="r+", offset=start + len(text), shape=shape)

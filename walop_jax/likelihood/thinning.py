"""Parts of a large set that stand for all of it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.merge import without_frames
from walop_jax.data.records import Block, CalibrationSet, Intensities, Points
from walop_jax.likelihood import limits


class RunsOfPoints(Intensities):
    """Runs of `length` neighbouring points of a set, beginning at the points `starts`."""

    def __init__(self, whole: Intensities, starts: Int[np.ndarray, " s"], length: int) -> None:
        self.whole, self.starts, self.length = whole, starts, length

    def block(self, start: int, stop: int) -> Block:
        """Return the data of the points `start:stop` of the runs, read from the whole set."""
        blocks = []
        for number in range(start // self.length, math.ceil(stop / self.length)):
            first, origin = number * self.length, int(self.starts[number])
            low, high = max(start, first) - first, min(stop, first + self.length) - first
            blocks.append(self.whole.block(origin + low, origin + high))
        return Block.joined(blocks)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return self.whole.cameras

    @property
    def rows(self) -> int:
        """Number of used (exposure, point) pairs; reads all of them."""
        return sum(int(self.whole.block(n, n + self.length).used.sum()) for n in self.starts.tolist())


def thinned(calset: CalibrationSet, most: int, neighbours: int = limits.NEIGHBOURS) -> CalibrationSet:
    """A set of at most `most` of the points: runs of at least `neighbours` spread evenly over all of them.

    There are 16 runs or more and 128 at most, so they are shorter or longer than that in a very small or a very large
    sample. A set that is not larger than that comes back as it is. A table beside whole frames, which may hold all that
    there is of a kind of exposure, is in it with all of its points, or with half as many as there may be.
    """
    n = len(calset.points)
    if n <= most:
        return calset
    fewest, largest = limits.RUNS
    length = max(1, min(max(neighbours, most // largest), most // fewest))
    beside = without_frames(calset)
    last = 0 if beside is None else len(beside.points)
    if last <= most // 2:
        of_table = n - length * np.arange(math.ceil(last / length), 0, -1)
    else:
        of_table = n - last + _spread(last, most // 2, length)
    starts = _spread(n - last, most - length * len(of_table), length)
    starts = np.append(starts[starts + length <= min(of_table, default=n)], of_table)
    index = (starts[:, None] + np.arange(length)).ravel()
    points = Points(*(getattr(calset.points, f.name)[index] for f in dataclasses.fields(Points)))
    return dataclasses.replace(
        calset, points=points, intensities=RunsOfPoints(calset.intensities, starts, length)
    )


def _spread(points: int, most: int, length: int) -> Int[np.ndarray, " s"]:
    """The first points of runs spread evenly; multiples of the golden section are in step with no raster."""
    places = np.mod(np.arange(max(1, most // length)) * 0.6180339887498949, 1.0)
    return np.unique((places * (points // length)).astype(int)) * length


def median_counts(calset: CalibrationSet) -> Float[np.ndarray, "e k"]:
    """Median over the field of the measured counts of each camera in each exposure; 0 where nothing is used.

    Of a set with more than `limits.MEDIAN_POINTS` points, slabs spread evenly over it are enough.
    """
    n, slab, most = len(calset.points), limits.MEDIAN_SLAB, limits.MEDIAN_POINTS
    starts = range(0, n, slab) if n <= most else np.linspace(0, n - slab, most // slab).astype(int)
    counts = []
    for start in starts:
        block = calset.intensities.block(int(start), min(int(start) + slab, n))
        counts.append(np.where(block.used[:, :, None], block.counts, np.nan))
    every = np.concatenate(counts)
    seen = np.isfinite(every[..., 0]).any(axis=0)
    median = np.zeros(every.shape[1:])
    median[seen] = np.nanmedian(every[:, seen], axis=0)
    return median

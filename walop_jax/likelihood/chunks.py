"""A calibration set as the engine wants it: chunks of field points of equal size, kept in memory or read anew.

A set that fits into half of the memory it may take is turned into arrays once. A larger one is read, slab by slab, on
every pass: memory is that of a few slabs however many points there are.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.records import Block, CalibrationSet, Exposures, Intensities, Points
from walop_jax.likelihood.engine import PointData
from walop_jax.model.plan import Plan
from walop_jax.sky.moon import moon_direction, rayleigh_sky

Vector = Float[np.ndarray, " n"]

MEMORY = 2e9
"""Bytes that point data may take: half of them for a set that is kept, all of them for slabs being read."""
READING = 5
"""Bytes that reading takes for a moment, times those of the slab."""
LARGEST_SLAB = 1 << 26
"""Bytes of point data that are read together at most: larger slabs are no faster."""
SLABS = 16
"""A set is cut into so many slabs at least, if it has as many chunks: work for several threads and processes."""


def bytes_per_point(exposures: int, *, cameras: int = 4, mirrored: bool = False) -> int:
    """Size of the point data of one field point: per exposure counts and weights, sky, source and band."""
    return 8 * (2 + exposures * (2 * cameras + (4 if mirrored else 2) + 1 + 1))


class Chunks:
    """The data chunk by chunk, some chunks to a slab; the last chunk is padded with points of weight 0.

    A chunk has `size` points, a slab `slab`. `kept` says whether they stay in memory; if not, going through them reads
    the set again.
    """

    def __init__(
        self,
        calset: CalibrationSet,
        plan: Plan,
        size: int,
        *,
        mirrored: bool = False,
        memory: float | None = None,
        threads: int = 1,
    ) -> None:
        """`memory` in bytes, None for `MEMORY`; `threads` is the number of slabs that are in use at a time."""
        self.calset, self.plan, self.size, self.mirrored = calset, plan, size, mirrored
        self._points = len(calset.points)
        each = bytes_per_point(len(calset.exposures), cameras=calset.cameras, mirrored=mirrored)
        memory = MEMORY if memory is None else memory
        self.kept = 2 * each * self._points <= memory
        # Whole chunks; and many of them, as pixels are read in whole rows of the frames.
        most = min(LARGEST_SLAB, int(memory) // (READING * threads), each * self._points // SLABS)
        self.slab = size * max(1, most // (each * size))
        self.memory = 2 * each * self._points if self.kept else READING * threads * each * self.slab
        """Bytes that going through the data takes, estimated."""

    def __len__(self) -> int:
        return math.ceil(self._points / self.size)

    def __getitem__(self, index: int) -> PointData:
        first = range(len(self))[index]
        if self.kept:
            return self._in_memory[first]
        return self.read(first * self.size, (first + 1) * self.size)[0]

    def __iter__(self) -> Iterator[PointData]:
        for start in range(0, self._points, self.slab):
            yield from self.of_slab(start // self.slab)

    def of_slab(self, number: int) -> list[PointData]:
        """The chunks of a slab."""
        if self.kept:
            each = self.slab // self.size
            return self._in_memory[number * each : (number + 1) * each]
        return self.read(number * self.slab, (number + 1) * self.slab)

    @cached_property
    def _in_memory(self) -> list[PointData]:
        starts = range(0, self._points, self.slab)
        return [chunk for start in starts for chunk in self.read(start, start + self.slab)]

    def read(self, start: int, stop: int) -> list[PointData]:
        """The chunks of the points `start:stop`, read anew."""
        block = self.calset.intensities.block(start, min(stop, self._points))
        parts = (_part(block, n, n + self.size) for n in range(0, len(block.x), self.size))
        return [self.point_data(_padded(part, self.size)) for part in parts]

    def point_data(self, block: Block) -> PointData:
        """A block of measurements as the engine wants it, with what ghosts need of the opposite points."""
        band = np.take_along_axis(self.plan.band_of[None], block.source[:, :, None] + 1, axis=2)[:, :, 0]
        weight = np.where(block.used[:, :, None], 1.0 / np.where(block.sigma > 0, block.sigma, 1.0), 0.0)
        opposite = self.sky_polarisation(-block.x, -block.y) if self.mirrored else None
        return PointData(
            x=jnp.asarray(block.x),
            y=jnp.asarray(block.y),
            counts=jnp.asarray(np.where(block.used[:, :, None], block.counts, 0.0)),
            weight=jnp.asarray(weight),
            sky=jnp.asarray(self.sky_polarisation(block.x, block.y)),
            source=jnp.asarray(block.source),
            band=jnp.asarray(band),
            opposite_sky=None if opposite is None else jnp.asarray(opposite),
        )

    @cached_property
    def _moon(self) -> tuple[np.ndarray, Vector, Vector]:
        """Rows of the exposures of the Moon sky, and where the Moon stands then."""
        e: Exposures = self.calset.exposures
        rows = np.flatnonzero((e.kind == "moon") & ~e.clp_in)
        if not rows.size:
            return rows, np.zeros(0), np.zeros(0)
        ra, dec = moon_direction(e.mjd[rows], self.calset.site)
        return rows, ra, dec

    def sky_polarisation(self, x: Vector, y: Vector) -> Float[np.ndarray, "p e 2"]:
        """(q, u) in the ICS of the Moon sky for δ = 1 at field points; 0 in exposures of other kinds."""
        e: Exposures = self.calset.exposures
        sky = np.zeros((len(x), len(e), 2))
        rows, ra, dec = self._moon
        if rows.size:
            q, u = rayleigh_sky(ra, dec, e.ra[rows], e.dec[rows], e.rotator[rows], x, y)
            sky[:, rows, 0], sky[:, rows, 1] = q, u
        return sky


def _part(block: Block, start: int, stop: int) -> Block:
    return Block(
        x=block.x[start:stop], y=block.y[start:stop], counts=block.counts[start:stop],
        sigma=block.sigma[start:stop], used=block.used[start:stop], source=block.source[start:stop],
    )  # fmt: skip


def _padded(block: Block, size: int) -> Block:
    missing = size - len(block.x)
    if missing == 0:
        return block

    def pad(array: np.ndarray, value: float) -> np.ndarray:
        return np.pad(array, [(0, missing)] + [(0, 0)] * (array.ndim - 1), constant_values=value)

    # Positions of the first point: inside the field, where everything is finite.
    return Block(
        x=pad(block.x, block.x[0]), y=pad(block.y, block.y[0]),
        counts=pad(block.counts, 0.0), sigma=pad(block.sigma, 1.0),
        used=pad(block.used, False), source=pad(block.source, -1),
    )  # fmt: skip


class Runs(Intensities):
    """Runs of `run` neighbouring points of a set, beginning at the points `starts`."""

    def __init__(self, whole: Intensities, starts: Int[np.ndarray, " s"], run: int) -> None:
        self.whole, self.starts, self.run = whole, starts, run

    def block(self, start: int, stop: int) -> Block:
        """Return the data of the points `start:stop` of the runs, read from the whole set."""
        blocks = []
        for number in range(start // self.run, math.ceil(stop / self.run)):
            first, origin = number * self.run, int(self.starts[number])
            low, high = max(start, first) - first, min(stop, first + self.run) - first
            blocks.append(self.whole.block(origin + low, origin + high))
        return Block(
            *(np.concatenate([getattr(b, f.name) for b in blocks]) for f in dataclasses.fields(Block))
        )

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return self.whole.cameras

    @property
    def rows(self) -> int:
        """Number of used (exposure, point) pairs; reads all of them."""
        return sum(int(self.whole.block(n, n + self.run).used.sum()) for n in self.starts.tolist())


def thinned(calset: CalibrationSet, most: int, run: int = 256) -> CalibrationSet:
    """A set of at most `most` of the points: runs of at least `run` neighbours spread evenly over all of them.

    There are 16 runs or more and 128 at most, so they are shorter or longer than that in a very small or a very large
    sample. A set that is not larger than that comes back as it is.
    """
    n = len(calset.points)
    if n <= most:
        return calset
    run = max(1, min(max(run, most // 128), most // 16))
    # Multiples of the golden section are in step with no raster.
    places = np.mod(np.arange(max(1, most // run)) * 0.6180339887498949, 1.0)
    starts = np.unique((places * (n // run)).astype(int)) * run
    index = (starts[:, None] + np.arange(run)).ravel()
    points = Points(*(getattr(calset.points, f.name)[index] for f in dataclasses.fields(Points)))
    return dataclasses.replace(calset, points=points, intensities=Runs(calset.intensities, starts, run))


def median_counts(calset: CalibrationSet, slab: int = 4096, most: int = 65536) -> Float[np.ndarray, "e k"]:
    """Median over the field of the measured counts of each camera in each exposure; 0 where nothing is used.

    Of a set with more than `most` points, slabs spread evenly over it are enough.
    """
    n = len(calset.points)
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

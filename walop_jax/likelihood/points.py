"""The measurements of a set as the engine wants them: chunks of field points of equal size, in memory or read anew.

A set that fits into half of the memory it may take is turned into arrays once. A larger one is read, slab by slab, on
every pass: memory is that of a few slabs however many points there are.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import Block, CalibrationSet, Exposures, Site
from walop_jax.likelihood.engine import PointData
from walop_jax.likelihood.layout import Layout
from walop_jax.model.compiled import array
from walop_jax.model.plan import Plan
from walop_jax.sky.moon import moon_direction, rayleigh_sky

Vector = Float[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True, eq=False)
class PointReader:
    """Turns blocks of measurements into point data; `mirrored` with the sky at the opposite points, for ghosts.

    No error is taken to be smaller than `floor`, a share of the mean counts of its row (`Cameras.floor`).
    """

    calset: CalibrationSet
    plan: Plan
    mirrored: bool = False
    floor: float = 0.0

    def chunks(self, start: int, stop: int, size: int) -> list[PointData]:
        """The points `start:stop` in chunks of `size`, the last one padded with points of weight 0."""
        block = self.calset.intensities.block(start, min(stop, len(self.calset.points)))
        parts = (_part(block, n, n + size) for n in range(0, len(block.x), size))
        return [self.point_data(_padded(part, size)) for part in parts]

    def point_data(self, block: Block) -> PointData:
        """A block of measurements as the engine wants it."""
        band = np.take_along_axis(self.plan.band_of[None], block.source[:, :, None] + 1, axis=2)[:, :, 0]
        sigma = block.sigma
        if self.floor > 0.0:
            sigma = np.maximum(sigma, self.floor * block.counts.mean(axis=2, keepdims=True))
        weight = np.where(block.used[:, :, None], 1.0 / np.where(sigma > 0, sigma, 1.0), 0.0)
        opposite = self.sky_polarisation(-block.x, -block.y) if self.mirrored else None
        return PointData(
            x=array(block.x),
            y=array(block.y),
            counts=array(np.where(block.used[:, :, None], block.counts, 0.0)),
            weight=array(weight),
            sky=array(self.sky_polarisation(block.x, block.y)),
            source=array(block.source),
            band=array(band),
            opposite_sky=None if opposite is None else array(opposite),
        )

    @cached_property
    def _moon(self) -> tuple[np.ndarray, Vector, Vector]:
        """Rows of the exposures of the Moon sky, and where the Moon stands then."""
        e: Exposures = self.calset.exposures
        rows = np.flatnonzero((e.kind == "moon") & ~e.clp_in)
        if not rows.size:
            return rows, np.zeros(0), np.zeros(0)
        return rows, *_moon_at(tuple(e.mjd[rows].tolist()), self.calset.site)

    def sky_polarisation(self, x: Vector, y: Vector) -> Float[np.ndarray, "p e 2"]:
        """(q, u) in the ICS of the Moon sky for δ = 1 at field points; 0 in exposures of other kinds."""
        e: Exposures = self.calset.exposures
        sky = np.zeros((len(x), len(e), 2))
        rows, ra, dec = self._moon
        if rows.size:
            q, u = rayleigh_sky(ra, dec, e.ra[rows], e.dec[rows], e.rotator[rows], x, y)
            sky[:, rows, 0], sky[:, rows, 1] = q, u
        return sky


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredPoints(abc.ABC):
    """The measurements of a set, chunk by chunk as `layout` cuts it; the last chunk is padded with weight 0."""

    reader: PointReader
    layout: Layout

    @abc.abstractmethod
    def chunk(self, number: int) -> PointData:
        """One chunk, counted from 0."""

    @abc.abstractmethod
    def slab(self, number: int) -> list[PointData]:
        """The chunks of one slab, counted from 0."""

    def __len__(self) -> int:
        return self.layout.chunks

    def __iter__(self) -> Iterator[PointData]:
        for number in range(self.layout.slabs):
            yield from self.slab(number)

    def gathered(self, field: str) -> np.ndarray:
        """A field of the point data of all points in one array, without the padding: for sets that memory can hold."""
        parts = [np.asarray(getattr(chunk, field)) for chunk in self]
        return np.concatenate(parts)[: self.layout.points]


class PointsInMemory(MeasuredPoints):
    """Points that are read once and kept."""

    def chunk(self, number: int) -> PointData:
        """One chunk, counted from 0."""
        return self._all[number]

    def slab(self, number: int) -> list[PointData]:
        """The chunks of one slab, counted from 0."""
        each = self.layout.slab // self.layout.chunk
        return self._all[number * each : (number + 1) * each]

    @cached_property
    def _all(self) -> list[PointData]:
        cut = self.layout
        starts = range(0, cut.points, cut.slab)
        return [chunk for n in starts for chunk in self.reader.chunks(n, n + cut.slab, cut.chunk)]


class StreamedPoints(MeasuredPoints):
    """Points that are read anew whenever they are gone through."""

    def chunk(self, number: int) -> PointData:
        """One chunk, counted from 0."""
        size = self.layout.chunk
        return self.reader.chunks(number * size, (number + 1) * size, size)[0]

    def slab(self, number: int) -> list[PointData]:
        """The chunks of one slab, counted from 0."""
        size = self.layout.slab
        return self.reader.chunks(number * size, (number + 1) * size, self.layout.chunk)


@functools.lru_cache(maxsize=32)
def _moon_at(mjd: tuple[float, ...], site: Site) -> tuple[Vector, Vector]:
    """Where the Moon stands: the same set is brought together with many models."""
    return moon_direction(np.array(mjd), site)


def measured_points(calset: CalibrationSet, layout: Layout, floor: float = 0.0) -> MeasuredPoints:
    """The measurements of a set, kept in memory or not as its layout says."""
    reader = PointReader(calset, layout.plan, layout.mirrored, floor)
    return (PointsInMemory if layout.kept else StreamedPoints)(reader, layout)


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

"""Layout of the computation for a set under a model, and its pieces: decided once, before anything is computed.

Measurements come in batches of field points of equal size, and are turned into arrays once. Threads work on parts of
some batches each.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.records import (
    Block,
    CalibrationSet,
    FilterCurve,
    Intensities,
    Points,
    Sources,
)
from walop_jax.likelihood import limits
from walop_jax.likelihood.engine import PointData, flux_groups, star_responses
from walop_jax.likelihood.flux import project_flux
from walop_jax.likelihood.inverses import of_low_rank
from walop_jax.likelihood.noise import NoiseTerms, variance_ratio
from walop_jax.model import light
from walop_jax.model.cameras import with_noise_floor
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import array
from walop_jax.model.dependence import needs
from walop_jax.model.effects.base import Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.noise import Noise
from walop_jax.model.parameters import values_of
from walop_jax.model.plan import Plan, with_median
from walop_jax.model.planning import outgrown, plan_for, waves_followed
from walop_jax.model.specification import Model
from walop_jax.sky.moon import SkyOfExposures

THINNEST = 1e-3  # deg: shortest side of a rectangle with nodes


@dataclasses.dataclass(frozen=True, eq=False)
class Layout:
    """The plan of the exposures, and how the field points are cut.

    There are `points` field points, `batch` in a batch (one call of the engine). `interpolated` says whether the optics
    are to be solved on nodes over `rectangle` (deg) and interpolated, `large` whether a fit should do with as few
    passes as can be, `mirrored` whether the optics of the opposite points are needed too, for ghosts. `followed` are
    the waves of fringes that its wavelength nodes follow in each band of the set.
    """

    plan: Plan
    followed: tuple[tuple[float, float], ...]
    points: int
    batch: int
    interpolated: bool
    large: bool
    mirrored: bool
    rectangle: Rectangle
    sets: int = 1

    @classmethod
    def of(
        cls,
        calset: CalibrationSet,
        model: Model,
        probes: tuple[Effect, ...] = (),
        *,
        batch: int | None = None,
        interpolate: bool | None = None,
        sets: int = 1,
    ) -> Layout:
        """Lay out a set under a model; `probes` are effects beyond the model whose columns will be asked for.

        `batch` and `interpolate` are decided by the size of the set where they are None; `sets` is how many such sets
        come.
        """
        planned = planned_instrument(calset, model)
        probed = dataclasses.replace(planned, effects=(*planned.effects, *probes))
        plan = plan_for(probed, calset.exposures, calset.filters, calset.sources)
        if needs(probed).median:
            plan = with_median(plan, median_counts(calset))
        mirrored = light.has_ghosts(probed)
        points, exposures = len(calset.points), len(calset.exposures)
        plan = dataclasses.replace(plan, work=points * exposures * sets)
        interpolated = points > limits.INTERPOLATE_ABOVE if interpolate is None else interpolate
        usual = limits.LARGE_BATCH if interpolated else limits.BATCH
        batch = min(batch or usual, points)
        return cls(
            plan=plan,
            followed=waves_followed(planned, curves_of(calset)),
            points=points,
            batch=batch,
            interpolated=interpolated,
            large=interpolated and points > limits.LARGE_ABOVE,
            mirrored=mirrored,
            rectangle=_rectangle(calset, mirrored=mirrored),
            sets=sets,
        )

    @property
    def batches(self) -> int:
        """Number of batches of field points, the last one filled up."""
        return -(-self.points // self.batch)

    @property
    def part(self) -> int:
        """Field points of a part, that is of the batches that one thread works on."""
        return self.batch * max(1, self.points // (limits.PARTS * self.batch))


def planned_instrument(calset: CalibrationSet, model: Model) -> Instrument:
    """The instrument whose retarders the wavelength nodes of a plan must follow.

    Its retarders are those of the start values or of the template, whichever are thicker: after a fit that has
    thickened the plates, the template holds the fitted thicknesses.
    """
    if np.array_equal(values_of(model.template), model.start):
        return model.template
    start, curves = model.instrument(), curves_of(calset)
    return model.template if outgrown(waves_followed(start, curves), model.template, curves) else start


def curves_of(calset: CalibrationSet) -> list[FilterCurve]:
    """The filter curves that the exposures of a set use."""
    names = np.unique(calset.exposures.filter).tolist()
    return [calset.filters[name] for name in names if name in calset.filters]


def fields_of_stars(sources: Sources) -> Float[np.ndarray, "f s"]:
    """For each field of stars that scatter, a row with the rms of its stars at their rows of SOURCES, and 0 at all
    others.
    """
    firsts = np.unique(sources.stars[sources.scatter > 0])
    return np.where(sources.stars == firsts[:, None], sources.scatter, 0.0)


def _rectangle(calset: CalibrationSet, *, mirrored: bool) -> Rectangle:
    """The part of the field on which the optics are needed; with ghosts (`mirrored`) also at the opposite points."""
    xy = np.stack([calset.points.x, calset.points.y])
    low, high = xy.min(axis=1), xy.max(axis=1)
    if mirrored:
        low, high = np.minimum(low, -high), np.maximum(high, -low)
    thin = 0.5 * np.maximum(THINNEST - (high - low), 0.0)
    return Rectangle(low - thin, high + thin)


class BlocksOfPoints(Intensities):
    """A sample of a set: blocks of `length` neighbouring points, which begin at the points `starts`."""

    def __init__(self, whole: Intensities, starts: Int[np.ndarray, " s"], length: int) -> None:
        self.whole, self.starts, self.length = whole, starts, length

    def block(self, start: int, stop: int) -> Block:
        """The data of the points `start:stop` of the sample, read from the whole set."""
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
    """A set of at most `most` of the points: blocks of at least `neighbours` neighbours, spread evenly over the set.

    There are 16 blocks or more and 128 at most, so that blocks are shorter than `neighbours` in a very small sample and
    longer in a very large one. A set of at most `most` points comes back as it is.
    """
    n = len(calset.points)
    if n <= most:
        return calset
    fewest, largest = limits.BLOCKS
    length = max(1, min(max(neighbours, most // largest), most // fewest))
    starts = _spread(n, most, length)
    index = (starts[:, None] + np.arange(length)).ravel()
    points = Points(*(getattr(calset.points, f.name)[index] for f in dataclasses.fields(Points)))
    blocks = BlocksOfPoints(calset.intensities, starts, length)
    return dataclasses.replace(calset, points=points, intensities=blocks)


def _spread(points: int, sample: int, length: int) -> Int[np.ndarray, " s"]:
    """The first points of blocks spread evenly; multiples of the golden section are in step with no raster."""
    places = np.mod(np.arange(max(1, sample // length)) * 0.6180339887498949, 1.0)
    return np.unique((places * (points // length)).astype(int)) * length


def median_counts(calset: CalibrationSet) -> Float[np.ndarray, "e k"]:
    """Median over the field of the measured counts of each camera in each exposure (e, k); 0 where nothing is used.

    Of a set with more than `limits.MEDIAN_POINTS` points a sample is taken, blocks spread evenly over it.
    """
    n, run, limit = len(calset.points), limits.MEDIAN_RUN, limits.MEDIAN_POINTS
    starts = range(0, n, run) if n <= limit else np.linspace(0, n - run, limit // run).astype(int)
    counts = []
    for start in starts:
        block = calset.intensities.block(int(start), min(int(start) + run, n))
        counts.append(np.where(block.used[:, :, None], block.counts, np.nan))
    return median_over_field(np.concatenate(counts))


def median_over_field(counts: Float[np.ndarray, "p e k"]) -> Float[np.ndarray, "e k"]:
    """Median over the field of the counts of each camera in each exposure (e, k), NaN left out; 0 where all are NaN."""
    measured = np.isfinite(counts[..., 0]).any(axis=0)
    median = np.zeros(counts.shape[1:])
    median[measured] = np.nanmedian(counts[:, measured], axis=0)
    return median


# ----------------------------------------------------------------------------------------------------- the measurements


@dataclasses.dataclass(frozen=True, eq=False)
class PointReader:
    """Turns blocks of measurements into point data; `mirrored` with the sky at the opposite points, for ghosts.

    No error is smaller than the fraction `Cameras.noise_floor` of the mean counts of its row. `instrument` holds that
    fraction, and the responses of the cameras to stars of one field that differ in q, u. `noise` are terms of the
    errors at known values: the errors of the data are then those that the terms make of the stated ones; with None they
    are the stated ones.
    """

    calset: CalibrationSet
    plan: Plan
    instrument: Instrument
    mirrored: bool = False
    noise: Noise | None = None

    @cached_property
    def _sky(self) -> SkyOfExposures:
        return SkyOfExposures(self.calset.exposures, self.calset.site)

    def batches(self, start: int, stop: int, size: int) -> list[PointData]:
        """The points `start:stop` in batches of `size`, the last one filled up with its last point, of weight 0."""
        block = self.calset.intensities.block(start, min(stop, len(self.calset.points)))
        batches, last = [], len(block.x) - 1
        for first in range(0, len(block.x), size):
            rows = np.arange(first, first + size)
            data = {f.name: getattr(block, f.name)[np.minimum(rows, last)] for f in dataclasses.fields(block)}
            data["used"] &= (rows <= last)[:, None]
            batches.append(self.point_data(Block(**data)))
        return batches

    def point_data(self, block: Block) -> PointData:
        """The point data of a block of measurements, as arrays of JAX."""
        band = np.take_along_axis(self.plan.band_of[None], block.source[:, :, None] + 1, axis=2)[:, :, 0]
        sigma = with_noise_floor(block.sigma, block.counts, self.instrument.cameras.noise_floor)
        weight = np.where(block.used[:, :, None], 1.0 / np.where(sigma > 0, sigma, 1.0), 0.0)
        if self.noise is not None:
            weight = weight / np.sqrt(variance_ratio(self.noise, self.noise_terms, block.counts, weight))
        data = PointData(
            x=array(block.x),
            y=array(block.y),
            counts=array(np.where(block.used[:, :, None], block.counts, 0.0)),
            weight=array(weight),
            sky=array(self._sky.polarisation(block.x, block.y)),
            source=array(block.source),
            band=array(band),
            opposite_sky=array(self._sky.polarisation(-block.x, -block.y)) if self.mirrored else None,
        )
        fields = fields_of_stars(self.calset.sources)
        return data._replace(stars=array(self._stars(data, fields))) if len(fields) else data

    @cached_property
    def noise_terms(self) -> NoiseTerms:
        """Which intensities each term of the errors concerns; no terms where the instrument has none."""
        noise = self.instrument.noise or Noise.of()
        return NoiseTerms.of(noise, self.calset.exposures.kind.tolist(), self.instrument.cameras.names)

    def _stars(self, data: PointData, fields: Float[np.ndarray, "f s"]) -> Float[np.ndarray, "p e k c"]:
        """`FluxGroups.stars` of some points (p, e, k, c): a star is off by one q and one u in all exposures of its
        point.
        """
        share = np.asarray(star_responses(self.instrument, self.plan, array(fields), data))
        counts = np.asarray(data.counts) * np.asarray(data.weight)
        shared = flux_groups(self.instrument, self.plan)
        change = np.moveaxis(share * counts[..., None], -1, 0)
        change = project_flux(change, counts, np.asarray(self.plan.exposures.flux_known), shared)
        return of_low_rank(np.moveaxis(change, 0, -1))


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """The measurements of a set, batch by batch as `layout` cuts it; the last batch is filled up with weight 0."""

    reader: PointReader
    layout: Layout

    def part(self, number: int) -> list[PointData]:
        """The batches of one part, counted from 0."""
        batches_per_part = self.layout.part // self.layout.batch
        return self._all[number * batches_per_part : (number + 1) * batches_per_part]

    @cached_property
    def _all(self) -> list[PointData]:
        points, part = self.layout.points, self.layout.part
        starts = range(0, points, part)
        return [
            batch for start in starts for batch in self.reader.batches(start, start + part, self.layout.batch)
        ]

    def __len__(self) -> int:
        return self.layout.batches

    def __iter__(self) -> Iterator[PointData]:
        return iter(self._all)

    def gathered(self, field: str) -> np.ndarray:
        """A field of the point data of all points in one array, without the padding."""
        arrays = [np.asarray(getattr(batch, field)) for batch in self]
        return np.concatenate(arrays)[: self.layout.points]

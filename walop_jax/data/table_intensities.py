"""Intensities that stand in a table: kept in memory row by row, handed out as dense blocks."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.data.kinds import KINDS
from walop_jax.data.records import Block, DataFlag, Exposures, Intensities, Points, Sources
from walop_jax.data.units import Place
from walop_jax.io.errors import rows_text

ONE_CAMERA = [name for name, kind in KINDS.items() if kind.flux_known or kind.flux_shared]
"""KINDs of exposures for which one camera is sufficient."""
NEGATIVE = 5.0
"""Counts below minus this many sigma are no bias-subtracted counts but a fault."""

SPOILT = 0.2
"""Above this fraction of unusable rows the set is refused, not masked."""


@dataclasses.dataclass(frozen=True, eq=False)
class TableIntensities(Intensities):
    """One row per (exposure, point), in the order of the file.

    `exposures` is their number in the set; `exposure`, `point` and `source` are rows of its tables (`source` −1: none),
    `counts` and `sigma` electrons as in the file, `flag` its bits, `used` which rows take part. `sky` is the level of
    the sky that was subtracted from the counts (electrons), 0 where it is not known; None: nowhere.
    """

    exposures: int
    points: Points
    exposure: Int[np.ndarray, " r"]
    point: Int[np.ndarray, " r"]
    source: Int[np.ndarray, " r"]
    counts: Float[np.ndarray, "r k"]
    sigma: Float[np.ndarray, "r k"]
    flag: Int[np.ndarray, " r"]
    used: Bool[np.ndarray, " r"]
    sky: Float[np.ndarray, "r k"] | None = None

    def __repr__(self) -> str:
        return f"{self.rows} rows of {len(self.points)} field points and {self.exposures} exposures; see to_arrays()"

    @functools.cached_property
    def _by_point(self) -> tuple[Int[np.ndarray, " u"], Int[np.ndarray, " b"]]:
        """Used rows in the order of the points, and where each point begins among them."""
        good = np.flatnonzero(self.used)
        order = good[np.argsort(self.point[good], kind="stable")]
        return order, np.searchsorted(self.point[order], np.arange(len(self.points) + 1))

    @classmethod
    def dense(cls, points: Points, block: Block) -> TableIntensities:
        """Make a table of the used part of a block that holds all `points`, as a simulator gives it."""
        point, exposure = np.nonzero(block.used)
        return cls(
            block.used.shape[1],
            points,
            exposure=exposure,
            point=point,
            source=block.source[point, exposure],
            counts=block.counts[point, exposure],
            sigma=block.sigma[point, exposure],
            flag=np.zeros(len(point), dtype=np.int64),
            used=np.ones(len(point), dtype=bool),
        )

    @classmethod
    def of(cls, intensities: Intensities, points: Points) -> TableIntensities:
        """The intensities of all `points` as a table: as they are, or the used part of any others."""
        if isinstance(intensities, cls):
            return intensities
        return cls.dense(points, intensities.block(0, len(points)))

    def using(self, used: Bool[np.ndarray, " r"]) -> TableIntensities:
        """Return the same rows with another choice of which take part."""
        return dataclasses.replace(self, used=used)

    def flagged(self, rows: Bool[np.ndarray, " r"], flag: DataFlag) -> TableIntensities:
        """Return the same rows, of which some have a further flag and take no part."""
        flags = self.flag | np.where(rows, int(flag), 0)
        return dataclasses.replace(self, flag=flags, used=self.used & ~rows)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return self.counts.shape[1]

    @property
    def rows(self) -> int:
        """Number of used rows."""
        return len(self._by_point[0])

    def block(self, start: int, stop: int) -> Block:
        """Return the data of the field points `start:stop`, dense in the exposures."""
        start, stop, _ = slice(start, stop).indices(len(self.points))
        stop = max(start, stop)
        order, bounds = self._by_point
        rows = order[bounds[start] : bounds[stop]]
        x, y = self.points.x[start:stop], self.points.y[start:stop]
        block = empty_block(x, y, self.exposures, self.cameras)
        at = (self.point[rows] - start, self.exposure[rows])
        for name in ("counts", "sigma", "used", "source"):
            getattr(block, name)[at] = getattr(self, name)[rows]
        return block


def empty_block(
    x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"], exposures: int, cameras: int
) -> Block:
    """Return a block without any measurement: counts 0, sigma 1, nothing used. `x`, `y` in degrees."""
    shape = (len(x), exposures)
    return Block(
        x=x,
        y=y,
        counts=np.zeros((*shape, cameras)),
        sigma=np.ones((*shape, cameras)),
        used=np.zeros(shape, dtype=bool),
        source=np.full(shape, -1, dtype=np.int64),
    )


def usable(
    counts: Float[np.ndarray, "*r k"], sigma: Float[np.ndarray, "*r k"], flag: Int[np.ndarray, "*r"]
) -> tuple[Bool[np.ndarray, "*r"], Bool[np.ndarray, "*r"], Bool[np.ndarray, "*r"]]:
    """Sort measurements (electrons) into used, spoilt and impossible ones; flagged ones are none of these.

    Spoilt: not finite, or more negative than noise explains. Impossible: an error that is zero or negative.
    """
    open_ = flag == 0
    with np.errstate(invalid="ignore"):
        impossible = open_ & np.any(np.isfinite(sigma) & (sigma <= 0), axis=-1)
        good = np.all(np.isfinite(counts) & np.isfinite(sigma) & (counts >= -NEGATIVE * sigma), axis=-1)
    return open_ & good & ~impossible, open_ & ~good & ~impossible, impossible


def table_intensities(
    table: dict[str, Any], exposures: Exposures, points: Points, sources: Sources, place: Place
) -> tuple[TableIntensities, list[str]]:
    """Check the rows of an INTENSITIES table against the other tables; return them and remarks.

    Raises `DataError` for identifiers that do not exist, repeated (EXPOSURE, POINT) pairs, errors that are
    not positive, too many spoilt rows, nothing used, counts that are all equal, a single camera
    that sees light of unknown flux only, another number of errors than of counts, and a sky below 0.
    """
    _cameras(table["N"], table["N_ERR"], exposures, place)
    exposure = _rows_of(table["EXPOSURE"], exposures.exposure, "EXPOSURE", "EXPOSURES", place)
    point = _rows_of(table["POINT"], points.point, "POINT", "POINTS", place)
    pair = exposure * len(points) + point
    _, inverse, number = np.unique(pair, return_inverse=True, return_counts=True)
    if np.any(twice := number[inverse] > 1):
        first = np.flatnonzero(pair == pair[np.argmax(twice)])
        ids = ", ".join(f"{name} {table[name][first[0]]}" for name in ("EXPOSURE", "POINT"))
        advice = f"keep one row of each pair ({int(twice.sum())} rows are concerned)"
        raise place.fail(f"{ids} is there twice, in {rows_text(first)}", "EXPOSURE, POINT", advice)
    counts, sigma, flag = table["N"], table["N_ERR"], table["FLAG"]
    used, spoilt, impossible = usable(counts, sigma, flag)
    place.refuse(impossible, "is zero or negative", "N_ERR", "give the true error, or set FLAG")
    remarks = _judge(counts, used, spoilt, place)
    source, unlisted = _source_rows(table["SOURCE"], exposures, exposure, sources, used, place)
    sky = _sky(table, place)
    rows = (exposure, point, source, counts, sigma, flag, used, sky)
    return TableIntensities(len(exposures), points, *rows), remarks + unlisted


def _cameras(counts: np.ndarray, sigma: np.ndarray, exposures: Exposures, place: Place) -> None:
    number, errors = counts.shape[1], sigma.shape[1]
    if number < 2 and not np.isin(exposures.kind, ONE_CAMERA).any():
        advice = f"one row holds all cameras, two at least where KIND is not {' or '.join(ONE_CAMERA)}"
        raise place.fail(f"has {number} value in a row", "N", advice)
    if errors != number:
        what = f"has {errors} value(s) in a row, N has {number}"
        raise place.fail(what, "N_ERR", "give the error of every camera")


def _sky(table: dict[str, Any], place: Place) -> Float[np.ndarray, "r k"] | None:
    """The level of the sky, 0 where it is not known; None without it."""
    if "SKY" not in table:
        return None
    sky = np.where(np.isnan(table["SKY"]), 0.0, table["SKY"])
    if sky.shape != table["N"].shape:
        raise place.fail(f"has {sky.shape[1]} value(s) in a row", "SKY", "give the sky of every camera, as N")
    advice = "the level that was subtracted, or NaN"
    place.refuse((sky < 0) | np.isinf(sky), "is below 0 or infinite", "SKY", advice)
    return sky


def _judge(counts: np.ndarray, used: np.ndarray, spoilt: np.ndarray, place: Place) -> list[str]:
    """Refuse data that cannot be measurements; remark on masked rows."""
    bad = np.flatnonzero(spoilt)
    if len(bad) > SPOILT * len(spoilt):
        cameras = [f"N[{k}]" for k in range(counts.shape[1]) if not np.any(np.isfinite(counts[:, k]))]
        empty = f", no data at all in {', '.join(cameras)}" if cameras else ""
        what = f"{100 * len(bad) / len(spoilt):.0f} % of the rows are not finite or far below zero"
        advice = "repair the reduction, or set FLAG where it fails"
        raise place.fail(f"{what} ({rows_text(bad)}){empty}", "N, N_ERR", advice)
    if not np.any(used):
        raise place.fail("no row can be used: all are flagged or spoilt", "FLAG", "look at the reduction")
    values = counts[used]
    if np.count_nonzero(used) > 1 and np.all(values == values[0, 0]):
        raise place.fail(f"all counts are equal ({values[0, 0]:g})", "N", "these are not measurements")
    remarks = []
    if len(bad):
        what = f"not finite or below −5 sigma in {rows_text(bad)}, not used"
        remarks.append(place.remark(what, "N, N_ERR"))
    if flagged := len(used) - np.count_nonzero(used) - len(bad):
        remarks.append(place.remark(f"set in {flagged} of {len(used)} rows, not used", "FLAG"))
    return remarks


def _positions(ids: np.ndarray, known: np.ndarray) -> Int[np.ndarray, " r"]:
    """Positions of identifiers among those known, −1 where they are not there."""
    if not len(known):
        return np.full(len(ids), -1)
    order = np.argsort(known, kind="stable")
    at = order[np.minimum(np.searchsorted(known[order], ids), len(known) - 1)]
    return np.where(known[at] == ids, at, -1)


def _rows_of(ids: np.ndarray, known: np.ndarray, column: str, table: str, place: Place) -> np.ndarray:
    """Turn identifiers into rows of the table that defines them."""
    rows = _positions(ids, known)
    if np.any(absent := rows < 0):
        first = ids[np.argmax(absent)]
        near = known[np.argmin(np.abs(known - first))]
        what = f"{column} {first} does not exist in {table}, asked for"
        place.refuse(absent, what, column, f"the nearest is {near}; add it there or correct it here")
    return rows


def _source_rows(
    ids: np.ndarray,
    exposures: Exposures,
    exposure: np.ndarray,
    sources: Sources,
    used: np.ndarray,
    place: Place,
) -> tuple[np.ndarray, list[str]]:
    """Turn SOURCE into rows of SOURCES; a standard needs one, any other source may be unlisted."""
    rows = np.where(ids >= 0, _positions(ids, sources.source), -1)
    standard = exposures.direct("standard")[exposure] & used
    if np.any(bad := standard & (rows < 0)):
        listed = ", ".join(str(entry) for entry in sources.source[:10]) or "none"
        what = f"a standard star needs a row of SOURCES; {ids[np.argmax(bad)]} is not one,"
        place.refuse(bad, what, "SOURCE", f"SOURCES has {listed}")
    lamp_kinds = [name for name, kind in KINDS.items() if not kind.from_sky and not kind.flux_known]
    lamp = np.isin(exposures.kind, lamp_kinds)[exposure] & used & (ids >= 0)
    place.refuse(lamp, "a lamp is no source of the sky,", "SOURCE", "write −1, or another KIND")
    lost = np.flatnonzero(used & (ids >= 0) & (rows < 0))
    remark = place.remark(f"not in SOURCES, taken as unknown in {rows_text(lost)}", "SOURCE")
    return rows, [remark] if len(lost) else []

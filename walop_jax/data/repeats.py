"""Measurements that are there twice: exposures and field points of a set, rows of a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int

from walop_jax.data.records import Exposures, Intensities, Points, sampled
from walop_jax.data.units import Place
from walop_jax.io.text import some

if TYPE_CHECKING:
    from walop_jax.data.table_intensities import TableIntensities

_LOOKED_AT = 4096  # field points whose counts are compared


def mask_repeats(
    intensities: TableIntensities, exposures: Exposures, file: object
) -> tuple[TableIntensities, list[str]]:
    """Find exposures that are copies of an earlier one and stop using them, so that errors do not shrink; say which.

    A copy has the same time, settings, points and counts to the last bit. Other counts of the same points at the same
    time and settings are an error where most times differ (raises `DataError` that names `file`); where times are too
    coarse to tell, there is a remark.
    """
    settings = [values for name, values in exposures.columns().items() if name != "EXPOSURE"]
    groups: dict[tuple[str, ...], list[int]] = {}
    for row in np.flatnonzero(np.isfinite(exposures.mjd)):
        groups.setdefault(tuple(str(values[row]) for values in settings), []).append(int(row))
    times = exposures.mjd[np.isfinite(exposures.mjd)]
    fine = 2 * len(np.unique(times)) > len(times)
    point, used = intensities.point, intensities.used.copy()

    def rows_of(exposure: int) -> Int[np.ndarray, " r"]:
        rows = np.flatnonzero(intensities.exposure == exposure)
        return rows[np.argsort(point[rows])]

    remarks: list[str] = []
    alike: list[str] = []
    differ = "have the same time and settings but different counts"
    for first, *repeats in groups.values():
        rows = rows_of(first)
        for repeat in repeats:
            ids = f"exposures {exposures.exposure[first]} and {exposures.exposure[repeat]}"
            again = rows_of(repeat)
            pairs = ((values[rows], values[again]) for values in (point, intensities.counts))
            if len(rows) and all(np.array_equal(*pair, equal_nan=True) for pair in pairs):
                remarks.append(f"{ids} are the same to the last bit, the second is not used")
                used[again] = False
            elif fine and np.isin(point[rows[used[rows]]], point[again[used[again]]]).any():
                what = f"{ids} (rows {first} and {repeat}, counted from 0) {differ}"
                advice = "no camera takes two exposures at once: correct the times, or write NaN"
                raise Place(file, "EXPOSURES").fail(what, "MJD", advice)
            else:
                alike.append(ids)
    if alike:
        suffix = f" (and {len(alike) - 1} pairs more)" if len(alike) > 1 else ""
        remarks.append(f"{alike[0]} {differ}{suffix}")
    return intensities.using(used), remarks


def repeated_counts(
    intensities: Intensities,
    exposures: Exposures,
    points: Points,
    file: object,
) -> Iterator[str]:
    """Remark on exposures, or field points, most of whose rows have the counts of another row at the same place.

    Counts agree where they do in single precision, whatever times and identifiers they have. Noise does not repeat in
    all cameras; expected counts without noise may. Exposures of known flux, which may be exact, are left out.
    Of large sets a sample of the points is looked at.
    """
    counted = ~exposures.flux_known
    if not counted.any():
        return
    places, block = sampled(intensities, len(points), _LOOKED_AT)
    at, exposure = np.nonzero(block.used & counted)
    same = equal_rows([block.x[at], block.y[at], *block.counts[at, exposure].T])
    order = np.lexsort((at, exposure, same))  # copies behind their originals
    again = np.zeros(len(at), bool)
    again[order[1:]] = same[order[1:]] == same[order[:-1]]
    for name, ids, row in (("exposures", exposures.exposure, exposure), ("points", points.point[places], at)):
        copies = np.flatnonzero(2 * np.bincount(row, again) > np.bincount(row))
        if len(copies):
            what = f"{name} {some(ids[copies].astype(str).tolist(), 5)} have the counts of others at the same places"
            advice = "remove them if they are copies, which make errors too small"
            yield f"{file} [INTENSITIES] N: {what}; {advice}"
            return


def equal_rows(columns: Sequence[np.ndarray]) -> Int[np.ndarray, " n"]:
    """Number of the group of equal rows of columns, floats in single precision, that every row is in."""
    mixed = np.full(len(columns[0]), 0x9E3779B97F4A7C15, np.uint64)
    for column in columns:  # a hash of 64 bits: of a million rows two collide in one of 10⁷ tables
        words = column
        if column.dtype.kind == "f":
            single = column.astype(np.float32) + np.float32(0.0)  # −0 is 0
            words = np.where(np.isnan(column), np.float32(np.nan), single).view(np.uint32)
        words = words.astype(np.uint64)
        mixed = (mixed ^ words) * np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(29)
    return np.unique(mixed, return_inverse=True)[1].reshape(-1)

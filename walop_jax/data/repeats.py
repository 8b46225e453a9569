"""Measurements that are there twice: recognised by their noise, whatever times, identifiers or coordinates they bear.

Two measurements of the same light differ by their noise. With errors σ each, a count and its repetition agree within
ε σ with probability at most ε/√π (the density of a normal distribution of variance 2 at zero, times 2 ε); with ε = 0.01
all four cameras of a row agree by chance once in 10⁹ rows. Counts that are whole numbers agree exactly with
probability 1/(2 √π σ). For two exposures that share n places of which a agree, the logarithm of the probability of
chance is at most the sum of those of the agreeing values plus ln C(n, a) (union over which they are); below −30, once
in 10¹³ pairs of exposures, they are one measurement.

Expected counts without noise agree too, as often as their settings do. They are told apart by rank: over exposures at
different angles light makes a smooth function of few terms, noise has as many as there are exposures. The smallest
singular value of the fractions of light in the cameras, in units of their errors, is 1 − √(exposures/values) ≥ 0.29 or
more with noise (Marchenko & Pastur 1967), and that of the series in cos 2θ, sin 2θ without.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter

import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.records import Block, Exposures, Intensities, Points
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.io.errors import fail, rows_text

_CLOSE = 0.01  # standard errors within which two counts agree
_CHANCE = -30.0  # natural logarithm
_SAME_PLACE = 2e-5  # degrees: beyond what single precision loses, below any pixel
_MOST_ROWS = 400_000
_NOISE = 0.05  # smallest singular value, in errors
_FEWEST, _MOST = 12, 64  # exposures that noise is looked for in
_PIXELS, _RUN = 256, 64  # of frames, in evenly spaced runs


@dataclasses.dataclass(frozen=True)
class _Rows:
    """Measurements: row of EXPOSURES and of POINTS, place on the sky (an index), counts and errors."""

    exposure: Int[np.ndarray, " r"]
    point: Int[np.ndarray, " r"]
    place: Int[np.ndarray, " r"]
    counts: Float[np.ndarray, "r k"]
    sigma: Float[np.ndarray, "r k"]


def check_repeats(
    intensities: Intensities, exposures: Exposures, points: Points, file: object
) -> tuple[str, ...]:
    """Refuse measurements that are there twice: exposures, or field points at one place, with the same noise.

    Of frames a sample of the pixels is looked at. Where too few exposures say whether there is any noise, copies with
    equal settings are only remarked on. Exposures of KIND flux, which may be exact, are left out. Raises `DataError`
    with identifiers and rows of what is there twice; returns remarks.
    """
    rows = _rows_of(intensities, exposures, points)
    pairs = _agreeing(rows)
    if not pairs:
        return ()
    copies = {second for first, second in pairs if first != second}
    noise = _holds_noise(rows, exposures, copies)
    if noise is False:
        return ()
    texts = [_sentence(rows, pair, exposures, points) for pair in pairs]
    if noise:
        more = f", and {len(texts) - 1} pairs more" if len(texts) > 1 else ""
        raise fail(
            f"{texts[0]}{more}: independent measurements never agree within {_CLOSE} σ",
            file=file,
            extension="INTENSITIES",
            advice="remove one of them: repeated data would shrink the errors",
        )
    alike = [
        text for text, (a, b) in zip(texts, pairs, strict=True) if a == b or _same_settings(exposures, a, b)
    ]
    more = f" (and {len(alike) - 1} pairs more)" if len(alike) > 1 else ""
    return (f"{alike[0]}{more}; remove one if they are copies",) if alike else ()


def _rows_of(intensities: Intensities, exposures: Exposures, points: Points) -> _Rows:
    """The used measurements, or those at a sample of the places."""
    counted = exposures.kind != "flux"
    if isinstance(intensities, TableIntensities):
        table, places = intensities, _places(points.x, points.y)
        step = 1 + len(table.used) // _MOST_ROWS
        kept = np.flatnonzero(table.used & counted[table.exposure] & (places[table.point] % step == 0))
        exposure, point = table.exposure[kept], table.point[kept]
        return _Rows(exposure, point, places[point], table.counts[kept], table.sigma[kept])
    total = len(points)
    starts = np.unique(np.linspace(0, max(total - _RUN, 0), _PIXELS // _RUN).astype(int))
    parts = []
    for start in starts.tolist():
        block: Block = intensities.block(start, min(start + _RUN, total))
        point, exposure = np.nonzero(block.used & counted)
        parts.append((exposure, point + start, block.counts[point, exposure], block.sigma[point, exposure]))
    exposure, point, counts, sigma = (np.concatenate(part) for part in zip(*parts, strict=True))
    seen, row = np.unique(point, return_inverse=True)
    return _Rows(exposure, point, _places(points.x[seen], points.y[seen])[row], counts, sigma)


def _places(x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> Int[np.ndarray, " p"]:
    """The same number for points at the same place: they share a cell of one of two grids, half a cell apart."""
    labels = np.arange(len(x))
    for shift in (0.0, 0.5):
        cells = np.floor(np.column_stack([x, y]) / (2 * _SAME_PLACE) + shift)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        lowest = np.full(cell.max(initial=-1) + 1, len(x))
        np.minimum.at(lowest, cell.ravel(), labels)
        labels = lowest[cell.ravel()]
    return labels


def _agreeing(rows: _Rows) -> list[tuple[int, int]]:
    """Pairs of exposures (of one with itself: of points at one place) that agree better than chance allows."""
    order = np.lexsort((rows.counts[:, 0], rows.place))
    one, other = order[:-1], order[1:]
    near = np.abs(rows.counts[one] - rows.counts[other]) <= _CLOSE * np.minimum(
        rows.sigma[one], rows.sigma[other]
    )
    good = near.all(axis=1) & (rows.place[one] == rows.place[other])
    if not np.any(good):
        return []
    one, other = one[good], other[good]
    whole = bool(np.all(rows.counts == np.round(rows.counts)))
    chance = np.maximum(_CLOSE, float(whole) * 0.5 / rows.sigma[one]) / math.sqrt(math.pi)
    logarithm = np.minimum(np.log(chance), 0.0).sum(axis=1)
    found: Counter[tuple[int, int]] = Counter()
    total: Counter[tuple[int, int]] = Counter()
    ends = np.sort(np.column_stack([rows.exposure[one], rows.exposure[other]]), axis=1)
    for (first, second), value in zip(ends.tolist(), logarithm.tolist(), strict=True):
        found[first, second] += 1
        total[first, second] += value
    sizes = np.bincount(rows.exposure)
    pairs = []
    for (first, second), number in found.items():
        n = max(int(min(sizes[first], sizes[second])), number)
        ways = math.lgamma(n + 1) - math.lgamma(number + 1) - math.lgamma(n - number + 1)
        if total[first, second] + ways < _CHANCE:
            pairs.append((first, second))
    return sorted(pairs)


def _holds_noise(rows: _Rows, exposures: Exposures, copies: set[int]) -> bool | None:
    """Whether counts scatter at all, None where that cannot be seen, in the largest group of alike exposures."""
    labels = [
        (str(kind), str(name), bool(polariser), bool(plate))
        for kind, name, polariser, plate in zip(
            exposures.kind, exposures.filter, exposures.clp_in, exposures.chwp_in, strict=True
        )
    ]
    numbers = Counter(labels[n] for n in np.unique(rows.exposure).tolist() if n not in copies)
    for label, number in numbers.most_common(3):
        if number < _FEWEST:
            break
        group = [n for n, own in enumerate(labels) if own == label and n not in copies]
        smallest = _smallest_singular_value(rows, np.array(group))
        if smallest is not None:
            return smallest > _NOISE
    return None


def _smallest_singular_value(rows: _Rows, group: Int[np.ndarray, " e"]) -> float | None:
    """Of the fractions of light in the cameras, less their means, in errors; None where there are too few."""
    cameras = rows.counts.shape[1]
    inside = np.isin(rows.exposure, group)
    measured = Counter(rows.point[inside].tolist())
    full = [point for point, number in measured.items() if number == len(group)][: 4 * _MOST]
    size = min(_MOST, len(group), len(full) * (cameras - 1) // 2)
    if size < _FEWEST:
        return None
    group = group[np.linspace(0, len(group) - 1, size).astype(int)]
    kept = np.flatnonzero(np.isin(rows.exposure, group) & np.isin(rows.point, full))
    kept = kept[np.lexsort((rows.point[kept], rows.exposure[kept]))]
    light = rows.counts[kept].sum(axis=1, keepdims=True)
    fractions = (rows.counts[kept] / light).reshape(size, -1)
    error = np.median(rows.sigma[kept] / light)
    values = np.linalg.svd(fractions - fractions.mean(axis=0), compute_uv=False)
    return float(values[size - 2] / (error * math.sqrt(len(full) * (cameras - 1))))


def _same_settings(exposures: Exposures, one: int, other: int) -> bool:
    """Whether two exposures differ in nothing but number and time."""
    return all(
        str(values[one]) == str(values[other])
        for name, values in exposures.columns().items()
        if name not in ("EXPOSURE", "MJD", "EXPTIME")
    )


def _sentence(rows: _Rows, pair: tuple[int, int], exposures: Exposures, points: Points) -> str:
    first, second = pair
    if first != second:
        ids = f"exposures {exposures.exposure[first]} and {exposures.exposure[second]}"
        return f"{ids} ({rows_text(pair)} of EXPOSURES) hold the same noise"
    here = np.flatnonzero(rows.exposure == first)
    places, number = np.unique(rows.place[here], return_counts=True)
    twice = np.unique(rows.point[here][np.isin(rows.place[here], places[number > 1][:1])])
    ids = ", ".join(str(points.point[row]) for row in twice[:5])
    return f"points {ids} ({rows_text(twice)} of POINTS) lie at one place and hold the same noise"

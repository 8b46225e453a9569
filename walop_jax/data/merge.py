"""Several calibration sets become one: exposures side by side, equal points and sources once.

Measurements that are there twice are recognised by their noise, whatever times, identifiers or coordinates they bear.

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
from jaxtyping import Bool, Float, Int

from walop_jax.data.frames import FrameIntensities, Grid
from walop_jax.data.records import (
    Block,
    CalibrationSet,
    Compression,
    Exposures,
    FilterCurve,
    Intensities,
    Points,
    Position,
    Sources,
)
from walop_jax.data.schema import Place
from walop_jax.data.table_intensities import TableIntensities, empty_block, mask_repeats
from walop_jax.io.errors import DataError, fail, rows_text

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
    intensities: Intensities,
    exposures: Exposures,
    points: Points,
    file: object,
    compression: Compression | None = None,
) -> tuple[str, ...]:
    """Refuse measurements that are there twice: exposures, or field points at one place, with the same noise.

    Of frames a sample of the pixels is looked at. Where too few exposures say whether there is any noise, copies with
    equal settings are only remarked on. Exposures of KIND flux, which may be exact, are left out, and those of which
    pixels were summed (`compression`). Raises `DataError` with identifiers and rows of what is there twice; returns
    remarks.
    """
    counted = ~exposures.flux_known
    if compression is not None:
        counted &= ~compression.covers(exposures)
    if not counted.any():
        return ()
    rows = _rows_of(intensities, counted, points)
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
        what = f"{texts[0]}{more}: independent measurements never agree within {_CLOSE} σ"
        advice = "remove one of them: repeated data would shrink the errors"
        raise Place(file, "INTENSITIES").fail(what, advice=advice)
    alike = [
        text for text, (a, b) in zip(texts, pairs, strict=True) if a == b or _same_settings(exposures, a, b)
    ]
    more = f" (and {len(alike) - 1} pairs more)" if len(alike) > 1 else ""
    return (f"{alike[0]}{more}; remove one if they are copies",) if alike else ()


def _rows_of(intensities: Intensities, counted: Bool[np.ndarray, " e"], points: Points) -> _Rows:
    """The used measurements in some exposures, or those at a sample of the places."""
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
    """True if counts scatter at all in the largest group of alike exposures, None where that cannot be seen."""
    labels = [
        (str(kind), str(name), bool(polariser), bool(plate))
        for kind, name, polariser, plate in zip(
            exposures.kind, exposures.filter, exposures.clp_in, exposures.position("CHWP").inside, strict=True
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
    """True if two exposures differ in nothing but number and time."""
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


# --------------------------------------------------------------------------------------------------------- several sets


@dataclasses.dataclass(frozen=True, eq=False)
class JoinedIntensities(Intensities):
    """Parts with field points of their own, one after the other: frames, and a table beside them.

    A part is its intensities, its field points, and the rows that its exposures have in the whole.
    """

    parts: tuple[tuple[Intensities, Points, np.ndarray], ...]
    exposures: int

    @property
    def cameras(self) -> int:
        """Number of cameras, that of every part."""
        return self.parts[0][0].cameras

    @property
    def rows(self) -> int:
        """Number of used rows of all parts."""
        return sum(part.rows for part, _, _ in self.parts)

    def block(self, start: int, stop: int) -> Block:
        """Return the data of the field points `start:stop`, dense in the exposures."""
        total = sum(len(points) for _, points, _ in self.parts)
        start, stop, _ = slice(start, stop).indices(total)
        pieces, first = [], 0
        for part, points, exposures in self.parts:
            low, high = max(start - first, 0), min(stop - first, len(points))
            first += len(points)
            if low < high:
                piece = part.block(low, high)
                whole = empty_block(piece.x, piece.y, self.exposures, self.cameras)
                for name in ("counts", "sigma", "used", "source"):
                    getattr(whole, name)[:, exposures] = getattr(piece, name)
                pieces.append(whole)
        if not pieces:
            return empty_block(np.zeros(0), np.zeros(0), self.exposures, self.cameras)
        return Block.joined(pieces)


def parts_of(calset: CalibrationSet) -> tuple[tuple[Intensities, Points, Int[np.ndarray, " r"]], ...]:
    """The parts of a set with field points of their own (`JoinedIntensities`), one where it has no others."""
    whole = calset.intensities
    if isinstance(whole, JoinedIntensities):
        return whole.parts
    return ((whole, calset.points, np.arange(len(calset.exposures))),)


def frames_among(calset: CalibrationSet) -> tuple[FrameIntensities, Int[np.ndarray, " r"]] | None:
    """The frames of a set and the exposures (positions) that they hold; None where there are none, or on two grids."""
    parts = parts_of(calset)
    found = [(part, exposures) for part, _, exposures in parts if isinstance(part, FrameIntensities)]
    return found[0] if len(found) == 1 else None


def without_frames(calset: CalibrationSet) -> CalibrationSet | None:
    """Part of a set beside its frames, with the exposures of all of it; None with no frames or nothing else."""
    parts = parts_of(calset)
    beside = tuple(part for part in parts if not isinstance(part[0], FrameIntensities))
    if len(beside) in (0, len(parts)):
        return None
    points = _stack_points([points for _, points, _ in beside])
    intensities = JoinedIntensities(beside, len(calset.exposures))
    return dataclasses.replace(calset, points=points, intensities=intensities)


def merge_calibration_sets(*sets: CalibrationSet) -> CalibrationSet:
    """Join calibration sets of one instrument at one site.

    Exposure and point identifiers that collide are renumbered (and this is remarked on); points of tables
    with identical coordinates become one, sources with the same name and values likewise. Frames on the same
    grid share their pixels; frames and tables keep field points of their own. A moving element that a set does
    not have is out there. The record of a set that stands for pixels goes with its exposures.

    Raises `DataError` for different instruments, numbers of cameras or sites, for a filter or source that has
    one name and two meanings, and for a set that stands for pixels beside another one, or beside frames.
    """
    first = sets[0]
    for other in sets[1:]:
        _refuse_another_instrument(first, other)
    exposures, remarks = _join_exposures(sets)
    compression = _joined_record(sets, exposures)
    sources, source_rows = _join_sources(sets)
    parts = _parts(sets, source_rows)
    names = ", ".join(str(entry_input.path) for entry in sets for entry_input in entry.inputs)
    if len(parts) == 1:  # a whole of tables alone, or of frames alone, needs no joint
        intensities, points = parts[0][:2]
        if isinstance(intensities, TableIntensities):
            intensities, repeated = mask_repeats(intensities, exposures, names)
            remarks += repeated
    else:
        intensities = JoinedIntensities(tuple(parts), len(exposures))
        points = _stack_points([part[1] for part in parts])
    remarks += check_repeats(intensities, exposures, points, names, compression)
    return CalibrationSet(
        instrument=first.instrument,
        site=first.site,
        origin="; ".join(dict.fromkeys(entry.origin for entry in sets if entry.origin)),
        exposures=exposures,
        points=points,
        sources=sources,
        filters=_join_filters(sets),
        intensities=intensities,
        inputs=tuple(entry_input for entry in sets for entry_input in entry.inputs),
        remarks=tuple(dict.fromkeys([remark for entry in sets for remark in entry.remarks] + remarks)),
        compression=compression,
    )


def _joined_record(sets: tuple[CalibrationSet, ...], exposures: Exposures) -> Compression | None:
    """The record of the one set that stands for pixels, with its exposures as they are numbered now."""
    first = 0
    record: Compression | None = None
    for entry in sets:
        here, first = slice(first, first + len(entry.exposures)), first + len(entry.exposures)
        if entry.compression is None:
            continue
        others = [one for one in sets if one is not entry]
        if any(one.compression is not None or frames_among(one) for one in others):
            what = "stands for pixels that were summed at one set of values; so do other sets here, or there are frames"
            raise _conflict(
                what, entry, "", "compress the frames of all together: walop-jax compress A.fits B.fits"
            )
        numbers = exposures.exposure[here][entry.compression.covers(entry.exposures)]
        record = dataclasses.replace(
            entry.compression, exposures=tuple(numbers.tolist()) if others else entry.compression.exposures
        )
    return record


def _refuse_another_instrument(first: CalibrationSet, other: CalibrationSet) -> None:
    if other.instrument != first.instrument:
        raise _conflict(f"is {other.instrument}, {_name(first)} is {first.instrument}", other, "INSTRUME")
    if other.cameras != first.cameras:
        what = f"has {other.cameras} cameras, {_name(first)} has {first.cameras}"
        raise _conflict(what, other, "N", "these are not sets of one instrument")
    # To a thousandth of a degree, and ten metres.
    one, two = ([site.latitude, site.longitude, site.elevation] for site in (first.site, other.site))
    if not np.isclose(one, two, rtol=0, atol=[1e-3, 1e-3, 10.0], equal_nan=True).all():
        what = f"is another site than that of {_name(first)}"
        raise _conflict(what, other, "SITELAT, SITELONG, SITEELEV")


def _parts(
    sets: tuple[CalibrationSet, ...], source_rows: list[np.ndarray]
) -> list[tuple[Intensities, Points, np.ndarray]]:
    """Intensities with their field points and rows of the joined exposures: frames of every grid, then all tables."""
    ends = np.cumsum([len(entry.exposures) for entry in sets])
    rows = np.split(np.arange(ends[-1]), ends[:-1])
    grids: dict[Grid, list[int]] = {}
    tables: list[int] = []
    for number, entry in enumerate(sets):
        if isinstance(entry.intensities, FrameIntensities):
            grids.setdefault(entry.intensities.grid, []).append(number)
        elif isinstance(entry.intensities, TableIntensities):
            tables.append(number)
        else:
            raise _conflict("has been merged before", entry, "", "merge all files at once")
    parts: list[tuple[Intensities, Points, np.ndarray]] = []
    for grid, members in grids.items():
        frames = [sets[n].intensities for n in members]
        stacks = tuple(s for entry in frames if isinstance(entry, FrameIntensities) for s in entry.stacks)
        parts.append(
            (FrameIntensities(grid, stacks), grid.points, np.concatenate([rows[n] for n in members]))
        )
    if tables:
        table, points = _join_tables([sets[n] for n in tables], [source_rows[n] for n in tables])
        parts.append((table, points, np.concatenate([rows[n] for n in tables])))
    return parts


def _name(calset: CalibrationSet) -> str:
    return ", ".join(str(entry.path) for entry in calset.inputs) or "a set in memory"


def _conflict(
    what: str, calset: CalibrationSet, column: str, advice: str = "merge only what fits"
) -> DataError:
    return fail(what, file=_name(calset), column=column, advice=advice)


def _join_exposures(sets: tuple[CalibrationSet, ...]) -> tuple[Exposures, list[str]]:
    remarks, ids = [], np.zeros(0, dtype=np.int64)
    for entry in sets:
        new = entry.exposures.exposure
        if np.any(np.isin(new, ids)):
            shift = int(ids.max() + 1 - new.min())
            remarks.append(f"{_name(entry)} [EXPOSURES] EXPOSURE: taken in another file, raised by {shift}")
            new = new + shift
        ids = np.concatenate([ids, new])
    prefixes = list(dict.fromkeys(prefix for entry in sets for prefix in entry.exposures.positions))
    parts = []
    for entry in sets:
        e = entry.exposures
        absent = {prefix: Position.out(len(e)) for prefix in prefixes if prefix not in e.positions}
        if absent:
            names = ", ".join(f"{prefix}_ANGLE" for prefix in absent)
            remarks.append(f"{_name(entry)} [EXPOSURES] {names}: column missing; taken as out of the beam")
        parts.append(e.placed(**absent).columns())
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Exposures.from_columns(columns | {"EXPOSURE": ids}), remarks


def _join_sources(sets: tuple[CalibrationSet, ...]) -> tuple[Sources, list[np.ndarray]]:
    """Join the sources; return with them the row that each old row has become."""
    fields = [field.name for field in dataclasses.fields(Sources)]
    columns = {name: np.concatenate([getattr(entry.sources, name) for entry in sets]) for name in fields}
    values = [columns[name] for name in ("q", "u", "q_err", "u_err", "teff")]
    row_of: dict[str, int] = {}
    kept: list[int] = []
    maps: list[np.ndarray] = []
    number = 0  # of the row among those of all sets
    for entry in sets:
        earlier, becomes = dict(row_of), []
        for name in entry.sources.name.tolist():
            row = earlier.get(name, len(kept))
            if row == len(kept):
                kept.append(number)
                if name:
                    row_of.setdefault(name, row)
            elif not all(np.array_equal(v[kept[row]], v[number], equal_nan=True) for v in values):
                what = f"{name!r} has other values than in an earlier file"
                raise _conflict(what, entry, "SOURCES", "correct one of them, or give it another NAME")
            becomes.append(row)
            number += 1
        maps.append(np.array(becomes, dtype=np.int64))
    rows = np.array(kept, dtype=np.int64)
    joined = {name: column[rows] for name, column in columns.items()}
    return Sources(**joined | {"source": _fresh(joined["source"])}), maps


def _join_filters(sets: tuple[CalibrationSet, ...]) -> dict[str, FilterCurve]:
    filters: dict[str, FilterCurve] = {}
    for entry in sets:
        for name, curve in entry.filters.items():
            old = filters.setdefault(name, curve)
            same = np.array_equal(old.wavelength, curve.wavelength)
            if not (same and np.array_equal(old.throughput, curve.throughput)):
                advice = "correct one of them, or give it another name"
                raise _conflict(
                    f"{name!r} is another curve than in an earlier file", entry, "FILTERS", advice
                )
    return filters


def _join_tables(
    sets: list[CalibrationSet], source_rows: list[np.ndarray]
) -> tuple[TableIntensities, Points]:
    """Join tables of intensities; identical coordinates are one field point."""
    tables = [entry.intensities for entry in sets if isinstance(entry.intensities, TableIntensities)]
    points = [entry.points for entry in sets]
    # Two points of one file are never merged: both may have data in the same exposure.
    places = np.concatenate([np.column_stack([p.x, p.y, _earlier_ones(p)]) for p in points]) + 0.0  # −0 is 0
    _, keep, place = np.unique(places, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(keep)  # as they appear
    keep, row = keep[order], np.argsort(order)[place.reshape(-1)]
    ids = np.concatenate([entry.point for entry in points])[keep]
    joined = Points(point=_fresh(ids), x=places[keep, 0], y=places[keep, 1])
    first_exposure = np.cumsum([0, *(len(entry.exposures) for entry in sets)])
    first_point = np.cumsum([0, *map(len, points)])
    return TableIntensities(
        int(first_exposure[-1]),
        joined,
        exposure=np.concatenate([t.exposure + n for t, n in zip(tables, first_exposure, strict=False)]),
        point=np.concatenate([row[n + t.point] for t, n in zip(tables, first_point, strict=False)]),
        # The appended −1 is what a row without a source (−1, the last entry) becomes.
        source=np.concatenate(
            [np.append(rows, -1)[t.source] for t, rows in zip(tables, source_rows, strict=True)]
        ),
        **{
            name: np.concatenate([getattr(table, name) for table in tables])
            for name in ("counts", "sigma", "flag", "used")
        },
    ), joined


def _earlier_ones(points: Points) -> Int[np.ndarray, " p"]:
    """Number of points ahead of each one at the same place."""
    _, place = np.unique(np.column_stack([points.x, points.y]) + 0.0, axis=0, return_inverse=True)
    place = place.reshape(-1)
    order = np.argsort(place, kind="stable")
    number = np.empty(len(place), np.int64)
    number[order] = np.arange(len(place)) - np.searchsorted(place[order], place[order])
    return number


def _fresh(ids: np.ndarray) -> np.ndarray:
    """Keep identifiers at their first appearance and give repeated ones new numbers."""
    order = np.argsort(ids, kind="stable")  # of pixels, numbered already: at once
    sorted_ids = ids[order]
    repeated = np.sort(order[1:][sorted_ids[1:] == sorted_ids[:-1]])
    fresh = ids.copy()
    fresh[repeated] = ids.max(initial=-1) + 1 + np.arange(len(repeated))
    return fresh


def _stack_points(points: list[Points]) -> Points:
    return Points(
        point=_fresh(np.concatenate([entry.point for entry in points])),
        x=np.concatenate([entry.x for entry in points]),
        y=np.concatenate([entry.y for entry in points]),
    )

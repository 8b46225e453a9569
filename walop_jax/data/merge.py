"""Several calibration sets become one: exposures side by side, equal points and sources once."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Int

from walop_jax.data.frames import FrameIntensities, Grid
from walop_jax.data.records import (
    Block,
    CalibrationSet,
    Exposures,
    FilterCurve,
    Intensities,
    Points,
    Position,
    Site,
    Sources,
)
from walop_jax.data.repeats import check_repeats
from walop_jax.data.table_intensities import TableIntensities, empty_block, mask_repeats
from walop_jax.io.errors import DataError, fail


class JoinedIntensities(Intensities):
    """Parts with field points of their own, one after the other: frames, and a table beside them.

    A part is its intensities, its field points, the rows that its exposures have in the whole, and the rows
    that its sources have.
    """

    def __init__(self, parts: tuple[tuple[Intensities, Points, np.ndarray], ...], exposures: int) -> None:
        self.parts = parts
        self.exposures = exposures

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


def frames_among(calset: CalibrationSet) -> tuple[FrameIntensities, Int[np.ndarray, " r"]] | None:
    """The frames of a set and the exposures (positions) that they hold; None where there are none, or on two grids."""
    whole = calset.intensities
    if isinstance(whole, FrameIntensities):
        return whole, np.arange(len(calset.exposures))
    parts = whole.parts if isinstance(whole, JoinedIntensities) else ()
    found = [(part, exposures) for part, _, exposures in parts if isinstance(part, FrameIntensities)]
    return found[0] if len(found) == 1 else None


def without_frames(calset: CalibrationSet) -> CalibrationSet | None:
    """What a set holds beside its frames, with the exposures of all of it; None with no frames or nothing else."""
    whole = calset.intensities
    parts = whole.parts if isinstance(whole, JoinedIntensities) else ()
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
    not have is out there.

    Raises `DataError` for different instruments, numbers of cameras or sites, and for a filter or source that has
    one name and two meanings.
    """
    first = sets[0]
    for other in sets[1:]:
        if other.instrument != first.instrument:
            raise _conflict(f"is {other.instrument}, {_name(first)} is {first.instrument}", other, "INSTRUME")
        if other.cameras != first.cameras:
            what = f"has {other.cameras} cameras, {_name(first)} has {first.cameras}"
            raise _conflict(what, other, "N", "these are not sets of one instrument")
        if not _same_site(first.site, other.site):
            raise _conflict(
                f"is another site than that of {_name(first)}", other, "SITELAT, SITELONG, SITEELEV"
            )
    exposures, remarks = _join_exposures(sets)
    sources, source_rows = _join_sources(sets)
    filters = _join_filters(sets)
    offsets = np.cumsum([0, *(len(entry.exposures) for entry in sets)])

    parts: list[tuple[Intensities, Points, np.ndarray]] = []
    grids: dict[Grid, list[int]] = {}
    tables: list[int] = []
    for index, entry in enumerate(sets):
        if isinstance(entry.intensities, FrameIntensities):
            grids.setdefault(entry.intensities.grid, []).append(index)
        elif isinstance(entry.intensities, TableIntensities):
            tables.append(index)
        else:
            raise _conflict("has been merged before", entry, "", "merge all files at once")
    for grid, members in grids.items():
        frames = [
            entry for index in members if isinstance(entry := sets[index].intensities, FrameIntensities)
        ]
        stacks = tuple(stack for entry in frames for stack in entry.stacks)
        rows = np.concatenate([np.arange(offsets[index], offsets[index + 1]) for index in members])
        parts.append((FrameIntensities(grid, stacks), grid.points, rows))
    if tables:
        table, points = _join_tables([sets[n] for n in tables], [source_rows[n] for n in tables])
        rows = np.concatenate([np.arange(offsets[index], offsets[index + 1]) for index in tables])
        # `table` counts the exposures of its own files; a whole of tables alone needs no joint.
        parts.append((table, points, rows))

    names = ", ".join(str(entry_input.path) for entry in sets for entry_input in entry.inputs)
    if len(parts) == 1:
        intensities, points = parts[0][:2]
        if isinstance(intensities, TableIntensities):
            intensities, repeated = mask_repeats(intensities, exposures, names)
            remarks += repeated
    else:
        intensities = JoinedIntensities(tuple(parts), len(exposures))
        points = _stack_points([part[1] for part in parts])
    remarks += check_repeats(intensities, exposures, points, names)
    return CalibrationSet(
        instrument=first.instrument,
        site=first.site,
        origin="; ".join(dict.fromkeys(entry.origin for entry in sets if entry.origin)),
        exposures=exposures,
        points=points,
        sources=sources,
        filters=filters,
        intensities=intensities,
        inputs=tuple(entry_input for entry in sets for entry_input in entry.inputs),
        remarks=tuple(dict.fromkeys([remark for entry in sets for remark in entry.remarks] + remarks)),
    )


def _name(calset: CalibrationSet) -> str:
    return ", ".join(str(entry.path) for entry in calset.inputs) or "a set in memory"


def _conflict(
    what: str, calset: CalibrationSet, column: str, advice: str = "merge only what fits"
) -> DataError:
    return fail(what, file=_name(calset), column=column, advice=advice)


def _same_site(one: Site, other: Site) -> bool:
    """Whether two sites agree: a thousandth of a degree, ten metres."""
    fields = ("latitude", "longitude", "elevation")
    return all(
        np.isclose(getattr(one, name), getattr(other, name), rtol=0, atol=atol, equal_nan=True)
        for name, atol in zip(fields, (1e-3, 1e-3, 10.0), strict=True)
    )


def _join_exposures(sets: tuple[CalibrationSet, ...]) -> tuple[Exposures, list[str]]:
    remarks, ids = [], np.zeros(0, dtype=np.int64)
    for entry in sets:
        new = entry.exposures.exposure
        if np.any(np.isin(new, ids)):
            shift = int(ids.max() + 1 - new.min())
            remarks.append(f"{_name(entry)} [EXPOSURES] EXPOSURE: taken in another file, raised by {shift}")
            new = new + shift
        ids = np.concatenate([ids, new])
    prefixes = list(dict.fromkeys(prefix for entry in sets for prefix in entry.exposures.moving))
    parts = []
    for entry in sets:
        e = entry.exposures
        absent = {prefix: Position.out(len(e)) for prefix in prefixes if prefix not in e.moving}
        if absent:
            names = ", ".join(f"{prefix}_ANGLE" for prefix in absent)
            remarks.append(f"{_name(entry)} [EXPOSURES] {names}: no such column, taken as out of the beam")
        parts.append(dataclasses.replace(e, moving={**e.moving, **absent}).columns())
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Exposures.from_columns(columns | {"EXPOSURE": ids}), remarks


def _join_sources(sets: tuple[CalibrationSet, ...]) -> tuple[Sources, list[np.ndarray]]:
    """Join the sources; return with them the row that each old row has become."""
    fields = [field.name for field in dataclasses.fields(Sources)]
    rows: list[dict[str, Any]] = []
    maps: list[np.ndarray] = []
    for entry in sets:
        taken = {str(row["name"]): n for n, row in enumerate(rows) if row["name"]}
        ids = {int(row["source"]) for row in rows}
        becomes = np.empty(len(entry.sources), dtype=np.int64)
        for n in range(len(entry.sources)):
            row = {name: getattr(entry.sources, name)[n] for name in fields}
            old = taken.get(str(row["name"]))
            if old is not None:
                values = ("q", "u", "q_err", "u_err", "teff")
                if not all(np.array_equal(rows[old][name], row[name], equal_nan=True) for name in values):
                    raise _conflict(
                        f"{str(row['name'])!r} has other values than in an earlier file",
                        entry,
                        "SOURCES",
                        "correct one of them, or give it another NAME",
                    )
                becomes[n] = old
                continue
            if int(row["source"]) in ids:
                row["source"] = max(ids) + 1
            ids.add(int(row["source"]))
            becomes[n] = len(rows)
            rows.append(row)
        maps.append(becomes)
    # A set without sources still has its typed empty columns.
    dtypes = {name: np.concatenate([getattr(entry.sources, name) for entry in sets]).dtype for name in fields}
    return Sources(**{n: np.array([row[n] for row in rows], dtype=dtypes[n]) for n in fields}), maps


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
    points = [entry.points for entry in sets]
    xy = np.concatenate([np.column_stack([entry.x, entry.y]) for entry in points]) + 0.0  # −0 is 0
    places: dict[bytes, int] = {}
    keep, row = [], np.empty(len(xy), dtype=np.int64)
    owner = np.repeat(np.arange(len(points)), [len(entry) for entry in points])
    seen: dict[tuple[bytes, int], int] = {}
    for n, value in enumerate(xy):
        key = value.tobytes()
        # Two points of one file are never merged: both may have data in the same exposure.
        if key not in places or (key, int(owner[n])) in seen:
            places.setdefault(key, len(keep))
            row[n] = len(keep)
            keep.append(n)
        else:
            row[n] = places[key]
        seen[key, int(owner[n])] = n
    ids = np.concatenate([entry.point for entry in points])[keep]
    joined = Points(point=_fresh(ids), x=xy[keep, 0], y=xy[keep, 1])

    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("exposure", "point", "source")}
    first_exposure = first_point = 0
    tables: list[TableIntensities] = []
    for entry, sources in zip(sets, source_rows, strict=True):
        table = entry.intensities
        assert isinstance(table, TableIntensities)
        columns["exposure"].append(table.exposure + first_exposure)
        columns["point"].append(row[first_point + table.point])
        # The appended −1 is what a row without a source (−1, the last entry) becomes.
        columns["source"].append(np.append(sources, -1)[table.source])
        first_exposure += len(entry.exposures)
        first_point += len(entry.points)
        tables.append(table)
    return (
        TableIntensities(
            first_exposure,
            joined,
            **{name: np.concatenate(parts) for name, parts in columns.items()},
            **{
                name: np.concatenate([getattr(table, name) for table in tables])
                for name in ("counts", "sigma", "flag", "used")
            },
        ),
        joined,
    )


def _fresh(ids: np.ndarray) -> np.ndarray:
    """Keep identifiers at their first appearance and give repeated ones new numbers."""
    order = np.argsort(ids, kind="stable")  # of pixels, numbered already: at once
    sorted_ids = ids[order]
    repeated = np.sort(order[1:][sorted_ids[1:] == sorted_ids[:-1]])
    fresh = ids.copy()
    fresh[repeated] = ids.max() + 1 + np.arange(len(repeated))
    return fresh


def _stack_points(points: list[Points]) -> Points:
    return Points(
        point=_fresh(np.concatenate([entry.point for entry in points])),
        x=np.concatenate([entry.x for entry in points]),
        y=np.concatenate([entry.y for entry in points]),
    )

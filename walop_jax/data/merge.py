"""Several calibration sets become one: exposures side by side, equal points and sources once."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from walop_jax.data.records import (
    CalibrationSet,
    Exposures,
    FilterCurve,
    FineStructure,
    Points,
    Position,
    Sources,
    StatedErrors,
)
from walop_jax.data.repeats import mask_repeats, repeated_counts
from walop_jax.data.settings import same_filters
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.io.errors import DataError, fail


def merge_calibration_sets(*sets: CalibrationSet) -> CalibrationSet:
    """Join calibration sets of one instrument at one site.

    Exposure and point identifiers that collide are renumbered (and this is remarked on); points with identical
    coordinates become one, so that whole frames on the same grid share their points, and sources with the same name
    likewise. A moving element that a set does not have is out there. Of the errors of the numbers of the sets the
    largest are taken.

    Raises `DataError` for different instruments, numbers of cameras or sites, and for a filter or source that has
    one name and two meanings.
    """
    first = sets[0]
    for calset in sets[1:]:
        _refuse_another_instrument(first, calset)
    exposures, remarks = _join_exposures(sets)
    sources, source_rows = _join_sources(sets)
    names = ", ".join(str(entry_input.path) for entry in sets for entry_input in entry.inputs)
    intensities, points = _join_tables(sets, source_rows)
    intensities, repeated = mask_repeats(intensities, exposures, names)
    remarks += repeated
    structures = [entry.fine for entry in sets if entry.fine is not None]
    remarks += repeated_counts(intensities, exposures, points, names)
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
        fine=FineStructure.joined(structures) if structures else None,
        cells=next((entry.cells for entry in sets if entry.cells is not None), None),
        stated_errors=StatedErrors.largest(entry.stated_errors for entry in sets),
    )


def _refuse_another_instrument(first: CalibrationSet, other: CalibrationSet) -> None:
    if other.instrument != first.instrument:
        raise _conflict(f"is {other.instrument}, {_name(first)} is {first.instrument}", other, "INSTRUME")
    if other.cameras != first.cameras:
        what = f"has {other.cameras} cameras, {_name(first)} has {first.cameras}"
        raise _conflict(what, other, "N", "these are not sets of one instrument")
    # To a thousandth of a degree, and ten metres.
    places = ([site.latitude, site.longitude, site.elevation] for site in (first.site, other.site))
    if not np.isclose(*places, rtol=0, atol=[1e-3, 1e-3, 10.0], equal_nan=True).all():
        what = f"is another site than that of {_name(first)}"
        raise _conflict(what, other, "SITELAT, SITELONG, SITEELEV")


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
    names = dict.fromkeys(name for part in parts for name in part)
    # A column <P>_TURN that a part has not is 0.
    still = [(part, np.zeros(len(part["EXPOSURE"]))) for part in parts]
    columns = {name: np.concatenate([part.get(name, zero) for part, zero in still]) for name in names}
    return Exposures.from_columns(columns | {"EXPOSURE": ids}), remarks


def _join_sources(sets: tuple[CalibrationSet, ...]) -> tuple[Sources, list[np.ndarray]]:
    """Join the sources, stars by their names; return with them the row that each old row has become.

    Values of a star that differ are those of the bands that the files saw it in, if each saw it in one of its own.
    """
    fields = [field.name for field in dataclasses.fields(Sources)]
    columns = {name: np.concatenate([getattr(entry.sources, name) for entry in sets]) for name in fields}
    owner = np.repeat(np.arange(len(sets)), [len(entry.sources) for entry in sets])
    first = np.cumsum([0, *(len(entry.sources) for entry in sets[:-1])])
    star = np.concatenate([entry.sources.stars + n for entry, n in zip(sets, first, strict=True)]).astype(int)
    earliest: dict[str, int] = {}
    for i in np.flatnonzero(star == np.arange(len(star))).tolist():
        name, file = str(columns["name"][i]), owner[i]
        at = earliest.setdefault(name, i) if name else i
        if owner[at] != file:
            star[star == i] = at
    values = np.stack([columns[name] for name in ("q", "u", "q_err", "u_err", "scatter")], axis=1)
    # Of stars with different values: the band in which their file saw its stars.
    filters = [np.unique(entry.exposures.filter[entry.exposures.direct("standard")]) for entry in sets]
    filter_of_file = np.array([names[0] if len(names) == 1 else "" for names in filters])
    unclear = np.array([not _equal(values[star == number]) for number in star], bool) & (
        columns["filter"] == ""
    )
    band = np.where(unclear, filter_of_file[owner], columns["filter"])
    rows_kept: list[int] = []
    for row in range(len(star)):
        same = [k for k in rows_kept if star[k] == star[row] and band[k] == band[row]]
        teff = columns["teff"][[star[row], row]]
        if not (np.array_equal(teff[:1], teff[1:], equal_nan=True) and _equal(values[[*same, row]])):
            what = f"{str(columns['name'][row])!r} has other values than in an earlier file"
            advice = "correct one of them, give it another NAME, or FILTER to values of several bands"
            raise _conflict(what, sets[owner[row]], "SOURCES", advice)
        if not same:
            rows_kept.append(row)
    rows, stars = np.array(rows_kept, dtype=np.int64), np.unique(star)
    columns["source"] = _fresh(columns["source"][stars])[np.searchsorted(stars, star)]
    joined = Sources(**{name: column[rows] for name, column in (columns | {"filter": band}).items()})
    return joined, np.split(np.searchsorted(rows, star), first[1:])


def _equal(rows: np.ndarray) -> bool:
    return all(np.array_equal(rows[0], row, equal_nan=True) for row in rows)


def _join_filters(sets: tuple[CalibrationSet, ...]) -> dict[str, FilterCurve]:
    filters: dict[str, FilterCurve] = {}
    for entry in sets:
        for name, curve in entry.filters.items():
            if (alike := same_filters(name, filters)) and name not in filters:
                what = f"{name!r} is {alike[0]!r} in an earlier file"
                raise _conflict(what, entry, "FILTERS", "spell the name of a filter alike in all files")
            old = filters.setdefault(name, curve)
            same = np.array_equal(old.wavelength, curve.wavelength)
            if not (same and np.array_equal(old.throughput, curve.throughput)):
                what = f"{name!r} is another curve than in an earlier file"
                raise _conflict(what, entry, "FILTERS", "correct one of them, or give it another name")
    return filters


def _join_tables(
    sets: Sequence[CalibrationSet], source_rows: list[np.ndarray]
) -> tuple[TableIntensities, Points]:
    """Join tables of intensities; identical coordinates are one field point."""
    tables = [TableIntensities.of(entry.intensities, entry.points) for entry in sets]
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
    columns = {
        "exposure": [t.exposure + n for t, n in zip(tables, first_exposure, strict=False)],
        "point": [row[n + t.point] for t, n in zip(tables, first_point, strict=False)],
        # The appended −1 is the entry of a row without a source (−1, the last entry).
        "source": [np.append(rows, -1)[t.source] for t, rows in zip(tables, source_rows, strict=True)],
        **{name: [getattr(t, name) for t in tables] for name in ("counts", "sigma", "flag", "used")},
    }
    if any(table.sky is not None for table in tables):  # 0 in those that do not state it
        columns["sky"] = [np.zeros_like(t.counts) if t.sky is None else t.sky for t in tables]
    stacked = {name: np.concatenate(arrays) for name, arrays in columns.items()}
    return TableIntensities(int(first_exposure[-1]), joined, **stacked), joined


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

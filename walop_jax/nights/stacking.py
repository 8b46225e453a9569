"""Surveys from fits, runs and sets: nights are made, stacked, and kept in a folder.

The files of a survey: docs, files. Nights that are made lie in its folder `partial` until all are.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.data.schema import Column
from walop_jax.data.user_tables import in_memory, numeric_column, read_input_table
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import Doubt, Quality
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import primary_keywords
from walop_jax.io.names import NIGHTS, PRODUCT
from walop_jax.io.run_folder import RunFolder
from walop_jax.io.text import check_input, parse_toml, read_text
from walop_jax.model.effects import EFFECTS, EffectKind
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.laws import Law
from walop_jax.model.parameters import Parameter
from walop_jax.nights.algebra import LawOfEach, OfUnits, Solution, UndeterminedError
from walop_jax.nights.break_search import find as breaks_of
from walop_jax.nights.breaks import solved
from walop_jax.nights.equations import data_hash
from walop_jax.nights.making import Data, Maker, Task, made
from walop_jax.nights.night_file import read_nights
from walop_jax.nights.survey import Survey
from walop_jax.nights.survey_folder import (
    Kept,
    breaks_in,
    doubts_about,
    kept_in,
    laws_of_all,
    survey_of,
    undetermined,
)
from walop_jax.nights.together import Night, Together, together
from walop_jax.posterior.run import Run

AtHand = Mapping[tuple[str, int], Data]
Make = Callable[[Sequence[Task]], Iterator[list[Night]]]

NightLike = FitResult | CalibrationSet | Night | Run | str | os.PathLike[str]
"""Sources of nights: a fit, a set, a night, or a path: of a set, of a RUN, of a SURVEY or of its nights."""

FAR = 0.02  # standard errors from the solution up to which a night need not be linearised again
EXACT = 1e-3  # standard errors by which linearising all nights again may move the solution at most
ROUNDS = 6
PARTIAL = "partial"  # folder of the nights that are made, until all are


def stack(
    nights: Sequence[NightLike],
    laws: Mapping[str, Law | Mapping[str, Any]] | str | os.PathLike[str] | None = None,
    *,
    like: Calibration | FitResult | None = None,
    find: bool = True,
    events: Any = None,
    partial: Path | None = None,
    executor: Executor | None = None,
    tell: Callable[[str], None] = lambda text: None,
    catalogue: Sequence[EffectKind] = EFFECTS,
) -> Survey:
    """Fit all nights together under laws of time, from their normal equations.

    Nights are fits, calibration sets (linearised at the values of `like`, no fit is needed), or kept nights.
    `laws` are as the [law] tables of `model.laws`, or a file with them, by default those of the model of `like`; a
    parameter without one is shared by all nights. `like` is a calibration of their model, by default the first that is
    given. Sets and fits are linearised again at the common solution until none is far from it; kept nights cannot be.
    With `find` breaks are looked for in three nights and more, and become laws. `events` is a table of works on
    the instrument (MJD, WHAT); `partial` is a folder that nights are kept in while others are made,
    `executor` makes them in other processes, to the same result (`nights.making`).

    Raises `DataError` for nights that do not belong together, that do not determine a parameter under its law, and for
    nights without a filter in common; ValueError for laws that are wrong, or of parameters that do not exist.
    """
    kept, given = zip(*(_opened(entry, catalogue) for entry in nights), strict=True) if nights else ((), ())
    like = Calibration.from_fit(like) if isinstance(like, FitResult) else like
    fits = [entry for entry in (like, *(source.fit for source in kept)) if entry is not None]
    maker = Maker(fits[0] if fits else None, partial, len(kept))
    make = functools.partial(made, maker, executor)
    all_nights: list[Night] = []
    at_hand: dict[tuple[str, int], Data] = {}
    new = make([Task(entry) for entry in given if entry is not None])
    for k, entry in enumerate(given):
        source = kept[k].nights
        if entry is not None:
            tell(f"{k + 1} of {len(given)}")
            source = next(new)
            at_hand |= {night.key: entry for night in source}
        all_nights += source
    data = together(all_nights)
    doubts = doubts_about(fits, data)
    tables: Mapping[str, Any] = laws if isinstance(laws, Mapping) else {}
    if isinstance(laws, str | os.PathLike):
        tables = parse_toml(read_text(laws)).get("law", {})
    elif laws is None and maker.like is not None:
        tables = maker.like.model.laws
    chosen = laws_of_all(data, tables)
    breaks = breaks_in(data, chosen, kept)
    try:
        if find and len({night.number for night in data.nights}) > 2:
            # Ahead of linearising again: with breaks that are no law yet the common solution is one of no night.
            carried = functools.partial(_carried, maker.like, catalogue) if maker.like is not None else None
            new_breaks, chosen = breaks_of(data, chosen, catalogue, carried)
            breaks += new_breaks
        before = data.reference
        data, solution, settled = _settled(data, chosen, at_hand, make)
        moving = ~data.has_value & np.array([law is not None for law in chosen])
        if at_hand and moving.any():
            # Columns of candidates are those of where the nights were, as far as they do not follow the parameters:
            # the error is a product of the distance since and of their amplitudes.
            values, sigma = _in_units(data, solution)
            distance = _distances(data, solution, before, at_hand)
            sizes = 1.0 + np.abs(values / sigma)[:, moving].sum(axis=1)
            order = sorted(distance, key=lambda u: -distance[u] * sizes[u])
            names = frozenset(itertools.compress(data.names, moving))
            data, *_ = _linearised(data, solution, chosen, order, at_hand, make, names)
            data, solution, settled = _settled(data, chosen, at_hand, make)
    except UndeterminedError as error:
        raise undetermined(data, error) from None
    if not settled:
        what = "the solution has not settled: the nights differ by more than their laws and the breaks that were found"
        doubts.append(Doubt(Quality.NOT_CONVERGED, what))
    happened = [event for source in kept for event in source.events]
    happened += [] if events is None else events_of(events)
    return survey_of(data, chosen, solution, maker.like, doubts, breaks, happened, at_hand)


def events_of(table: Any) -> list[tuple[float, str]]:
    """Events of a table with the columns MJD and WHAT, or of its file. Raises `DataError` where one is missing."""
    read = read_input_table(table, ("MJD",)) if isinstance(table, str | os.PathLike) else in_memory(table)
    mjd = numeric_column(read, "MJD", Column("float", "d"))
    if "WHAT" not in read.names:
        advice = "describe the event in words"
        raise fail("the column is missing", file=read.path, column="WHAT", advice=advice)
    words = read.table.columns[read.names.index("WHAT")]
    return list(zip(mjd.tolist(), map(str, words), strict=True))


def _opened(given: NightLike, catalogue: Sequence[EffectKind]) -> tuple[Kept, Data | None]:
    """Nights that are kept, or a fit and data that they can be made of."""
    if isinstance(given, Night):
        return Kept([given]), None
    if isinstance(given, FitResult):
        product = Calibration.from_fit(given)
        return Kept(fit=product), Data(given.calset, data_hash(given.calset), product.model)
    if isinstance(given, CalibrationSet):
        return Kept(), Data(given, data_hash(given))
    path = given.folder if isinstance(given, RunFolder) else Path(given)
    if path.is_dir() and (not (path / PRODUCT).exists() or (path / NIGHTS).exists()):
        return kept_in(path, catalogue), None
    keywords = () if path.is_dir() else primary_keywords(path)
    if "NIGHTVER" in keywords:
        return Kept(read_nights(path)), None
    if path.is_dir() or "PRODVERS" in keywords:
        run = given if isinstance(given, Run) else Run(path if path.is_dir() else path.parent, catalogue)
        return Kept(fit=run.calibration), Data(run, data_hash(run.calset))
    with check_input(path).open("rb") as raw:
        return Kept(), Data(path.resolve(), hashlib.file_digest(raw, "sha256").hexdigest())


def _settled(data: Together, laws: LawOfEach, at_hand: AtHand, make: Make) -> tuple[Together, Solution, bool]:
    """Linearise nights at the common solution until that would not move it by `EXACT` errors; whether it would not.

    A missing effect may lead ever farther away: the search ends where all nights come no closer.
    """
    solution, anew, enough, farthest = solved(data, laws), list[int](), False, np.inf
    for _ in range(ROUNDS):
        away = _distances(data, solution, data.reference, at_hand)
        again = {u: distance for u, distance in away.items() if distance > FAR}
        if not again or (enough and not set(again) & set(anew)):
            return data, solution, True
        if max(away.values()) >= farthest:
            break
        farthest = max(away.values())
        data, solution, anew, enough = _linearised(data, solution, laws, again, at_hand, make)
    return data, solution, False


def _distances(data: Together, solution: Solution, references: OfUnits, at_hand: AtHand) -> dict[int, float]:
    """Distances (standard errors) of nights whose data are at hand, from references to a solution, largest first."""
    values, sigma = _in_units(data, solution)
    # Candidates have no place in the model: their part stays first-order, at 0.
    away = np.nanmax((np.abs(values - references) / sigma)[:, data.has_value], axis=1)
    order = np.argsort(-away, kind="stable").tolist()
    return {u: float(away[u]) for u in order if data.nights[u].key in at_hand}


def _linearised(
    data: Together,
    solution: Solution,
    laws: LawOfEach,
    again: Collection[int],
    at_hand: AtHand,
    make: Make,
    candidates: frozenset[str] = frozenset(),
) -> tuple[Together, Solution, list[int], bool]:
    """Linearise nights `again` at a solution, with candidates, until the rest may stay; which were, and whether it may.

    They come in their order, the n-th of them to see: were each of the rest as far from linear, how far would all
    together move the solution? Up to `EXACT` errors the rest stays.
    """
    values, sigma = _in_units(data, solution)
    nights, order, anew, enough = list(data.nights), list(again), list[int](), False
    for begin in (0, *(2**k for k in range(len(order).bit_length()))):
        if not (batch := order[begin : max(1, 2 * begin)]):
            break
        at = {u: dict(zip(data.names, values[u].tolist(), strict=True)) for u in batch}
        tasks = [Task(at_hand[nights[u].key], nights[u], at[u], candidates) for u in batch]
        *earlier, (last,) = make(tasks)
        for u, (night,) in zip(batch, earlier, strict=False):
            nights[u] = night
        seeing = len(batch) == max(1, begin)  # the first, second, fourth …: solving costs time as well
        before = values
        if seeing and begin > 0:
            before, _ = _in_units(trial := together(nights), solved(trial, laws))
        nights[u := batch[-1]] = last
        anew += batch
        data = together(nights)
        solution = solved(data, laws)
        if seeing:
            after, _ = _in_units(data, solution)
            remaining = np.full((len(nights), 1), len(order) - begin - len(batch))
            remaining[u] = min(remaining[u], 1)  # its own values move with no other night
            if enough := bool(np.all(remaining * np.abs(after - before) <= EXACT * sigma)):
                break
    return data, solution, anew, enough


def _in_units(data: Together, solution: Solution) -> tuple[OfUnits, OfUnits]:
    """Values and errors (night, parameter) of a solution."""
    scale = data.equations.scale
    return data.origin + solution.values * scale, np.maximum(solution.errors() * scale, 1e-12 * scale)


def _carried(like: Calibration, catalogue: Sequence[EffectKind], candidate: Parameter) -> bool:
    """True unless a candidate is an effect of which a star at another time and flux says nothing.

    Such are the median counts of a field, the exposure before, the time since the first exposure of a night.
    """
    kind = next((entry for entry in catalogue if entry.name == candidate.part), None)
    if kind is None:
        return True
    template = like.model.template
    changes = kind.neutral(effect_context(template, like.exposures)).first_order(template)
    return all(change.applies_to_catalogue for orders in changes for _, change in orders)

"""Surveys in folders: written, read and solved again, and asked for the calibration of stars (files: docs, files)."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.data.schema import EXPOSURES
from walop_jax.data.units import Place
from walop_jax.data.user_tables import InputTable, numeric_column
from walop_jax.fit.verdict import STATED, Doubt, Quality
from walop_jax.io.errors import DataError, fail
from walop_jax.io.names import NIGHTS, PRODUCT, REFERENCE, SURVEY, TRACKS
from walop_jax.io.run_folder import RunFolder
from walop_jax.model.effects import EFFECTS, EffectKind
from walop_jax.model.laws import Law, laws_of, resolved
from walop_jax.nights.algebra import LawOfEach, Solution, UndeterminedError
from walop_jax.nights.breaks import Break, at_solution, solved, with_breaks
from walop_jax.nights.night_file import nights_in, write_nights
from walop_jax.nights.survey import Survey
from walop_jax.nights.together import Night, Together, source_of, together

LONG = 60.0  # days without a night that are worth a remark


class Kept(NamedTuple):
    """Nights that are kept, with the fit, breaks and events that come with them."""

    nights: Sequence[Night] = ()
    fit: Calibration | None = None
    breaks: tuple[Break, ...] = ()
    events: tuple[tuple[float, str], ...] = ()


def kept_in(folder: Path, catalogue: Sequence[EffectKind]) -> Kept:
    """The nights of the folder of a survey, or of files of nights. Raises `DataError` where it has none."""
    fit = read_calibration(folder / REFERENCE, catalogue) if (folder / REFERENCE).exists() else None
    run = RunFolder(folder)
    document = run.document(SURVEY) if SURVEY in run else {"breaks": [], "events": []}
    breaks = tuple(Break.read(entry) for entry in document["breaks"])
    events = tuple((float(entry["mjd"]), str(entry["what"])) for entry in document["events"])
    return Kept(nights_in(folder), fit, breaks, events)


def read_survey(folder: str | os.PathLike[str], catalogue: Sequence[EffectKind] = EFFECTS) -> Survey:
    """The survey of a folder, solved again. Raises `DataError` for a folder that is none."""
    kept = kept_in(Path(folder), catalogue)
    fits = [] if kept.fit is None else [kept.fit]
    data = together(kept.nights)
    doubts = doubts_about(fits, data)
    laws = laws_of_all(data, fits[0].model.laws if fits else {})
    breaks = breaks_in(data, laws, [kept])
    try:
        solution = solved(data, laws)
    except UndeterminedError as error:
        raise undetermined(data, error) from None
    return survey_of(data, laws, solution, kept.fit, doubts, breaks, kept.events)


def is_survey(given: Any) -> TypeGuard[str | os.PathLike[str]]:
    """True for the path of a survey."""
    return isinstance(given, str | os.PathLike) and (Path(given) / SURVEY).exists()


def calibration_of_stars(survey: Survey, stars: InputTable, *, force: bool = False) -> Calibration:
    """The calibration for stars of one day (MJD, UTC).

    Raises `DataError` for stars without a time, of more than a day, on both sides of a change, of two nights with
    values of their own, and, unless `force` is given, outside the validity.
    """
    place, mjd = Place(stars.path, ""), numeric_column(stars, "MJD", EXPOSURES["MJD"])
    advice = "add the times (UTC) of the exposures, or give one calibration.fits for all"
    place.refuse(~np.isfinite(mjd), "is not given, and a survey changes with time", "MJD", advice)
    low, high = float(mjd.min()), float(mjd.max())
    advice = "give a catalogue for every night"
    if high - low > 1.0:
        raise place.fail(f"spans {high - low:.1f} days", "MJD", advice)
    if changed := [edge for edge in survey.edges if low < edge <= high]:
        raise place.fail(f"the instrument changed between the stars, at {changed[0]:.3f}", "MJD", advice)
    of_single_nights = any(law.base in ("night", "file") for law in survey.changing.values())
    if of_single_nights and survey.night_at(low) != survey.night_at(high):
        raise place.fail("spans two nights, each of which has values of its own", "MJD", advice)
    for moment in (low, high):
        survey.at(moment, force=force)
    return survey.at(0.5 * (low + high), force=force)


def writers(survey: Survey) -> dict[str, Callable[[Path], object]]:
    """Writers of the files of a survey, but for its document."""
    return {
        NIGHTS: lambda path: write_nights(path, survey.data.aligned()),
        REFERENCE: lambda path: write_calibration(path, dataclasses.replace(survey.reference, path=None)),
        PRODUCT: lambda path: write_calibration(path, survey.at(survey.last)),
        TRACKS: lambda path: survey.tracks.write(path, format="fits"),
    }


# ------------------------------------------------------------------------------------------ parts of a stack


def laws_of_all(data: Together, laws: Mapping[str, Law | Mapping[str, Any]]) -> tuple[Law | None, ...]:
    """A law for every parameter and candidate of nights (None: absent).

    Raises ValueError for wrong `laws`, `DataError` for nights in other filters that would share their throughputs.
    """
    tables = {name: law.document() if isinstance(law, Law) else law for name, law in laws.items()}
    cut = len(data.names) - data.candidates
    alone = [name for name, gauge in zip(data.names, data.gauge, strict=True) if gauge]
    every = resolved(laws_of(tables), data.names[:cut], data.names[cut:], alone)
    _check_filters(data, every)
    return every


def breaks_in(data: Together, laws: LawOfEach, kept: Iterable[Kept]) -> list[Break]:
    """The breaks that come with nights and are laws of them still."""
    every = (entry for source in kept for entry in source.breaks)
    return [entry for entry in every if with_breaks(data, laws, [entry]) == laws]


def survey_of(
    data: Together,
    laws: LawOfEach,
    solution: Solution,
    like: Calibration | None,
    doubts: Iterable[Doubt],
    breaks: Iterable[Break],
    events: Iterable[tuple[float, str]],
    at_hand: Collection[tuple[str, int]] = (),
) -> Survey:
    """The survey of a solution; `at_hand` are the keys of nights that could be linearised anew at it."""
    doubts = list(doubts)
    if fixed := sum(night.key not in at_hand for night in data.nights):
        what = (
            f"{fixed} of {len(data.nights)} nights stay as they were linearised: their data are not at hand"
        )
        doubts.append(Doubt(Quality(0), what, blocking=False))
    breaks = sorted((at_solution(data, solution, entry) for entry in breaks), key=lambda entry: entry.night)
    return Survey(data, tuple(laws), solution, like, tuple(doubts), tuple(breaks), tuple(sorted(set(events))))


def undetermined(data: Together, error: UndeterminedError) -> DataError:
    """The error of a parameter that nights do not determine."""
    name = data.names[error.parameter]
    if error.unit is None:
        what = f"the nights do not determine {name} under its law"
        return fail(what, advice="give it a prior, or another law")
    what = f"has no information on {name}, which has a value of its own there"
    night = f"the night of MJD {data.nights[error.unit].number}"
    return fail(f"{night} {what}", advice="give its law a spread, or let it be shared")


def doubts_about(fits: Sequence[Calibration], data: Together) -> list[Doubt]:
    """Doubts about the fits of nights, and long times without any.

    Raises `DataError` for a fit whose errors do not explain its scatter.
    """
    doubts = []
    for fit in fits:
        where = str(fit.path or source_of(fit))
        if fit.verdict.errors_from != STATED:
            what = f"the errors of {where} do not explain its scatter, and nights are weighed by them"
            raise fail(what, advice="correct N_ERR, or leave the night out")
        if not fit.verdict.trusted:
            doubts.append(Doubt(fit.verdict.quality, f"the fit of {where} is not trusted"))
    reached = math.inf
    for begin, end in sorted((night.begin, night.end) for night in data.nights):
        if begin - reached > LONG:
            what = f"no night from MJD {reached:.1f} to {begin:.1f}: what holds there rests on the laws alone"
            doubts.append(Doubt(Quality(0), what, blocking=False))
        reached = end if math.isinf(reached) else max(reached, end)
    return doubts


def _check_filters(data: Together, laws: LawOfEach) -> None:
    first = data.nights[0]
    pairs = zip(laws, data.parameters, strict=True)
    free = {law.base for law, p in pairs if law and p.name.startswith("throughput.")}
    for night in data.nights[1:]:
        if not set(night.filters) & set(first.filters) and not free & {"night", "file"}:
            raise fail(
                f"nights in other filters with the same throughputs: {', '.join(first.filters)} (MJD {first.number}) "
                f"and {', '.join(night.filters)} (MJD {night.number})",
                advice='stack them apart, or give [law."throughput.*"] per = "night"',
            )

"""Catalogues of many nights, by a calibration: is it still good for their stars, and since when not?

Each catalogue is asked whether it is what it says, all together for changes in their course (`star_history`), and where
these do not explain the stars each as `apply` asks it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.verdict import Doubt
from walop_jax.io.errors import DataError
from walop_jax.model.effects.in_models import effect_context, known_effects, with_effects
from walop_jax.science.apply import apply_by, readings_in, residuals_of
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.catalogue_verdict import verdict_on
from walop_jax.science.overlaps import overlap
from walop_jax.science.star_history import Watching
from walop_jax.science.star_residuals import StarResiduals
from walop_jax.science.star_words import CALIBRATE, DATE_IT, Watch

WATCHED_ROWS = 200_000  # rows used at most, of a kilobyte each; they show gains of 10⁻⁵
MISREAD_ROWS = 2048  # the same if a catalogue is doubted: what the watch finds then means nothing
_CERTAIN = 1e-9  # standard error of the numbers of added effects, in their units: no error of the calibration


def watch(
    calibration: Calibration,
    catalogues: Sequence[Catalogue],
    *,
    names: Sequence[str] = (),
    rows: int = WATCHED_ROWS,
    force: bool = False,
) -> Watch:
    """Look for changes of the instrument since it was calibrated in the stars of catalogues.

    Rows with the same MJD are an exposure group. If no row has an MJD, each catalogue is a group, in the given order;
    if only some rows have one, the others are left out, and a remark names their catalogues (`names`). Of more than
    `rows` rows a sample of `rows` is used, spread over the stars. Each catalogue is first tested for another reading
    (`readings_in`): for all readings if the stars contradict the calibration as no change of it could. If changes in
    time do not explain the stars, or if there is one exposure group, each catalogue is asked as `apply` asks it: what
    holds against it there holds here. Raises `DataError` as `science.apply.apply` does, and if no star has a camera to
    spare beside flux, q and u.
    """
    vectors = AnalysisVectors(with_rivals(calibration))
    given, told = list(zip(named(names, len(catalogues)), catalogues, strict=True)), len(catalogues) > 1

    def misread(*, doubted: bool = False) -> Iterator[str]:
        for name, catalogue in given:
            readings = readings_in(vectors, catalogue, force=force, doubted=doubted)
            mended = (readings.words(),) if readings is not None and readings.mended else ()
            yield from (f"{name}: {text}" if told else text for text in (*mended, *catalogue.doubts))

    wrong = tuple(misread())
    rows = min(rows, MISREAD_ROWS) if wrong else rows
    catalogues, remarks = dated(catalogues, names)
    total, batches = sum(map(len, catalogues)), []
    for catalogue in catalogues:
        share = -(-rows * len(catalogue) // total)
        batches += residuals_of(vectors, catalogue, share, force=force)
    if not batches:
        raise DataError("N: no star has a camera to spare beside flux, q and u; add rows at other settings")
    stars = StarResiduals.joined(batches)
    result = Watching(stars, vectors).watch()
    if result.doubtful and not wrong:
        wrong = tuple(misread(doubted=True))
    result = dataclasses.replace(result, remarks=remarks, misread=wrong)
    explained = result.changes and not result.noise_is_off and len(result.time) > 1
    if explained or result.misread:
        return result
    of_each = [
        dataclasses.replace(doubt, sentence=f"{name}: {doubt.sentence}" if told else doubt.sentence)
        for name, doubt in _of_catalogues(calibration, given, force=force)
    ]
    return dataclasses.replace(result, of_catalogues=tuple(of_each))


def _of_catalogues(
    calibration: Calibration, given: Sequence[tuple[str, Catalogue]], *, force: bool
) -> Iterator[tuple[str, Doubt]]:
    """What `apply` would hold against each catalogue, with its name; nothing that is about the calibration itself."""
    vectors, of_fit = AnalysisVectors(calibration), calibration.verdict
    for name, catalogue in given:
        stars = apply_by(vectors, catalogue, force=force)
        seen_twice = overlap(calibration, catalogue, force=force)
        for doubt in verdict_on(calibration, catalogue, stars, seen_twice).doubts:
            if doubt.blocking and (of_fit.trusted or doubt.bit != of_fit.quality):
                dated_here = doubt.remedy == DATE_IT
                yield name, dataclasses.replace(doubt, remedy=CALIBRATE) if dated_here else doubt


def named(names: Sequence[str], count: int) -> list[str]:
    """What messages call so many catalogues: their names, or numbers."""
    return [names[n] if n < len(names) else f"catalogue {n + 1}" for n in range(count)]


def dated(catalogues: Sequence[Catalogue], names: Sequence[str]) -> tuple[list[Catalogue], tuple[str, ...]]:
    """Catalogues with a time in every row, and remarks on rows left out for want of one.

    If no row has a time, it is the number of its catalogue.
    """
    has_time = [np.isfinite(catalogue.time) for catalogue in catalogues]
    if not any(map(np.any, has_time)):
        numbered = enumerate(catalogues)
        return [dataclasses.replace(c, time=np.full(len(c), float(n))) for n, c in numbered], ()
    remarks = []
    for number, timed in enumerate(has_time):
        if not timed.all():
            name = named(names, number + 1)[number]
            rows = f"{np.sum(~timed) if timed.any() else 'all'} of {len(timed)} rows have no time"
            remarks.append(f"{name}, MJD: {rows}, others do: left out, as their times are unknown")
    timed_rows = zip(catalogues, has_time, strict=True)
    return [c.of_rows(timed) for c, timed in timed_rows if timed.any()], tuple(remarks)


def with_rivals(calibration: Calibration) -> Calibration:
    """The calibration with the effects that are `watched` and that its instrument may have, as columns of its
    covariance: at neutral, as good as certain."""
    context = effect_context(calibration.model.template, calibration.exposures)
    model = calibration.model
    for kind in (kind for kind in known_effects(model) if kind.watched):
        try:
            model = with_effects(model, [kind.neutral(context)], context)
        except ValueError:
            continue  # there already, or of an element that the instrument lacks
    old = np.array([model.index(name) for name in calibration.model.names])
    new = np.setdiff1d(np.arange(len(model.names)), old)
    values, covariance = model.start, np.zeros((len(model.names), len(model.names)))
    values[old] = calibration.values
    covariance[np.ix_(old, old)] = calibration.covariance
    covariance[new, new] = _CERTAIN**2
    return dataclasses.replace(calibration, model=model, values=values, covariance=covariance, hidden=None)

"""`walop-jax refit`: the joint fit of calibration sets."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import (
    Job,
    Option,
    Outcome,
    PathLike,
    after_fit,
    command,
    given,
    typed,
    write_text,
)
from walop_jax.commands.inputs import (
    ModelLike,
    Sets,
    accuracy_document,
    goal_of,
    paths_of,
    set_and_model,
    shown_with_accuracy,
)
from walop_jax.commands.products import Effects, InstrumentLike
from walop_jax.io.names import CLIPPED, FAILED, PRODUCT, SUMMARY
from walop_jax.io.progress import Stage, repeated
from walop_jax.io.text import json_text

if TYPE_CHECKING:
    from walop_jax import FitResult

STAGES = ("reading", "fitting", "examining", "mapping")  # also of the commands that fit and do more


OPTIONS = {
    "output": Option("Folder of the results.", metavar="RUN", kind=Path, short="-o", required=True),
    "cells": Option("Cells of whole frames along their longer side.", metavar="N", kind=int, least=1),
    "clip": Option(
        "Leave out single intensities so many standard errors off; 5 is usual.",
        metavar="SIGMA",
        kind=float,
        least=3.0,
    ),
}


@command(
    stages=STAGES,
    writes=(PRODUCT, SUMMARY, CLIPPED),
    random=True,
    options=OPTIONS,
)
def refit(
    job: Job,
    data: Sets,
    model: ModelLike = None,
    *,
    output: PathLike | None = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
    cells: int | None = None,
    goal: float | None = None,
    clip: float | None = None,
) -> Outcome[FitResult]:
    """Fit all field points of calibration sets jointly: RUN/calibration.fits and RUN/summary.json.

    RUN is created if necessary. If it holds a calibration already, the command stops unless --overwrite is given;
    then these two files are replaced and all others stay.

    A fit that does not converge leaves RUN/summary.failed.json, no calibration, and exit code 1. One that converges but
    is not to be trusted (it does not explain the data, a parameter lies far from its prior, the residuals hold patterns
    or differ between parts of the data) is written with TRUSTED = F and warnings, exit code 3.

    The first line is the verdict for stars: go, go with reservations, or no go, with the first reason and its remedy,
    as walop-jax check RUN has it; then the error of p of a star, and all other reasons. The calibration may make half
    of --goal. A calibration that is to be trusted, but is no go (something that acts on stars is not measured, or p is
    not known well enough), ends with exit code 0 here, as the fit has done what it was asked, and with 3 in check.

    --clip leaves single intensities out that lie so many standard errors from the fit of all others (cosmic rays, stars
    in a patch of sky; 5 is usual), and lists them in RUN/clipped.ecsv. The set is fitted anew until nothing lies off
    any more. Where more than 5 % of the rows do, the model lacks something: the command stops, and diagnose looks for
    it.

    Whole frames are read as cells: 80 along their longer side unless --cells says otherwise, 6400 field points in all,
    which hold what the pixels say of anything smooth. Structure that is finer is told, with its worst place. The
    calibration then holds a map of the residuals of the smooth model, as that of a set of more than 65536 points does.

    In Python: a `FitResult`, with values and errors of all parameters (`result["pupil.magnification"]`,
    `result.to_table()`), their covariance, residuals and the verdict (`result.trusted`, `result.warnings`). Nothing is
    written unless `output` is given. `clipped` are the rows left out, and `calset` has them flagged. Raises `DataError`
    for data that cannot be trusted, ValueError for a model that does not fit the data.

    >>> result = walop.refit(calset)  # doctest: +SKIP
    >>> result["pupil.magnification"]
    15.6675 ± 0.0051
    """
    from walop_jax import Calibration
    from walop_jax.calibration.accuracy import GOAL
    from walop_jax.calibration.product import write_calibration
    from walop_jax.calibration.residual_map import residual_map
    from walop_jax.calibration.summary import summary
    from walop_jax.diagnosis.trust import examined
    from walop_jax.fit.misfit import describe
    from walop_jax.fit.outliers import clipped
    from walop_jax.fit.refit import refit as fit
    from walop_jax.fit.refit import with_empirical_covariance
    from walop_jax.science.field_accuracy import accuracy_of_fit, verdict_of_fit

    wanted = goal_of(goal) or GOAL
    job.begin("reading")
    calset, chosen = set_and_model(data, model, instrument, effects, output=output, cells=cells)
    with repeated(job.progress) as say:
        if clip is None:
            fitted = fit(calset, chosen, progress=say)
        else:
            say(Stage("fitting without outliers", "fitting"))
            fitted = with_empirical_covariance(clipped(calset, chosen, clip))
        say(Stage("looking for patterns in the residuals", "examining"))
        result = examined(fitted, job.seed)
        accuracy = accuracy_of_fit(result, wanted)
    many = result.likelihood.layout.large or calset.fine is not None
    mapped = output is not None and many and result.converged
    residuals = residual_map(result) if mapped else None
    misfit = describe(result) if output is not None and not result.explains_data else None
    verdict, shown = verdict_of_fit(result, accuracy), shown_with_accuracy(result, accuracy)
    # Warnings are printed apart.
    shown = dataclasses.replace(shown, notes=tuple(n for n in shown.notes if n not in result.warnings))
    rows, cameras = result.clipped, result.model.template.cameras.names
    brief = dataclasses.replace(shown, rows=(), notes=()).text()
    written = "" if output is None else f"Written to {output}."
    options = {"instrument": instrument, "effects": effects}
    outcome = Outcome(
        result,
        summary(
            result,
            seconds=job.seconds,
            accuracy=accuracy_document(accuracy),
            misfit=misfit,
            residuals=residuals,
        ),
        extra={"seed": job.seed, **verdict.answers()},
        display=shown,
        text=None if result.trusted else f"{brief}\n{written}",
        below=written,
        files={
            PRODUCT: lambda path: write_calibration(path, Calibration.from_fit(result, residuals)),
            CLIPPED: None if rows is None else lambda path: rows.write(path, calset, cameras),
        },
        saved_as=SUMMARY,
        drop=(FAILED,),
        next=next_steps(result.trusted, output, data, **options),
        warnings=result.warnings if misfit is None else misfit.reasons(result.warnings, output),
        trusted=result.trusted,
    )
    if job.folder is not None:
        job.tell("mapping the field", "mapping")
    if result.converged:
        return outcome
    if job.folder is not None:
        job.folder.path.mkdir(exist_ok=True)
        write_text(job.folder.path / FAILED, json_text(outcome.content), overwrite=True)
    failure = f"{output}: the fit did not converge ({result.minimum.message}); see {FAILED} there"
    return dataclasses.replace(outcome, text="", warnings=(), failure=failure, files={}, saved_as="")


def next_steps(trusted: bool, output: Any, data: Sets, **options: object) -> tuple[str, ...]:
    """Command lines to type after a fit; `options` are those that a diagnosis of the sets needs as well."""
    if output is None or trusted:
        return after_fit(output)
    diagnose = typed("diagnose", *paths_of(data), *given(**options), "-o", f"{output}_diagnosis")
    return (*after_fit(output, usable=False), diagnose)

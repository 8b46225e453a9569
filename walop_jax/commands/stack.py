"""`walop-jax stack`: many nights of one instrument under laws of time, and the changes between them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Option, Outcome, UsageError, after_fit, command, several
from walop_jax.commands.products import CalibrationLike, Effects, calibration_of, catalogue_of, fit_of
from walop_jax.io.names import CLIPPED, NIGHTS, PRODUCT, REFERENCE, SURVEY, TRACKS

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from walop_jax.nights.survey import Survey


OPTIONS = {
    "nights": Option(
        "Calibration sets, folders of refit, or a SURVEY.", metavar="NIGHT...", kind=list[Path], placed=True
    ),
    "laws": Option(
        "Model file with [law] tables (default: that of the first fit).", metavar="MODEL.toml", kind=Path
    ),
    "like": Option(
        "Fit with the model of all nights (default: the first RUN or SURVEY given).", metavar="RUN", kind=Path
    ),
    "events": Option("Table of works on the instrument: MJD, WHAT.", metavar="TABLE", kind=Path),
    "no_breaks": Option("Do not look for breaks."),
    "workers": Option(
        "Make nights in so many processes of this machine, by Dask.", metavar="N", kind=int, least=1
    ),
    "scheduler": Option(
        "Make nights on the workers of a Dask cluster that share the files.", metavar="ADDRESS", kind=str
    ),
    "output": Option("Folder of the survey.", metavar="SURVEY", kind=Path, short="-o", required=True),
}


@command(stages=("reading", "stacking"), writes=(NIGHTS, REFERENCE, PRODUCT, TRACKS, SURVEY), options=OPTIONS)
def stack(
    job: Job,
    nights: Any,
    laws: Any = None,
    *,
    like: CalibrationLike | None = None,
    events: Any = None,
    no_breaks: bool = False,
    workers: int | None = None,
    scheduler: str | Executor | None = None,
    output: Any = None,
    effects: Effects = None,
) -> Outcome[Survey]:
    """Fit many nights at once, each parameter under a law of its change with time.

    Breaks of any parameter, or of an effect that the model lacks, are looked for, named and dated, and become laws.
    Laws are given in the [law] tables of a model file: a value for each night or file, a random walk, intervals, steps,
    drifts, annual terms; parameters without one are shared by all nights (walop-jax docs nights). A night is linearised
    at the values of a fit, and again at the common solution; its normal equations are kept, so that it need not be read
    again.

    SURVEY holds the nights (nights.fits), every parameter against time (tracks.fits), the calibration of the last night
    (calibration.fits), that about which nights are linearised, with the laws (reference.fits), and survey.json. Nights
    that are made stay in SURVEY/partial until the end: the same command resumes an interrupted stack. walop-jax apply
    SURVEY takes the calibration of the MJD of its stars. Exit code 3 if the laws do not explain the nights.

    Nights are made by Dask on a cluster, or in processes of this machine, with --scheduler or --workers: the survey is
    the same to the last digit, and a worker that is lost is replaced (walop-jax docs nights).

    In Python: a `Survey`; nights may be fits and sets in memory, `laws` a mapping of names to [law] tables,
    `scheduler` any `concurrent.futures.Executor`.

    >>> walop.stack(["night1.fits", "night2.fits"]).trusted  # doctest: +SKIP
    """
    from walop_jax.likelihood.workers import executor_of
    from walop_jax.nights.stacking import PARTIAL
    from walop_jax.nights.stacking import stack as stacked
    from walop_jax.nights.survey_folder import writers

    if workers is not None and scheduler is not None:
        raise UsageError("workers and scheduler exclude each other: a cluster has workers", "scheduler")
    sources = [fit_of(night) for night in several(nights)]
    with executor_of(workers, scheduler) as executor:
        job.begin("reading")
        survey = stacked(
            sources,
            laws,
            like=None if like is None else calibration_of(like, effects),
            find=not no_breaks,
            events=events,
            partial=None if output is None else Path(output) / PARTIAL,
            executor=executor,
            tell=lambda text: job.tell(text, "stacking"),
            catalogue=catalogue_of(effects),
        )
    return Outcome(
        survey,
        files=writers(survey),
        saved_as=SURVEY,
        drop=(PARTIAL, CLIPPED),
        warnings=survey.verdict.warnings,
        trusted=survey.trusted,
        next=after_fit(output, usable=survey.trusted),
    )

"""`walop-jax diagnose`: find effects missing from the model, name and add them, show the gap shrink."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Option, Outcome, PathLike, UsageError, after_fit, command
from walop_jax.commands.inputs import (
    ModelLike,
    Sets,
    accuracy_document,
    paths_of,
    set_and_model,
    shown_with_accuracy,
)
from walop_jax.commands.products import Effects, InstrumentLike
from walop_jax.io.folder import output_folder
from walop_jax.io.names import CLIPPED, DIAGNOSIS, FIGURE_DATA, MODEL, PRODUCT, SUMMARY
from walop_jax.io.progress import repeated
from walop_jax.io.run_folder import RunFolder
from walop_jax.io.text import json_text

if TYPE_CHECKING:
    from walop_jax.diagnosis.findings import Diagnosis

OUTPUTS = (PRODUCT, SUMMARY, DIAGNOSIS, FIGURE_DATA, MODEL)


OPTIONS = {
    "output": Option("Folder of the results.", metavar="RUN", kind=Path, short="-o"),
    "minutes": Option(
        "Minutes after which no further name is looked for (default: none; the search ends by itself).",
        metavar="MINUTES",
        kind=float,
        least=0.0,
    ),
    "why": Option(
        "Answer why an effect, or a description, was not named by a diagnosis that has been made; give its RUN.",
        metavar="NAME",
        kind=str,
    ),
}


@command(
    stages=("reading", "fitting", "scoring", "naming", "mapping"),
    writes=OUTPUTS,
    random=True,
    options=OPTIONS,
)
def diagnose(
    job: Job,
    data: Sets,
    model: ModelLike = None,
    *,
    output: PathLike | None = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
    minutes: float | None = None,
    why: str | None = None,
) -> Outcome[Diagnosis]:
    """Find the effects that the model lacks, add them, and fit again: RUN/diagnosis.json and RUN/calibration.fits.

    The verdict is consistent, effect_found, unexplained, or wrong_number: a number that the set states explains all.
    Effects that the data cannot separate are listed together; effects that the data cannot show at all are listed as
    such. RUN/calibration.fits and RUN/summary.json are of the extended model, and RUN/model.toml is that model, for
    `refit --model` and `compare --model`;
    `walop-jax report` draws its figures from RUN/diagnosis.fits. Exit code 3 where that calibration is not to be
    trusted, whatever was found.

    `--why NAME RUN` fits nothing: it prints from RUN/diagnosis.json the reason for which NAME was not named, with the
    numbers.

    In Python: a `Diagnosis`, whose `why(name)` gives that answer; `effects=(*walop.EFFECTS, MyEffect)` adds one of your
    own to those that may be named.

    >>> walop.diagnose("night.fits", progress=print).verdict  # doctest: +SKIP
    """
    from walop_jax.diagnosis.workflow import diagnose as diagnosis_of

    if why is not None:
        if output is not None:
            raise UsageError("an answer is printed, not written: leave it out beside --why", "output")
        return _why(why, data)
    if job.typed and output is None:
        raise UsageError("Missing option '--output' / '-o'.", "output")
    job.begin("reading")
    calset, chosen = set_and_model(data, model, instrument, effects, output=output)
    with repeated(job.progress) as say:
        diagnosis = diagnosis_of(calset, chosen, seed=job.seed, minutes=minutes, progress=say)
    return outcome_of(job, diagnosis, output)


def outcome_of(job: Job, found: Diagnosis, output: PathLike | None) -> Outcome[Diagnosis]:
    """Outcome of a diagnosis: all that is printed and written of it."""
    from walop_jax.calibration.product import write_calibration
    from walop_jax.calibration.summary import summary
    from walop_jax.diagnosis.figure_data import figure_data, write_figure_data
    from walop_jax.diagnosis.findings import document, of_diagnosis
    from walop_jax.fit.misfit import describe
    from walop_jax.fit.model_file import render
    from walop_jax.science.field_accuracy import accuracy_of_fit, verdict_of_fit

    product, after = found.calibration(), found.after
    complete = found.complete
    usable, shown = after.trusted and complete, found.display()
    accuracy, verdict = accuracy_of_fit(after), None
    if after.verdict is not None:
        fit = verdict_of_fit(after, accuracy, complete=complete)
        verdict = of_diagnosis(fit, found.unexplained, found.subject, complete=complete)
    if accuracy is not None:
        shown = dataclasses.replace(shown, facts=(*shown.facts, *accuracy.facts(complete=complete)))

    def write_summary(path: Path) -> None:
        job.tell("mapping the field", "mapping")
        misfit = None if after.explains_data else describe(after)
        fitted = summary(after, seconds=found.seconds, accuracy=accuracy_document(accuracy), misfit=misfit)
        shown_fit = shown_with_accuracy(after, accuracy).document()
        path.write_text(json_text(fitted | {"seed": job.seed, "shown": shown_fit}), encoding="utf-8")

    return Outcome(
        found,
        document(found),
        extra={} if verdict is None else verdict.answers(),
        display=shown if verdict is None else verdict.on_top_of(shown),
        below="" if output is None else f"Written to {output}.",
        files={
            SUMMARY: write_summary,
            PRODUCT: lambda path: write_calibration(path, product),
            FIGURE_DATA: lambda path: write_figure_data(path, figure_data(found)),
            MODEL: render(after.model),
        },
        saved_as=DIAGNOSIS,
        drop=(CLIPPED,),
        warnings=after.warnings,
        trusted=usable,
        next=after_fit(output, usable=usable),
    )


def _why(name: str, data: Sets) -> Outcome[Any]:
    """The answer of a run to why something was not named."""
    from walop_jax.diagnosis.reasons import why

    paths = paths_of(data)
    if len(paths) != 1:
        raise UsageError("give the folder of one diagnosis", "data")
    run = RunFolder(Path(paths[0]))
    run.wanted(DIAGNOSIS, "give the RUN of walop-jax diagnose")
    answer = why(run.document(DIAGNOSIS, ("steps", "candidates")), name)
    return Outcome(answer, {"name": name, "answer": answer.splitlines()}, answer)


def write(found: Diagnosis, folder: PathLike, *, overwrite: bool = False) -> None:
    """Write a diagnosis as the folder that the command makes."""
    with output_folder(folder, OUTPUTS, overwrite=overwrite) as out:
        outcome_of(Job(), found, folder).save(out)

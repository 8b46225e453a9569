"""`walop-jax refit`: the joint fit of calibration sets, resumed where it was interrupted."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from walop_jax.commands.command import Job, Option, Outcome, Writers, command
from walop_jax.commands.inputs import (
    Effects,
    Folder,
    InstrumentLike,
    Memory,
    ModelLike,
    PathLike,
    Sets,
    in_bytes,
    paths_of,
    set_and_model,
)

if TYPE_CHECKING:
    from walop_jax import FitResult
    from walop_jax.likelihood.runner import Processes

STAGES = ("reading", "fitting", "examining", "mapping")
"""Of the progress, also of the commands that fit and do more."""

ProcessesOption = Option(
    "Share a large set with other processes that run the same command; auto: as Slurm or Open MPI say.",
    "INDEX/COUNT@HOST:PORT",
    str,
)


@command(stages=STAGES, writes=(), random=True)
def refit(
    job: Job,
    data: Sets,
    model: ModelLike = None,
    *,
    output: Folder = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
    memory: Memory = 2.0,
    processes: Annotated[Processes | str | None, ProcessesOption] = None,
    folder: PathLike | None = None,
) -> Outcome[FitResult]:
    """Fit all field points of calibration sets jointly: RUN/calibration.fits and RUN/summary.json.

    RUN is created if necessary. If it holds a calibration already, the command stops unless --overwrite is given;
    then these two files are replaced and all others stay.

    A fit that does not converge leaves RUN/summary.failed.json, no calibration, and exit code 1. One that
    converges but is not to be trusted (it does not explain the data, a parameter lies far from its prior, the
    residuals hold patterns or differ between parts of the data) is written with TRUSTED = F and warnings, exit
    code 3.

    Sets of more than 65536 points (whole frames) are read in slabs on every pass. Finished slabs are kept in
    RUN/partial until the end, so that the same command resumes an interrupted fit. The calibration then holds a map of
    what the smooth model leaves.

    In Python: the fit. Without `output`, finished slabs are kept in `folder` (default: nowhere), and the same call
    goes on from them. Raises `DataError` for data that cannot be trusted, ValueError for a model that does not fit.

    >>> result = walop.refit(calset)  # doctest: +SKIP
    >>> result["pupil.magnification"]
    15.6675 ± 0.0051
    """
    from walop_jax import Calibration
    from walop_jax.calibration import FAILED, PARTIAL, PRODUCT, SUMMARY, summary, write_calibration
    from walop_jax.calibration.residual_map import residual_map
    from walop_jax.diagnosis.trust import examined
    from walop_jax.fit.misfit import describe
    from walop_jax.fit.refit import refit as fit
    from walop_jax.io.atomic import atomic_path, remove
    from walop_jax.io.progress import Stage
    from walop_jax.io.text import json_text
    from walop_jax.science.field_accuracy import answered

    if output is not None and folder is not None:
        raise ValueError("with output, finished slabs are kept in its folder partial: leave folder out")
    with _crew(processes) as crew:
        first = crew.index == 0
        tell = job.progress if first or not job.typed else lambda text: None
        job = dataclasses.replace(job, progress=tell)
        # Of several processes the first one writes; it alone holds the folder.
        with job.reserved(output if first else None, (PRODUCT, SUMMARY)) as job:
            job.begin("reading")
            calset, chosen = set_and_model(data, model, instrument, effects, output=output)
            kept = folder if output is None else Path(output) / PARTIAL
            with job.repeated() as say:
                fitted = fit(
                    calset, chosen, folder=kept, progress=say, memory=in_bytes(memory), processes=crew
                )
                say(Stage("looking for patterns in the residuals", "examining"))
                result = answered(examined(fitted, job.seed))
            wanted = output is not None
            mapped = wanted and result.likelihood.layout.large and result.converged
            residuals = residual_map(result) if mapped else None
            misfit = describe(result) if wanted and first and not result.explains_data else None
            seconds = job.seconds

            def files() -> Writers:
                product = Calibration.from_fit(result, residuals)
                return {PRODUCT: lambda path: write_calibration(path, product)}

            found = Outcome(
                result,
                lambda: (
                    summary(result, seconds=seconds, misfit=misfit, residuals=residuals) | {"seed": job.seed}
                ),
                lambda: (
                    f"{dataclasses.replace(result.display(), notes=result.notes).text()}\n"
                    f"The calibration can{'' if result.trusted else 'not'} be trusted; written to {output}."
                ),
                files,
                saved_as=SUMMARY,
                next=next_steps(result.trusted, output, data, instrument=instrument, effects=effects),
                warnings=(*result.warnings, *(() if misfit is None else misfit.sentences())),
                trusted=result.trusted,
                silent=not first,
            )
            if not result.converged:
                found = dataclasses.replace(
                    found,
                    text=str,
                    warnings=(),
                    failure=f"{output}: the fit did not converge ({result.minimum.message}); see {FAILED} there",
                )
            if job.folder is None:
                return found
            job.tell("mapping the field", "mapping")
            if result.converged:
                return found.save(job.folder, drop=(FAILED, PARTIAL))
            job.folder.path.mkdir(exist_ok=True)
            with atomic_path(job.folder.path / FAILED, overwrite=True) as temporary:
                temporary.write_text(json_text(found.content), encoding="utf-8")
            remove(job.folder.path / PARTIAL)
            return found


def next_steps(trusted: bool, output: PathLike | None, data: Sets, **options: object) -> tuple[str, ...]:
    """Command lines to type after a fit; `options` are those that a diagnosis of the sets needs as well."""
    if trusted:
        return (f"walop-jax report {output}", f"walop-jax apply {output} STARS.fits -o OUT.fits")
    sets = " ".join(str(path) for path in paths_of(data)) if output is not None else "CALSET"
    more = "".join(f" --{name} {value}" for name, value in options.items() if isinstance(value, str | Path))
    return (f"walop-jax report {output}", f"walop-jax diagnose {sets}{more} -o {output}_diagnosis")


@contextlib.contextmanager
def _crew(processes: Processes | str | None) -> Iterator[Processes]:
    """The processes of a computation; a text says where they are to be joined.

    When one that was joined here fails it ends at once, with its line of error: the others notice that it has gone.
    """
    from walop_jax.likelihood.runner import Processes, join

    if not isinstance(processes, str):
        yield processes or Processes()
        return

    with _standard_output_to_error():
        crew = join(processes)
    try:
        yield crew
    except BaseException as error:
        from walop_jax.commands.program import complain

        complain(f"process {crew.index} of {crew.count}: {error or type(error).__name__}")
        sys.stderr.flush()
        os._exit(1)  # without waiting for the others, which may have gone


@contextlib.contextmanager
def _standard_output_to_error() -> Iterator[None]:
    """Send what a library prints to standard error: it must not end up in the machine-readable result."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)

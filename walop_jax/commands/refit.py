"""`walop-jax refit`: the joint fit of calibration sets."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Outcome, Writers, command
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

STAGES = ("reading", "fitting", "examining", "mapping")
"""Of the progress, also of the commands that fit and do more."""


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
) -> Outcome[FitResult]:
    """Fit all field points of calibration sets jointly: RUN/calibration.fits and RUN/summary.json.

    RUN is created if necessary. If it holds a calibration already, the command stops unless --overwrite is given;
    then these two files are replaced and all others stay.

    A fit that does not converge leaves RUN/summary.failed.json, no calibration, and exit code 1. One that
    converges but is not to be trusted (it does not explain the data, a parameter lies far from its prior, the
    residuals hold patterns or differ between parts of the data) is written with TRUSTED = F and warnings, exit
    code 3.

    Sets of more than 65536 points (whole frames) are read in slabs on every pass. The calibration then holds a map of
    what the smooth model leaves.

    In Python: the fit. Raises `DataError` for data that cannot be trusted, ValueError for a model that does not fit.

    >>> result = walop.refit(calset)  # doctest: +SKIP
    >>> result["pupil.magnification"]
    15.6675 ± 0.0051
    """
    from walop_jax import Calibration
    from walop_jax.calibration.product import write_calibration
    from walop_jax.calibration.residual_map import residual_map
    from walop_jax.calibration.summary import summary
    from walop_jax.diagnosis.trust import examined
    from walop_jax.fit.misfit import describe
    from walop_jax.fit.refit import refit as fit
    from walop_jax.io.atomic import atomic_path
    from walop_jax.io.names import FAILED, PRODUCT, SUMMARY
    from walop_jax.io.progress import Stage
    from walop_jax.io.text import json_text
    from walop_jax.science.field_accuracy import answered

    with job.reserved(output, (PRODUCT, SUMMARY)) as job:
        job.begin("reading")
        calset, chosen = set_and_model(data, model, instrument, effects, output=output)
        with job.repeated() as say:
            fitted = fit(calset, chosen, progress=say, memory=in_bytes(memory))
            say(Stage("looking for patterns in the residuals", "examining"))
            result = answered(examined(fitted, job.seed))
        wanted = output is not None
        mapped = wanted and result.likelihood.layout.large and result.converged
        residuals = residual_map(result) if mapped else None
        misfit = describe(result) if wanted and not result.explains_data else None
        seconds = job.seconds

        def files() -> Writers:
            product = Calibration.from_fit(result, residuals)
            return {PRODUCT: lambda path: write_calibration(path, product)}

        found = Outcome(
            result,
            lambda: summary(result, seconds=seconds, misfit=misfit, residuals=residuals) | {"seed": job.seed},
            lambda: (
                f"{dataclasses.replace(result.display(), notes=result.notes).text()}\n"
                f"The calibration can{'' if result.trusted else 'not'} be trusted; written to {output}."
            ),
            files,
            saved_as=SUMMARY,
            next=next_steps(result.trusted, output, data, instrument=instrument, effects=effects),
            warnings=(*result.warnings, *(() if misfit is None else misfit.sentences())),
            trusted=result.trusted,
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
            return found.save(job.folder, drop=(FAILED,))
        job.folder.path.mkdir(exist_ok=True)
        with atomic_path(job.folder.path / FAILED, overwrite=True) as temporary:
            temporary.write_text(json_text(found.content), encoding="utf-8")
        return found


def next_steps(trusted: bool, output: PathLike | None, data: Sets, **options: object) -> tuple[str, ...]:
    """Command lines to type after a fit; `options` are those that a diagnosis of the sets needs as well."""
    if trusted:
        return (f"walop-jax report {output}", f"walop-jax apply {output} STARS.fits -o OUT.fits")
    sets = " ".join(str(path) for path in paths_of(data)) if output is not None else "CALSET"
    more = "".join(f" --{name} {value}" for name, value in options.items() if isinstance(value, str | Path))
    return (f"walop-jax report {output}", f"walop-jax diagnose {sets}{more} -o {output}_diagnosis")

"""`walop-jax limits`: sizes of effects that a calibration set can show, before anything is found in it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Option, Outcome, PathLike, command, figure_file, typed
from walop_jax.commands.inputs import ModelLike, Sets, paths_of, set_and_model
from walop_jax.commands.products import Effects, InstrumentLike, catalogue_of, fit_of
from walop_jax.io.names import LIMITS, PRODUCT

if TYPE_CHECKING:
    from walop_jax import FitResult, ObservingPlan
    from walop_jax.diagnosis.detection_limits import DetectionLimits
    from walop_jax.diagnosis.findings import Diagnosis

PROTECTION, SEPARATION = "limits_protection.png", "limits_separation.png"


OPTIONS = {
    "data": Option(
        "Calibration sets (FITS), fitted as one, or an observing plan in place of them.",
        metavar="CALSET...|PLAN.toml",
        kind=list[Path],
        placed=True,
    ),
    "output": Option(
        "Folder for limits.json and its two figures; it may be that of a fit of the same sets.",
        metavar="RUN",
        kind=Path,
        short="-o",
    ),
}


@command(
    stages=("reading", "fitting", "differentiating", "comparing", "unnoticed"),
    writes=(LIMITS, PROTECTION, SEPARATION),
    random=True,
    options=OPTIONS,
)
def limits(
    job: Job,
    data: FitResult | Diagnosis | ObservingPlan | Sets,
    model: ModelLike = None,
    *,
    output: PathLike | None = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
) -> Outcome[DetectionLimits]:
    """Compute the size at which every effect would be detected and named in calibration sets.

    It also gives the largest error of q and u that a single effect too small to be detected can make over the field. An
    observing plan (TOML, see walop-jax docs files) gives the same before any data are taken, over instruments as they
    may be built.

    In Python: `DetectionLimits`, for a fit, an observing plan, or what `refit` takes; its `to_table()` has a row for
    each effect and parameter. Raises ValueError for a fit that does not converge.

    >>> walop.limits("night.fits").protection_in_words()  # doctest: +SKIP
    """
    from walop_jax import FitResult, ObservingPlan
    from walop_jax.diagnosis.detection_limits import DetectionLimits, detection_limits
    from walop_jax.diagnosis.planned_limits import INSTRUMENTS, over_instruments
    from walop_jax.diagnosis.trust import examined
    from walop_jax.fit.refit import refit
    from walop_jax.reports.diagnosis_figures import protection_figure, separation_figure
    from walop_jax.simulation.observing_plan import is_plan, read_plan
    from walop_jax.simulation.simulate import simulate

    job.begin("reading")
    data, plan_file = fit_of(data), None
    plan = data if isinstance(data, ObservingPlan) else None
    if isinstance(data, str | os.PathLike | Sequence):
        paths = paths_of(data)
        if len(paths) == 1 and is_plan(paths[0]):
            plan_file, plan = paths[0], read_plan(paths[0], instrument)  # pyright: ignore[reportArgumentType]
    kinds = None if effects is None else catalogue_of(effects)
    design = instrument if plan is None else plan.design
    results, of_sets = list[FitResult](), list[DetectionLimits]()
    for number in range(1 if plan is None else INSTRUMENTS):
        progress = _of_instrument(job, number)
        if isinstance(data, FitResult):
            result = data
        else:
            taken = data if plan is None else simulate(plan, job.seed + number, noiseless=True).calset
            calset, chosen = set_and_model(taken, model, design, effects)  # pyright: ignore[reportArgumentType]
            result = examined(refit(calset, chosen, progress=progress), job.seed)
        if not result.converged:
            raise ValueError(f"the fit did not converge ({result.minimum.message})")
        results.append(result)
        of_sets.append(detection_limits(result, catalogue=kinds, seed=job.seed, progress=progress))
    limits_of_data, result = over_instruments(of_sets), results[0]
    steps = ()
    if output is not None:
        available = plan_file or instrument or result.model.name
        steps = typed("report", output), _plan(available, Path(output), result)
    return Outcome(
        limits_of_data,
        extra={
            "instrument": result.model.name,
            "effects_of_the_model": list(result.model.effect_names),
            "inputs": [{"path": str(entry.path), "sha256": entry.sha256} for entry in result.calset.inputs],
            "plan": None if plan is None else plan.document(),
            "trusted": all(one.trusted for one in results),
            "seed": job.seed,
        },
        files={
            PROTECTION: figure_file(protection_figure, limits_of_data),
            SEPARATION: figure_file(separation_figure, limits_of_data),
        },
        saved_as=LIMITS,
        next=steps,
        warnings=tuple(f"the fit: {text}" for text in result.warnings),
    )


def _of_instrument(job: Job, number: int) -> Callable[[str], None]:
    """Progress with one of the instruments of a plan, from 0: the stages are those of the first."""
    return job.progress if not number else lambda text: job.progress(f"instrument {number + 1}: {text}")


def _plan(available: object, output: Path, result: FitResult) -> str:
    """The command that plans better exposures: beside a fit, or of what is `available`."""
    if len(result.model.template.cameras.pairs) != 2:
        return ""  # which error is to be small is for the user to say
    if (output / PRODUCT).exists():
        return typed("plan", output, "--minutes", "10")
    return typed("plan", available, "--minutes", "30")

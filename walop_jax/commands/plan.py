"""`walop-jax plan`: which calibration exposures to take in the time there is, with a proof."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import (
    Job,
    Option,
    Outcome,
    PathLike,
    UsageError,
    command,
    several,
    typed,
    write_text,
)
from walop_jax.commands.products import CalibrationLike, Effects, calibration_of, catalogue_of, is_product
from walop_jax.io.atomic import check_output
from walop_jax.io.names import PLANNED
from walop_jax.io.progress import repeated
from walop_jax.io.text import json_text

if TYPE_CHECKING:
    from walop_jax import ObservingPlan
    from walop_jax.plans.plan import ExposurePlan

PLAN, INSTRUMENT = "plan.toml", "instrument.toml"


OPTIONS = {
    "available": Option(
        "Candidate exposures: a plan file, an instrument by name, or the RUN to add to.",
        metavar="[PLAN.toml|INSTRUMENT|RUN]",
        kind=Path,
        placed=True,
    ),
    "minutes": Option(
        "Time for exposures, read-out, pointing and changes, in minutes.",
        metavar="MINUTES",
        kind=float,
        least=0.0,
    ),
    "candidates": Option("Candidate exposures of a RUN or an instrument.", metavar="PLAN.toml", kind=Path),
    "criterion": Option(
        "Quantity to be known best: worst (default: the largest error of p over field and colour), mean, "
        "a parameter, a table of stars (X, Y in degrees, Q, U), or apart: effects that --apart names, or "
        "those that a diagnosis of RUN could not separate.",
        metavar="NAME|TABLE",
        kind=str,
    ),
    "goal": Option(
        "A value of the criterion, in % for errors of p: print the time that it takes.",
        metavar="VALUE",
        kind=float,
    ),
    "after": Option("A calibration that is there already: plan what to add to it.", metavar="RUN", kind=Path),
    "apart": Option(
        "Effect to be separated from the others, NAME=VALUE as for simulate, or NAME alone for one that "
        "is a rival only. Give it twice or more.",
        metavar="NAME=VALUE",
        kind=list[str],
    ),
    "separate": Option(
        "A diagnosis that left a class: plan one exposure, or two that differ, that separate its members.",
        metavar="RUN",
        kind=Path,
    ),
    "draws": Option("Instruments, drawn from the priors, that the plan is made for.", kind=int, least=1),
    "schedule": Option(
        "Write the exposures as a schedule of the survey (format v4).", metavar="FILE.json", kind=Path
    ),
    "words": Option(
        "Numbers of filters and facts of a schedule; see walop-jax docs files.",
        metavar="WORDS.toml",
        kind=Path,
    ),
    "output": Option(
        "Folder for plan.toml and plan.json; without it the plan is printed only.",
        metavar="RUN",
        kind=Path,
        short="-o",
    ),
}


@command(
    stages=("information", "searching"),
    writes=(PLAN, INSTRUMENT, PLANNED),
    random=True,
    outputs=("output", "schedule"),
    options=OPTIONS,
)
def plan(
    job: Job,
    available: ObservingPlan | CalibrationLike | None = None,
    *,
    minutes: float = 30.0,
    candidates: Any = None,
    criterion: Any = "worst",
    goal: float | None = None,
    after: Any = None,
    apart: Any = None,
    separate: Any = None,
    draws: int = 20,
    effects: Effects = None,
    schedule: PathLike | None = None,
    words: PathLike | None = None,
    output: PathLike | None = None,
) -> Outcome[ExposurePlan]:
    """Plan the calibration exposures of a night: those that make the error of p smallest where it is largest.

    Candidate exposures are given by a plan file (see `walop-jax docs files`): filters, settings of the calibration
    plate, Moon patches, standards, exposure times, costs. The polariser may stand at every multiple of 1.5°; the plate
    of an INSTRUMENT, of a RUN, or where the file says so, at every multiple of 7.5°. Printed are the exposures in
    order, the errors that they promise, and a bound that no plan of the same time undercuts. RUN/plan.toml is the plan
    for `simulate` and `limits`, RUN/plan.json holds all numbers; --schedule writes it for the telescope.

    `--separate RUN` plans what a diagnosis left undecided: one exposure, or two that differ, repeated for the time
    there is, for which the least expected Δχ² between any two members of the class is largest. Each pair is printed.

    In Python: an `ExposurePlan`, whose `observing_plan` is the plan for `simulate`. Raises ValueError for a time that
    pays for nothing or determines nothing.

    >>> walop.plan(walop.ObservingPlan(grid=3), minutes=20.0)  # doctest: +SKIP
    """
    from walop_jax import ObservingPlan
    from walop_jax.data.user_tables import read_input_table
    from walop_jax.model.effects.in_models import known_effects
    from walop_jax.plans.available import Available, plan_beside
    from walop_jax.plans.criteria import check_wishes, effects_alike
    from walop_jax.plans.plan import plan_exposures
    from walop_jax.plans.schedule import scheduled
    from walop_jax.plans.separating import class_of_run
    from walop_jax.simulation.observing_plan import plan_text

    check_wishes(minutes, goal, draws)
    if schedule is not None:
        check_output(schedule, overwrite=job.overwrite)
    elif words is not None:
        raise UsageError("these are words of a schedule; see --schedule", "words")
    if separate is not None:
        wishes = {"after": after, "apart": apart, "goal": goal}
        wishes |= {
            "criterion": None if criterion == "worst" else criterion,
            "draws": None if draws == 20 else draws,
        }
        if given := [name for name, wish in wishes.items() if wish is not None]:
            raise UsageError("leave it out beside --separate, which takes all from its RUN", given[0])
        after, available = separate, "" if available is None else available
    elif available is None and after is None:
        raise UsageError("give a plan file, an instrument or a RUN", "available")
    available = "" if available is None else available
    is_plan = isinstance(available, ObservingPlan) or available == ""
    if not is_plan and (not isinstance(available, str | os.PathLike) or is_product(available)):
        if after is not None:
            raise UsageError("one calibration can be added to: the RUN, or that of --after", "after")
        after, available = available, ""
    prior = None if after is None else calibration_of(after, effects)
    catalogue = catalogue_of(effects) if effects is not None or prior is None else known_effects(prior.model)
    alike = tuple(several(apart or ()))
    if criterion == "apart" and not alike:
        if prior is None:
            raise UsageError("give the effects to be separated, or a RUN of diagnose", "apart")
        alike = effects_alike(after, prior)
    undecided = None if separate is None or prior is None else class_of_run(after, prior)
    if candidates is None and available == "" and prior is not None:
        available = plan_beside(prior)
    table = Path(str(criterion))
    chosen = read_input_table(criterion) if table.suffix and table.exists() else criterion
    possible = Available.of(available if candidates is None else candidates)  # pyright: ignore[reportArgumentType]
    if candidates is not None and str(available).upper() not in ("", name := possible.plan.name):
        raise UsageError(f"these are for {name}: beside them give {name}, or a RUN of it", "candidates")
    job.tell("information of exposures", "information")
    possible = possible if schedule is None else possible.in_whole_seconds()
    with repeated(job.progress) as say:
        best = functools.partial(
            plan_exposures, minutes=minutes, criterion=chosen, known=prior, goal=goal, draws=draws, apart=alike,
            separate=undecided, catalogue=catalogue, seed=job.seed, progress=say,
        )  # fmt: skip
        planned = best(possible)
        if possible.doubts(planned.observing_plan):
            with contextlib.suppress(ValueError):  # then the plan is as it is, with its doubts
                planned = best(dataclasses.replace(possible, throughout=minutes))
    described = planned.observing_plan.design.description
    toml = plan_text(planned.observing_plan, INSTRUMENT if described else None)
    remarks, steps = (), ()
    if schedule is not None:
        content, remarks = scheduled(planned.observing_plan, words, schedule)
        write_text(schedule, json_text(content), overwrite=job.overwrite)
    if output is not None:
        steps = typed("report", output), typed("simulate", Path(output) / PLAN, "-o", "SET.fits")
    return Outcome(
        planned,
        extra={"seed": job.seed},
        files={PLAN: toml, INSTRUMENT: described or None},
        saved_as=PLANNED,
        warnings=remarks,
        next=steps,
    )

"""`walop-jax plan`: which calibration exposures to take in the time there is, with a proof."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from walop_jax.commands.command import Argument, Job, Option, Outcome, Writers, command, text_file
from walop_jax.commands.inputs import Folder, PathLike, calibration_of
from walop_jax.io.errors import fail

if TYPE_CHECKING:
    from walop_jax import ObservingPlan
    from walop_jax.plans.plan import ExposurePlan

PLAN, RESULT = "plan.toml", "plan.json"

Could = Annotated[
    "ObservingPlan | PathLike",
    Argument("What could be observed: a plan file, or an instrument by name.", "PLAN.toml|INSTRUMENT", Path),
]
After = Annotated[Any, Option("A calibration that is there already: plan what to add to it.", "RUN", Path)]
Minutes = Annotated[
    float, Option("Time for exposures, read-out and pointing, in minutes.", "MINUTES", float, least=0.0)
]
Draws = Annotated[
    int, Option("Instruments, drawn from the priors, that the plan is made for.", kind=int, least=1)
]


@command(stages=("information", "searching"), writes=(PLAN, RESULT), random=True)
def plan(
    job: Job,
    could: Could,
    *,
    minutes: Minutes = 30.0,
    after: After = None,
    draws: Draws = 20,
    output: Folder = None,
) -> Outcome[ExposurePlan]:
    """Plan the calibration exposures of a night: those that make the error of p smallest where it is largest.

    What could be observed is said by a plan file (see `walop-jax docs files`): filters, settings of the calibration
    plate, Moon patches, standards. The polariser may stand at any angle. Printed are the exposures, the error of p that
    they promise, and the least that any plan of the same time could reach, which is proven. RUN/plan.toml is the plan
    for `simulate` and `limits`, RUN/plan.json holds all numbers.

    In Python: the plan. Raises ValueError for a time that pays for nothing or determines nothing.
    """
    from walop_jax import ObservingPlan
    from walop_jax.plans.plan import plan_exposures
    from walop_jax.simulation.plan_file import is_plan, plan_text, read_plan

    if isinstance(could, ObservingPlan):
        wanted = could
    elif is_plan(could):
        wanted = read_plan(could)
    else:
        wanted = ObservingPlan(str(could))
    if not minutes > 0:
        raise fail("nothing can be observed in no time", advice="give --minutes")
    known = None if after is None else calibration_of(after)
    job.tell("information of exposures", "information")
    with job.repeated() as say:
        found = plan_exposures(wanted, minutes, known=known, draws=draws, seed=job.seed, progress=say)

    def files() -> Writers:
        return {PLAN: text_file(plan_text(found.observing_plan))}

    return Outcome(
        found,
        lambda: found.document() | {"seed": job.seed},
        files=files,
        saved_as=RESULT,
    )

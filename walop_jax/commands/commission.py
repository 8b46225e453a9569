"""`walop-jax commission`: from the exposures of a night to a calibration, go or no-go, and what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Outcome, command, command_of
from walop_jax.commands.inputs import Effects, Folder, InstrumentLike, ModelLike, Sets
from walop_jax.commands.refit import STAGES, refit

if TYPE_CHECKING:
    from walop_jax.science.commissioning import Commissioning


@command(stages=STAGES, writes=(), random=True)
def commission(
    job: Job,
    data: Sets,
    model: ModelLike = None,
    *,
    output: Folder = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
) -> Outcome[Commissioning]:
    """Make a calibration of a night's exposures and say go or no-go, with what is missing.

    The fit is that of walop-jax refit. A go needs a fit that converged and explains the data, exposures that are
    enough for a fit, and p of stars (p ≤ 5 %) known to 0.05 % in half of the field by the calibration alone. How well
    it is known in 95 % of the field, what else the exposures lack, and mistakes that they would not show, are told with
    what to do. To rehearse a night, give the set of walop-jax simulate PLAN.

    RUN holds what refit leaves, and commissioning.json. Exit code 0 for a go, 3 for a no-go.

    In Python: a `Commissioning`.

    >>> walop.commission("night.fits").missing  # doctest: +SKIP
    """
    from walop_jax.io.atomic import atomic_path
    from walop_jax.io.names import COMMISSIONING
    from walop_jax.io.text import json_text
    from walop_jax.science.commissioning import commissioning

    fitted = command_of(refit).body(job, data, model, output=output, instrument=instrument, effects=effects)
    result = fitted.value
    accuracy = result.answer() if result.converged and result.answer is not None else None
    found = commissioning(result, accuracy)
    if output is not None:
        with atomic_path(Path(output) / COMMISSIONING, overwrite=True) as temporary:
            temporary.write_text(json_text(found.document()), encoding="utf-8")
    stars = (f"walop-jax apply {output} STARS.fits -o OUT.fits",) if found.go else ()
    return Outcome(
        found, next=(f"walop-jax report {output}", *stars), failure=fitted.failure, trusted=found.go
    )

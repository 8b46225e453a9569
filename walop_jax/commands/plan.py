"""`walop-jax plan`: which calibration exposures to take in the time there is, with a proof."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Outcome, PathLike, UsageError, command, several, typed, write_text
from walop_jax.commands.products import Effects, Product, calibration_of, catalogue_of, is_product
from walop_jax.commands.standards import LOWEST
from walop_jax.io.atomic import check_output
from walop_jax.io.errors import fail
from walop_jax.io.names import DIAGNOSIS, PLANNED
from walop_jax.io.progress import repeated
from walop_jax.io.run_folder import RunFolder
from walop_jax.io.text import json_text

if TYPE_CHECKING:
    from walop_jax import Calibration, ObservingPlan
    from walop_jax.data.records import Exposures
    from walop_jax.plans.plan import ExposurePlan

PLAN, INSTRUMENT = "plan.toml", "instrument.toml"
MOST_ANGLES = 24  # of a moving element, where a plan takes them from a run


@command(stages=("information", "searching"), writes=(PLAN, INSTRUMENT, PLANNED), random=True)
def plan(
    job: Job,
    available: ObservingPlan | Product,
    *,
    minutes: float = 30.0,
    candidates: Any = None,
    criterion: Any = "worst",
    goal: float | None = None,
    after: Any = None,
    apart: Any = None,
    draws: int = 20,
    effects: Effects = None,
    schedule: PathLike | None = None,
    words: PathLike | None = None,
    output: PathLike | None = None,
) -> Outcome[ExposurePlan]:
    """Plan the calibration exposures of a night: those that make the error of p smallest where it is largest.

    Candidate exposures are given by a plan file (see `walop-jax docs files`): filters, settings of the calibration
    plate, Moon patches, standards, exposure times, costs. The polariser may stand at any angle; so may the plate, of an
    INSTRUMENT, of a RUN, or where the file says so. Printed are the exposures in order, the errors that they promise,
    and a proven bound that no plan of the same time undercuts. RUN/plan.toml is the plan for `simulate` and
    `limits`, RUN/plan.json holds all numbers; --schedule writes it for the telescope.

    In Python: the plan. Raises ValueError for a time that pays for nothing or determines nothing.

    >>> walop.plan(walop.ObservingPlan(grid=3), minutes=20.0)  # doctest: +SKIP
    """
    from walop_jax import ObservingPlan
    from walop_jax.data.kinds import CALIBRATION_PLATE
    from walop_jax.data.user_tables import read_input_table
    from walop_jax.plans.available import Available
    from walop_jax.plans.criteria import check_wishes
    from walop_jax.plans.plan import plan_exposures
    from walop_jax.simulation.observing_plan import plan_text

    check_wishes(minutes, goal, draws)
    if schedule is not None:
        check_output(schedule, overwrite=job.overwrite)
    elif words is not None:
        raise UsageError("these are words of a schedule; see --schedule", "words")
    is_plan = isinstance(available, ObservingPlan) or available == ""
    if not is_plan and (not isinstance(available, str | os.PathLike) or is_product(available)):
        if after is not None:
            raise UsageError("one calibration can be added to: the RUN, or that of --after", "after")
        after, available = available, ""
    prior = None if after is None else calibration_of(after, effects)
    catalogue = catalogue_of(effects) if effects is not None or prior is None else prior.model.catalogue
    alike = tuple(several(apart or ()))
    if criterion == "apart" and not alike:
        if prior is None:
            raise UsageError("give the effects to be separated, or a RUN of diagnose", "apart")
        alike = _alike(after, prior)
    if candidates is None and available == "" and prior is not None:
        others = (prefix for prefix in prior.design.moving() if prefix != CALIBRATION_PLATE)
        moving = {prefix: _stood_at(prior.exposures, prefix) for prefix in others}
        design = prior.design if prior.design.description else prior.instrument
        available = ObservingPlan(design, moving=moving)
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
            catalogue=catalogue, seed=job.seed, progress=say,
        )  # fmt: skip
        planned = best(possible)
        if possible.doubts(planned.observing_plan):
            with contextlib.suppress(ValueError):  # then the plan is as it is, with its doubts
                planned = best(dataclasses.replace(possible, throughout=minutes))
    described = planned.observing_plan.design.description
    toml = plan_text(planned.observing_plan, INSTRUMENT if described else None)
    steps = ()
    if output is not None:
        steps = typed("report", output), typed("simulate", Path(output) / PLAN, "-o", "SET.fits")
    return Outcome(
        planned,
        extra={"seed": job.seed},
        files={PLAN: toml, INSTRUMENT: described or None},
        saved_as=PLANNED,
        warnings=() if schedule is None else scheduled(job, planned.observing_plan, schedule, words),
        next=steps,
    )


def scheduled(job: Job, planned: ObservingPlan, path: PathLike, words: PathLike | None) -> Sequence[str]:
    """Write the exposures of a plan as a schedule; filters are numbered in their order unless `words` number them."""
    from walop_jax.data.header_words import Words, read_words
    from walop_jax.data.schedule import schedule_of

    rules = Words({}) if words is None else read_words(words)
    numbers = rules.filters or {name: k for k, name in enumerate(planned.filter_names, start=1)}
    exposures = planned.exposures()
    _, star = planned.layout()
    stars = star.max(axis=0)
    known, remarks = _real_standards(planned, exposures, stars)
    ra, dec = exposures.ra.copy(), exposures.dec.copy()
    for number, (_, *place) in known.items():
        ra[stars == number], dec[stars == number] = place
    exposures = dataclasses.replace(exposures, ra=ra, dec=dec)
    names = []
    for s, kind, *place in zip(stars, exposures.kind, exposures.ra, exposures.dec, strict=True):
        moon = f"Moon at {place[0]:.2f} {place[1]:+.2f}" if kind == "moon" else "calibration"
        names.append(known[s][0] if s in known else planned.star_names[s] if s >= 0 else moon)
    unpolarised = [name for number, (name, *_) in known.items() if number < planned.unpolarised]
    document, further = schedule_of(
        exposures, planned.site, numbers, facts=rules.schedule, names=names, unpolarised=unpolarised
    )
    remarks += further
    write_text(path, json_text(document), overwrite=job.overwrite)
    if not rules.filters:
        listed = ", ".join(f"{name} {number}" for name, number in numbers.items())
        remarks.append(f"{path}: filters are numbered in their order ({listed}); --words gives other numbers")
    return remarks


def _real_standards(
    planned: ObservingPlan, exposures: Exposures, star: Any
) -> tuple[dict[int, tuple[str, float, float]], list[str]]:
    """Name, RA and DEC (deg) of a standard of the package for each of a plan, the highest at its time; and remarks.

    Standards of a plan are stars of some place. Those for which none is up keep it.
    """
    import numpy as np

    from walop_jax.data.standards import UNPOLARISED, shipped_standards
    from walop_jax.sky.moon import altitude

    table = shipped_standards()
    table = table[np.unique(table["SOURCE"], return_index=True)[1]]
    ra, dec = (np.asarray(table[name].to_value("deg"), float) for name in ("RA", "DEC"))
    zero, chosen, missing = np.asarray(table["P"]) < UNPOLARISED, dict[int, tuple[str, float, float]](), []
    for number in np.unique(star[star >= 0]).tolist():
        times = exposures.mjd[star == number]
        height = np.min([altitude(np.full(len(ra), mjd), ra, dec, planned.site) for mjd in times], axis=0)
        taken = [name in {name for name, *_ in chosen.values()} for name in table["NAME"]]
        height[taken | (zero != (number < planned.unpolarised))] = -90.0
        best = int(height.argmax())
        if number < planned.standards and height[best] >= LOWEST:
            chosen[number] = (str(table["NAME"][best]), float(ra[best]), float(dec[best]))
        else:
            missing.append(planned.star_names[number])
    of = [f"{planned.star_names[number]} is {name}" for number, (name, *_) in chosen.items()]
    remarks = [f"standards of the package that are up: {', '.join(of)}"] if of else []
    if missing:
        what = f"{', '.join(missing)}: no standard of the package that is up; RA and Dec are of no star"
        remarks.append(f"{what}: put yours in `objects`")
    return chosen, remarks


def _stood_at(exposures: Exposures, prefix: str) -> tuple[float | None, ...]:
    """Angles (deg, None: out) at which a moving element stood in the exposures of a calibration."""
    import numpy as np

    position = exposures.position(prefix)
    stood = np.unique(np.where(position.inside, np.mod(position.angle, 360.0).round(3), np.nan))
    if len(stood) > MOST_ANGLES:
        advice = f"say moving = {{ {prefix} = [0, 22.5, 45] }} in a plan, and give --candidates PLAN.toml"
        raise fail(f"{prefix} stood at {len(stood)} angles, more than could be tried", advice=advice)
    return tuple(float(angle) if np.isfinite(angle) else None for angle in stood)


def _alike(after: Any, known: Calibration) -> tuple[Any, ...]:
    """The effects that a diagnosis could not tell apart: that found, as it is, then its rivals by name."""
    from walop_jax.diagnosis.findings import Diagnosis, document

    diagnosis, path = document(after) if isinstance(after, Diagnosis) else None, None
    if isinstance(after, RunFolder | str | os.PathLike):
        folder = after if isinstance(after, RunFolder) else RunFolder(Path(after))
        diagnosis, path = folder.documents.get("diagnosis"), folder.folder / DIAGNOSIS
    if diagnosis is None:
        advice = "run diagnose first, or name the effects with --apart (apart= in Python)"
        raise fail("no diagnosis", file=path, advice=advice)
    effects_of_model = {effect.name: effect for effect in known.model.instrument(known.values).effects}
    for step in diagnosis["steps"]:
        if step["equivalent"] and step["effect"] in effects_of_model:
            return (effects_of_model[step["effect"]], *step["equivalent"])
    advice = "name the effects to be separated with --apart"
    raise fail("the diagnosis left no effects that look alike", file=path, advice=advice)

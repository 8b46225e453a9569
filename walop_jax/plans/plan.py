"""A plan of calibration exposures: which, how often, in which order; its accuracy and its distance from the best.

Here the best weights (`optimal`) of candidates (`exposures`) for a criterion (`criteria`) become whole exposures in an
order with few changes, with the gain of each and the price of leaving it out.

Order        Settings one after the other, the polariser turning one way in each, then the sky, the nearest pointing
             next. Changes of filter, moving elements and pointing take time from the budget; whether a setting, an
             angle of the plate say, is worth its change is tried. The bound ignores changes, and holds for every order.
Go           A plan contains what a go needs (`needs`), and optimises the rest of its time. The bound holds for plans
             without it as well: the distance from it is the price.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration import certify
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.inspection import about_exposures
from walop_jax.data.records import Exposures
from walop_jax.data.user_tables import InputTable
from walop_jax.io.text import in_its_unit
from walop_jax.io.text import rounded as digits
from walop_jax.likelihood.inverses import pseudo_inverse
from walop_jax.model.effects import EFFECTS, Effect, EffectKind
from walop_jax.model.effects.in_models import known_effects
from walop_jax.plans import criteria, needs, optimal, separating
from walop_jax.plans.available import Available, CandidateExposure, with_stops
from walop_jax.plans.criteria import Criterion, FieldErrors
from walop_jax.plans.exposure_plan import ExposurePlan, PlannedExposure
from walop_jax.plans.exposures import DRAWS, Candidates, candidates, information_of
from walop_jax.plans.optimal import GAP, Allocation, Experiment, Key, NotEstimableError, Weights
from walop_jax.plans.rounding import rounded
from walop_jax.plans.separating import ClassOfRun
from walop_jax.science.field_accuracy import known_in_half
from walop_jax.simulation.observing_plan import ObservingPlan, Stop
from walop_jax.simulation.polariser_angles import polariser_turn
from walop_jax.sky.directions import separation

_NOTHING = 1e-6  # of the prior information: less of it makes no plan

USUAL: Mapping[str, tuple[tuple[float, ...], bool, int]] = {
    "even angles": (polariser_turn(15), False, 0),
    "even angles and the Moon": (polariser_turn(15), False, 8),
    "even angles at each setting": (polariser_turn(15), True, 0),
    "balanced angles at each setting": ((0.0, 45.0, 90.0, 135.0), True, 0),
}
"""Usual plans: polariser angles (deg), at every setting or the first only, and number of Moon patches.

The second is the procedure of Paper II; the last balances the Stokes parameters with the fewest states (Casini,
Harrington & de Wijn 2026, arXiv:2602.13997). A full turn of the polariser says the same as half a turn."""


USUAL_PLATE = 22.5
"""Angle (deg) of the calibration plate, where it may stand at any, in the plans that have two settings of it."""


class Line(NamedTuple):
    """Equal exposures of a plan: the number of the choice and of the stop in it, how often, and whether half a turn
    `later`.
    """

    choice: int
    number: int
    times: int
    later: bool = False


def plan_exposures(
    available: Available | ObservingPlan,
    minutes: float,
    *,
    criterion: str | InputTable = criteria.WORST,
    known: Calibration | None = None,
    goal: float | None = None,
    draws: int = DRAWS,
    seed: int = 0,
    gap: float = GAP,
    apart: Sequence[str | Effect] = (),
    separate: ClassOfRun | None = None,
    catalogue: Sequence[EffectKind] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> ExposurePlan:
    """The calibration exposures of `minutes` that make a criterion (`criteria`) best.

    `known` is a calibration that is there already; `goal` a value of the criterion, as it is given, to which the time
    is found. `apart` are effects that are to be separated (`criteria.APART`), each with its value or by name alone, of
    the `catalogue`; their goal is `NAMED` unless another is given. `separate` is the class of a run, whose members are
    to be separated by one exposure, or two that differ (`separating`). Raises ValueError as `check_wishes` and for a
    time that pays for nothing, NotEstimableError where nothing that could be observed, or too little in that time,
    determines the criterion.
    """
    criteria.check_wishes(minutes, goal, draws)
    if separate is not None:
        return _separating(Available.of(available), minutes, separate, seed=seed, gap=gap, progress=progress)
    if apart:
        criterion, goal = criteria.APART, criteria.NAMED if goal is None else goal
    choices = candidates(
        Available.of(available), draws=draws, seed=seed, around=known, effects=apart, catalogue=catalogue,
        progress=progress,
    )  # fmt: skip
    if progress is not None:
        progress("criterion")
    two_arms = len(choices.model.template.cameras.pairs) == 2
    over_field = criterion in ("worst", "mean")  # raises, with advice, for other numbers of arms
    field = criteria.field_errors(choices) if over_field or (two_arms and not apart) else None
    return plan_from(
        choices, minutes, criteria.criterion_by_name(choices, field, criterion), field,
        known=None if known is None else information_of(known, choices.names, choices.effects),
        had=() if known is None else (known.exposures,),
        goal=goal, gap=gap, progress=progress,
    )  # fmt: skip


def _separating(
    available: Available,
    minutes: float,
    given: ClassOfRun,
    *,
    seed: int,
    gap: float,
    progress: Callable[[str], None] | None,
) -> ExposurePlan:
    """The exposures that separate the members of a class."""
    known = given.known
    found = candidates(
        available, draws=1, seed=seed, around=known, effects=given.effects, catalogue=known_effects(known.model),
        progress=progress,
    )  # fmt: skip
    if progress is not None:
        progress("information of the data of the run")
    had = separating.information_of_data(given, found)
    of = criteria.amplitudes_of(found, given.names)
    first = criteria.stated_size(found, given.names[0])
    criterion = criteria.apart(found, of, separating.sizes(had + found.prior, of, first))
    pairs = separating.pairs_of(given.names)
    plan = plan_from(
        dataclasses.replace(found, notes=(*found.notes, *given.notes)), minutes, criterion,
        known=had, had=(known.exposures,), goal=float(np.sqrt(separating.DECIDED)), gap=gap, progress=progress,
        pairs=pairs,
    )  # fmt: skip
    return plan


def plan_from(
    found: Candidates,
    minutes: float,
    criterion: Criterion,
    field: FieldErrors | None = None,
    *,
    known: Float[np.ndarray, "f f"] | None = None,
    had: Sequence[Exposures] = (),
    goal: float | None = None,
    gap: float = GAP,
    pairs: Sequence[tuple[str, str]] = (),
    progress: Callable[[str], None] | None = None,
) -> ExposurePlan:
    """The plan of `plan_exposures`, from candidates that are there; `known` is the information of earlier exposures,
    `had`.

    With `pairs`, the names of the blocks of the criterion, the plan is one exposure or two that separate all of them.
    """
    tell = progress or (lambda text: None)
    criteria.check_wishes(minutes, goal)
    shortest = min(choice.seconds + found.available.costs.of(choice.kind) for choice in found.choices)
    if 60.0 * minutes < shortest:
        what = f"the shortest takes {shortest / 60:.2g}, with read-out or pointing"
        raise ValueError(f"{minutes:g} minutes do not pay for a single exposure: {what}")
    tell("looking for the best plan")
    problem = experiment_of(found, minutes, criterion, known)
    try:
        weights = optimal.optimise(problem, gap=0.5 * gap, progress=tell)
        if weights.proof.ratio * problem.budget < _NOTHING * weights.proof.known:
            raise NotEstimableError
    except NotEstimableError:
        missing = [k for k in ("moon", "standard") if not any(c.kind == k for c in found.choices)]
        advice = f"; no {' or '.join(missing)} exposures could be taken" if missing else ""
        reason = f"{criterion.what}: no possible exposure adds information on it"
        raise NotEstimableError("; ".join((f"{reason}{advice}", *found.notes))) from None
    best, required = _few(found, problem, weights) if pairs else _for_a_go(found, problem, weights, had, gap)
    lines = _ordered(found, best.weights)
    needed, endless = None, ()
    if goal is not None:
        tell("how long the goal takes")
        try:
            cheapest, least = optimal.least_budget(problem, criterion.variance(goal), gap=gap)
            needed = (problem.cost(cheapest.weights) / 60.0, least / 60.0)
        except NotEstimableError:
            reason = f"no time reaches {in_its_unit(digits(goal, '.3g'), criterion.unit)}"
            endless = (f"{criterion.what}: {reason}; add other settings to the candidates",)
    plan = _observed(found, lines, minutes)
    none = np.zeros((len(found.values), 0))
    of_both = problem.known, problem.known + problem.total(best.weights)
    before, after = (none if field is None else field.error(covariance(m)) for m in of_both)
    taken = *had, plan.exposures()
    told = (separating.distances(problem, planned) for planned in ({}, best.weights)) if pairs else ((), ())
    lacks = () if pairs else tuple(_lacking(plan, known_effects(found.model), taken, after))
    open_ends = [str(finding) for finding in about_exposures(*taken)]
    return ExposurePlan(
        minutes=minutes,
        lines=tuple(_described(found, problem, lines, best, required)),
        criterion=criterion,
        value=criterion.reported(best.value),
        bound=criterion.reported(weights.bound),
        weights_gap=weights.gap,
        truncation=found.truncation,
        goal=goal,
        needed=needed,
        x=np.zeros(0) if field is None else field.x,
        y=np.zeros(0) if field is None else field.y,
        before=before,
        after=after,
        beside=dict(_beside(found, problem, criterion)),
        observing_plan=plan,
        notes=(*found.notes, *endless, *open_ends, *found.available.doubts(plan)),
        any_plate=found.available.any_plate,
        lacks=lacks,
        bound_of_go=criterion.reported(best.bound),
        added=bool(had),
        pairs=tuple(separating.Pair(*pair, *values) for pair, *values in zip(pairs, *told, strict=True)),
    )


def _observed(found: Candidates, lines: Sequence[Line], minutes: float) -> ObservingPlan:
    """The observing plan of lines of exposures."""
    stops = [_stop(found.choices[line.choice], line) for line in lines]
    return with_stops(
        found.available.plan, stops, spacing=round(minutes / max(sum(line.times for line in lines), 1), 3)
    )


def _stop(choice: CandidateExposure, line: Line) -> Stop:
    """The stop of a line."""
    stop = dataclasses.replace(choice.stops[line.number], times=line.times)
    if line.later and stop.polariser_angle is not None:
        stop = dataclasses.replace(stop, polariser_angle=round(stop.polariser_angle + 180.0, 3))
    return stop


def _lacking(
    plan: ObservingPlan,
    catalogue: Sequence[EffectKind],
    taken: Sequence[Exposures],
    after: Float[np.ndarray, "r p"],
) -> Iterator[str]:
    """What a go needs and the exposures of a plan, and of earlier ones, do not give; `after` are the errors of p."""
    yield from map(str, certify.lacks(plan.design, catalogue, plan.context(), *taken))
    if after.size:
        # Where one exposure holds no u the error has no bound.
        middle = float(np.median(np.nan_to_num(np.median(after, axis=0), nan=np.inf)))
        if not (need := known_in_half(middle)).met:
            yield f"p of stars: {need.found}; {need.advice}"


def experiment_of(
    found: Candidates, minutes: float, criterion: Criterion, prior: Float[np.ndarray, "f f"] | None = None
) -> Experiment:
    """The problem of a budget in minutes; `prior` is information beside that of the candidates' own prior."""
    before = found.prior if prior is None else found.prior + prior
    pairs, budget = criterion.blocks, 60.0 * minutes
    if pairs is None:
        known = np.broadcast_to(before, (len(criterion.targets), *before.shape)).copy()
        return Experiment(known, criterion.targets, found.families, budget)
    # Where a rival has fewer parameters than another the rest are known.
    idle = np.stack([np.diag(1.0 * ~pair.any(axis=0)) for pair in pairs])
    known = np.tile(pairs.swapaxes(1, 2) @ before @ pairs + idle, (len(found.values), 1, 1))
    return Experiment(known, criterion.targets, found.families, budget, pairs)


# ------------------------------------------------------------------------------------------ whole, and in order


def _time(found: Candidates, problem: Experiment) -> Callable[[Weights], float]:
    """What whole exposures take (s) with the changes between them."""
    return lambda planned: problem.cost(planned) + sum(_changes(found, _ordered(found, planned)))


def _few(found: Candidates, problem: Experiment, weights: Allocation) -> tuple[Allocation, Weights]:
    """One exposure or two, repeated in the time, of which the bound is that of any number of them."""

    def steps(family: int) -> int:
        return separating.STEPS if found.choices[family].kind == "clp" else 1

    chosen = separating.few_exposures(problem, _time(found, problem), steps)
    value = largest_variance(problem, problem.known + problem.total(chosen))
    return dataclasses.replace(weights, weights=chosen, value=value), {}


def _for_a_go(
    found: Candidates, problem: Experiment, weights: Allocation, had: Sequence[Exposures], gap: float
) -> tuple[Allocation, Weights]:
    """Whole exposures with what a go needs among them, as far as the time allows, and what the go needs of them.

    Their bound is that of plans with these exposures. A plan that has all of it already stays as it is.
    """
    time = _time(found, problem)

    def whole(best: Allocation, required: Weights) -> Allocation:
        return rounded(
            problem, best, required=required, time=time, setting=lambda key: found.choices[key[0]].setting
        )

    failure, alone = None, None
    try:
        alone = whole(weights, {})
        if needs.met(*had, _observed(found, _ordered(found, alone.weights), 1.0).exposures()):
            return alone, {}
    except ValueError as error:
        failure = error
    # Directions of whole exposures, which lie in few settings; weights may lie in many.
    for required in needs.required(found, weights.weights if alone is None else alone.weights, had):
        budget = problem.budget - time(required)
        if budget < 0:
            continue
        known = problem.known + problem.total(required)
        with contextlib.suppress(ValueError):
            rest = dataclasses.replace(problem, known=known, budget=max(budget, 1e-6 * problem.budget))
            return whole(optimal.optimise(rest, gap=gap), required), required
    if alone is None:
        assert failure is not None
        raise failure
    return alone, {}


def _ordered(found: Candidates, planned: Weights) -> list[Line]:
    """Light through the polariser first, setting by setting, the polariser turning one way; then the sky, last setting
    first, the nearest pointing next.
    """
    later = needs.half_a_turn_later(found, planned)
    lines = [Line(*at, int(times), at in later) for at, times in planned.items()]
    settings = list(dict.fromkeys(found.choices[i].setting for i in sorted({line.choice for line in lines})))

    def key(line: Line) -> tuple[int, int, float]:
        choice = found.choices[line.choice]
        number, stop = settings.index(choice.setting), _stop(choice, line)
        return (
            (0, number, stop.polariser_angle or 0.0) if choice.kind in ("clp", "lamp") else (1, -number, 0.0)
        )

    lines.sort(key=key)
    done, sky = ([line for line in lines if key(line)[0] == place] for place in (0, 1))
    last = None
    while sky:
        same = [line for line in sky if key(line) == key(sky[0])]
        begin = _pointing(found, last or same[0])
        last = min(same, key=lambda line: float(separation(*begin, *_pointing(found, line))))
        done.append(last)
        sky.remove(last)
    return done


def _pointing(found: Candidates, line: Line) -> tuple[float, float]:
    """Right ascension and declination (deg) of the Moon patch or standard of a line."""
    choice = found.choices[line.choice]
    targets, number = found.available.targets[choice.kind], choice.stops[line.number].number
    return float(targets.ra[number]), float(targets.dec[number])


def _changes(found: Candidates, lines: list[Line]) -> Iterator[float]:
    """Time (s) of what must be changed ahead of each line; what stands at the beginning is set up beforehand."""
    costs = found.available.costs
    last, previous = None, None
    for line in lines:
        choice = found.choices[line.choice]
        time = 0.0
        if last is not None:
            time += costs.filter * (choice.filter != last.filter)
            time += costs.position * sum(choice.positions[p] != a for p, a in last.positions.items())
        if choice.kind in ("moon", "standard"):
            pointing = _pointing(found, line)
            time += 0.0 if previous is None else costs.slew * float(separation(*previous, *pointing))
            previous = pointing
        last = choice
        yield time


# -------------------------------------------------------------------------------------------------- gains


def covariance(total: Float[np.ndarray, "r n n"]) -> Float[np.ndarray, "r n n"]:
    """M⁻¹, scaled so that gauges drop out."""
    return np.stack([pseudo_inverse(matrix, 1e-13) for matrix in total])


def largest_variance(experiment: Experiment, total: Float[np.ndarray, "r n n"]) -> float:
    """f of the information of everything in every draw."""
    a = experiment.targets
    c = covariance(total)
    return float(experiment.largest(np.einsum("rknq,rnm,rkmq->rk", a, c, a, optimize=True)).mean())


def _described(
    found: Candidates, experiment: Experiment, lines: list[Line], best: Allocation, required: Weights
) -> Iterator[PlannedExposure]:
    without, added = optimal.criterion_without_and_with(experiment, best)
    for line, change in zip(lines, _changes(found, lines), strict=True):
        choice, key = found.choices[line.choice], (line.choice, line.number)
        stop = _stop(choice, line)
        yield PlannedExposure(
            *(choice.kind, choice.filter, choice.positions),
            polariser_angle=float("nan") if stop.polariser_angle is None else stop.polariser_angle,
            number=stop.number if choice.kind in ("moon", "standard") else -1,
            times=line.times,
            seconds=experiment.cost({key: line.times}),
            left_out=without[key],
            one_more=added[key],
            exptime=choice.seconds,
            change=change,
            place=stop.place,
            needed=key in required,
        )


def usual_plans(found: Candidates) -> Iterator[tuple[str, dict[Key, float]]]:
    """The plans of `USUAL` that the candidates hold, as weights of (choice, place)."""
    polariser = {
        c.setting: i
        for i, c in reversed(list(enumerate(found.choices)))
        if c.kind == "clp" and c.stops[0].plate in (*found.available.plan.plate, USUAL_PLATE)
    }
    order = [i for i, c in enumerate(found.choices) if polariser.get(c.setting) == i]
    moon = next((i for i, c in enumerate(found.choices) if c.kind == "moon"), None)
    for name, (angles, everywhere, patches) in USUAL.items():
        if (everywhere and len(order) < 2) or (patches and moon is None):
            continue
        where = order if everywhere else order[:1]
        weights = {(i, found.choices[i].number(angle)): 1.0 for i in where for angle in angles}
        if patches and moon is not None:
            count = len(found.choices[moon].stops)
            weights |= {(moon, k): patches / count for k in range(count)}
        yield name, weights


def _beside(found: Candidates, experiment: Experiment, criterion: Criterion) -> Iterator[tuple[str, float]]:
    for name, weights in usual_plans(found):
        share = experiment.budget / experiment.cost(weights)
        total = experiment.known + share * experiment.total(weights)
        yield name, criterion.reported(largest_variance(experiment, total))

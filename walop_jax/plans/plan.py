"""A plan of calibration exposures: which, how often, in which order; its accuracy and its distance from the best.

Here the best weights (`optimal`) of candidates (`exposures`) for a criterion (`criteria`) become whole exposures in an
order with few changes, with the gain of each and the price of leaving it out.

Plate        Where it may stand at any angle the bound holds for all of them; exposures are taken at few, those that the
             best weights use most, as many as are worth their changes.
Order        Settings one after the other, the polariser turning one way in each, then the sky, the nearest pointing
             next. Changes of filter, moving elements and pointing take time from the budget; whether a setting is worth
             its change is tried. The bound ignores changes, and holds for every order.
Go           A plan contains what a go needs (`needs`), and optimises the rest of its time. The bound holds for plans
             without it as well: the distance from it is the price.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
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
from walop_jax.plans import criteria, needs, optimal
from walop_jax.plans.available import Available, CandidateExposure, with_stops
from walop_jax.plans.criteria import Criterion, FieldErrors
from walop_jax.plans.exposure_plan import ExposurePlan, PlannedExposure
from walop_jax.plans.exposures import DRAWS, Candidates, candidates, information_of
from walop_jax.plans.optimal import GAP, Allocation, Experiment, NotEstimableError
from walop_jax.science.field_accuracy import known_in_half
from walop_jax.simulation.observing_plan import ObservingPlan, Stop
from walop_jax.simulation.polariser_angles import polariser_turn
from walop_jax.sky.directions import separation

_NOTHING = 1e-6  # of the prior information: less of it makes no plan
_ALIKE = 3.0  # deg: angles of the plate that are taken as one
_TRIES = 6  # budgets, until the exposures and the changes between them fit into the time

USUAL: Mapping[str, tuple[tuple[float, ...], bool, int]] = {
    "even angles": (polariser_turn(15), False, 0),
    "even angles and the Moon": (polariser_turn(15), False, 8),
    "even angles at each setting": (polariser_turn(15), True, 0),
    "balanced angles at each setting": ((0.0, 45.0, 90.0, 135.0), True, 0),
}
"""Usual plans: polariser angles (deg), at every setting or the first only, and number of Moon patches.

The second is the procedure of Paper II; the last balances the Stokes parameters with the fewest states (Casini,
Harrington & de Wijn 2026, arXiv:2602.13997). A full turn of the polariser says the same as half a turn."""


class Line(NamedTuple):
    """Exposures of a plan that are the same: number of the choice, place in it, how often; half a turn `later`?"""

    choice: int
    place: tuple[float, ...]
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
    catalogue: Sequence[EffectKind] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> ExposurePlan:
    """The calibration exposures of `minutes` that make a criterion (`criteria`) best.

    `known` is a calibration that is there already; `goal` a value of the criterion, as it is given, to which the time
    is found. `apart` are effects that are to be separated (`criteria.APART`), each with its value or by name alone, of
    the `catalogue`; their goal is `NAMED` unless another is given. Raises ValueError as `check_wishes` and for a time
    that pays for nothing, NotEstimableError where nothing that could be observed, or too little in that time,
    determines the criterion.
    """
    criteria.check_wishes(minutes, goal, draws)
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
    progress: Callable[[str], None] | None = None,
) -> ExposurePlan:
    """As `plan_exposures`, from candidates that are there; `known` is the information of earlier exposures, `had`."""
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
    best, lines, chosen, experiment = _at_few_angles(
        found, weights, lambda part: experiment_of(part, minutes, criterion, known), gap
    )
    best, lines, required = _for_a_go(chosen, experiment, best, lines, had, gap)
    needed, endless = None, ()
    if goal is not None:
        tell("how long the goal takes")
        try:
            cheapest, least = optimal.least_budget(problem, criterion.variance(goal), gap=gap)
            needed = (_cost(problem, cheapest.weights) / 60.0, least / 60.0)
        except NotEstimableError:
            reason = f"no time reaches {in_its_unit(digits(goal, '.3g'), criterion.unit)}"
            endless = (f"{criterion.what}: {reason}; add other settings to the candidates",)
    total = experiment.known + information_of_weights(experiment, best.weights)[0]
    plan = _observed(chosen, lines, minutes)
    none = np.zeros((len(found.values), 0))
    of_both = experiment.known, total
    before, after = (none if field is None else field.error(covariance(m)) for m in of_both)
    taken = *had, plan.exposures()
    lacks = tuple(_lacking(plan, known_effects(found.model), taken, after))
    open_ends = [str(finding) for finding in about_exposures(*taken)]
    return ExposurePlan(
        minutes=minutes,
        lines=tuple(_described(chosen, experiment, lines, best, required)),
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
        notes=(*found.notes, *endless, *open_ends, *chosen.available.doubts(plan)),
        any_plate=found.available.any_plate,
        lacks=lacks,
        bound_of_go=criterion.reported(best.bound),
        added=bool(had),
    )


def _observed(found: Candidates, lines: Sequence[Line], minutes: float) -> ObservingPlan:
    """The observing plan of lines of exposures."""
    stops = [_stop(found.choices[line.choice], line) for line in lines]
    return with_stops(
        found.available.plan, stops, spacing=round(minutes / max(sum(line.times for line in lines), 1), 3)
    )


def _stop(choice: CandidateExposure, line: Line) -> Stop:
    """The stop of a line."""
    stop = choice.stop(line.place, line.times)
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


Weights = Mapping[tuple[int, tuple[float, ...]], float]  # numbers of exposures, by choice and place


def experiment_of(
    found: Candidates, minutes: float, criterion: Criterion, prior: Float[np.ndarray, "f f"] | None = None
) -> Experiment:
    """The problem of a budget in minutes; `prior` is information beside that of the candidates' own prior."""
    before = found.prior if prior is None else found.prior + prior
    families, pairs, budget = found.families, criterion.blocks, 60.0 * minutes
    if pairs is None:
        prior = np.broadcast_to(before, (len(criterion.targets), *before.shape)).copy()
        return Experiment(prior, criterion.targets, families, budget)
    families = tuple(family.turned(pairs) for family in families)
    # Where a rival has fewer parameters than another the rest are known.
    idle = np.stack([np.diag(1.0 * ~pair.any(axis=0)) for pair in pairs])
    prior = np.tile(pairs.swapaxes(1, 2) @ before @ pairs + idle, (len(found.values), 1, 1))
    return Experiment(prior, criterion.targets, families, budget, len(pairs))


def _cost(experiment: Experiment, weights: Weights) -> float:
    families = experiment.families
    return sum(w * float(families[f].cost_at(np.atleast_2d(p))[0]) for (f, p), w in weights.items())


# ------------------------------------------------------------------------------------------ whole, and in order


def _at_few_angles(
    found: Candidates, weights: Allocation, experiment: Callable[[Candidates], Experiment], gap: float
) -> tuple[Allocation, list[Line], Candidates, Experiment]:
    """Whole exposures in order, with the plate at as many angles as are worth it, of candidates with these alone."""
    free = [i for i, choice in enumerate(found.choices) if choice.free]
    angles: dict[float, float] = {}
    for i in np.argsort(-weights.weight):
        number, place, weight = int(weights.family[i]), weights.place[i], float(weights.weight[i])
        if number in free:
            angle = float(found.choices[number].stop(place).plate or 0.0)
            near = next((a for a in angles if abs((a - angle + 90.0) % 180.0 - 90.0) < _ALIKE), angle)
            angles[near] = angles.get(near, 0.0) + weight
    order = sorted(angles, key=lambda a: -angles[a])
    best, failure = None, None
    for count in range(len(order) + 1):
        if best is not None and best[0].value <= weights.bound * (1 + gap):
            break  # no other angle can be worth more than this
        chosen = found.with_plate(order[:count])
        if not chosen.choices:
            continue
        problem = experiment(chosen)
        try:
            trial = _whole(chosen, problem, optimal.optimise(problem, gap=0.5 * gap) if free else weights)
        except ValueError as error:
            failure = error
            continue
        if best is None or trial[0].value < best[0].value:
            best = (dataclasses.replace(trial[0], bound=weights.bound), trial[1], chosen, problem)
        elif count > 1:
            break
    if best is None:
        assert failure is not None
        raise failure
    return best


def _for_a_go(
    found: Candidates,
    experiment: Experiment,
    best: Allocation,
    lines: list[Line],
    had: Sequence[Exposures],
    gap: float,
) -> tuple[Allocation, list[Line], Weights]:
    """The plan with what a go needs in it, as far as the time allows: exposures, lines in order, what it had to have.

    Its bound is that of plans with these exposures. A plan that has all of it already stays as it is.
    """
    if needs.met(*had, _observed(found, lines, 1.0).exposures()):
        return best, lines, {}
    for required in needs.required(found, best.weights, had):
        information, cost = information_of_weights(experiment, required)
        known, budget = experiment.known + information, experiment.budget - cost
        if budget <= 0:
            continue
        rest = dataclasses.replace(experiment, known=known, budget=budget)
        with contextlib.suppress(ValueError):
            return *_whole(found, rest, optimal.optimise(rest, gap=0.5 * gap), required), required
    return best, lines, {}


def _whole(
    found: Candidates, experiment: Experiment, weights: Allocation, required: Weights = MappingProxyType({})
) -> tuple[Allocation, list[Line]]:
    """Whole exposures in order, within the time with their changes, without settings that are not worth theirs.

    `experiment` is that of the exposures beside those `required`, whose information it has.
    """
    used = sorted({int(i) for i in weights.family})
    settings = list(dict.fromkeys(found.choices[i].setting for i in used))
    best = _within(found, experiment, weights, range(len(found.choices)), required)
    for setting in settings if len(settings) > 1 else ():
        remaining = [i for i, choice in enumerate(found.choices) if choice.setting != setting]
        with contextlib.suppress(ValueError):
            trial = _within(found, experiment, weights, remaining, required)
            best = min(best, trial, key=lambda pair: pair[0].value)
    return best


def _within(
    found: Candidates,
    experiment: Experiment,
    weights: Allocation,
    allowed: Sequence[int],
    required: Weights = MappingProxyType({}),
) -> tuple[Allocation, list[Line]]:
    """Whole exposures of some choices, and those required, with their changes."""
    at = [i for i, family in enumerate(weights.family) if family in allowed]
    if not at:
        raise ValueError("none of the best exposures is left")
    budget, changes, place = experiment.budget, 0.0, [weights.place[i] for i in at]
    families = tuple(experiment.families[i] for i in allowed)
    family = np.searchsorted(allowed, weights.family[at])
    for _ in range(_TRIES):
        remaining = budget - changes
        if remaining <= 0:
            what = f"changes of filter, moving elements and pointing alone take {changes / 60:.1f}"
            advice = "give more time, or fewer filters and settings"
            raise ValueError(f"{budget / 60:g} minutes: {what}; {advice}")
        problem = dataclasses.replace(experiment, families=families, budget=remaining)
        weight = weights.weight[at] * remaining / budget
        scaled = dataclasses.replace(weights, family=family, place=place, weight=weight)
        if required and remaining < min(_cost(problem, {at: 1.0}) for at in scaled.weights):
            # Those required are all that the time pays for.
            value = largest_variance(experiment, experiment.known)
            integer = dataclasses.replace(
                weights, family=family[:0], place=[], weight=weight[:0], value=value
            )
        else:
            integer = optimal.rounded(problem, scaled)
            integer = dataclasses.replace(integer, family=np.array(allowed)[integer.family])
        both = _together(integer, required)
        lines = _ordered(found, both.weights)
        between = sum(_changes(found, lines))
        if _cost(experiment, integer.weights) + between <= budget * (1 + 1e-9):
            return both, lines
        changes = max(between, changes + 1.0)
    raise ValueError(f"{budget / 60:g} minutes do not pay for the changes between exposures; give more time")


def _together(plan: Allocation, required: Weights) -> Allocation:
    """A plan with the exposures that are required beside it; its value has them already."""
    weights = dict(plan.weights)
    for at, times in required.items():
        weights[at] = weights.get(at, 0.0) + times
    place = [np.array(at) for _, at in weights]
    return dataclasses.replace(
        plan,
        family=np.array([i for i, _ in weights], int),
        place=place,
        weight=np.array(list(weights.values())),
    )


def _ordered(found: Candidates, planned: Weights) -> list[Line]:
    """Indoors setting by setting, the polariser turning one way; then the sky, last setting first, the nearest next."""
    later = needs.half_a_turn_later(found, planned)
    lines = [Line(*at, int(times), at in later) for at, times in planned.items()]
    settings = list(dict.fromkeys(found.choices[i].setting for i in sorted({line.choice for line in lines})))

    def key(line: Line) -> tuple[int, int, float]:
        choice = found.choices[line.choice]
        number = settings.index(choice.setting)
        along = line.place[0] + 2.0 * np.pi * line.later
        return (0, number, along) if choice.kind in ("clp", "lamp") else (1, -number, 0.0)

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
    targets, number = found.available.targets[choice.kind], choice.stop(line.place).number
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
    keys = list(best.weights)
    without, added = optimal.worth(experiment, best)
    for line, change in zip(lines, _changes(found, lines), strict=True):
        choice, i = found.choices[line.choice], keys.index((line.choice, line.place))
        stop = _stop(choice, line)
        yield PlannedExposure(
            *(choice.kind, choice.filter, choice.positions),
            polariser_angle=float("nan") if stop.polariser_angle is None else stop.polariser_angle,
            number=stop.number if choice.kind in ("moon", "standard") else -1,
            times=line.times,
            seconds=_cost(experiment, {(line.choice, line.place): line.times}),
            left_out=float(without[i]),
            one_more=float(added[i]),
            exptime=choice.seconds,
            change=change,
            place=stop.place,
            needed=(line.choice, line.place) in required,
        )


def usual_plans(found: Candidates) -> Iterator[tuple[str, dict[tuple[int, tuple[float, ...]], float]]]:
    """The plans of `USUAL` that the candidates hold, as weights of (choice, place)."""
    polariser = {c.setting: i for i, c in reversed(list(enumerate(found.choices))) if c.kind == "clp"}
    order = [i for i, c in enumerate(found.choices) if polariser.get(c.setting) == i]
    moon = next((i for i, c in enumerate(found.choices) if c.kind == "moon"), None)
    for name, (angles, everywhere, patches) in USUAL.items():
        if (everywhere and len(order) < 2) or (patches and moon is None):
            continue
        where = order if everywhere else order[:1]
        weights = {(i, found.choices[i].place(angle)): 1.0 for i in where for angle in angles}
        if patches and moon is not None:
            count = len(found.choices[moon].stops)
            weights |= {(moon, (float(k),)): patches / count for k in range(count)}
        yield name, weights


def information_of_weights(
    experiment: Experiment, weights: Weights
) -> tuple[Float[np.ndarray, "r n n"], float]:
    """M of weights of (choice, place) without the prior, and their cost."""
    families = experiment.families
    total = sum(w * families[f].information(np.atleast_2d(p))[:, 0] for (f, p), w in weights.items())
    return np.asarray(total), _cost(experiment, weights)


def _beside(found: Candidates, experiment: Experiment, criterion: Criterion) -> Iterator[tuple[str, float]]:
    for name, weights in usual_plans(found):
        information, cost = information_of_weights(experiment, weights)
        total = experiment.known + experiment.budget / cost * information
        yield name, criterion.reported(largest_variance(experiment, total))

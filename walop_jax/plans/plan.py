"""A plan of calibration exposures: which, how often, how well p will be known, and how far from the best plan that is.

The best weights and their proof are those of `optimal`, candidates and target those of `exposures`. Here they become
whole exposures in an order with few changes, with the price of leaving each out and the error over the field before and
after.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.io.display import Display, Displayed
from walop_jax.plans.exposures import Candidates, candidates
from walop_jax.plans.families import Listed
from walop_jax.plans.optimal import GAP, Allocation, Experiment, optimise, rounded
from walop_jax.science.star_errors import GOAL
from walop_jax.simulation.observing_plan import ObservingPlan, Stop, polariser_turn

GRID = 6
"""Field points along each axis at which the information of an exposure is computed, scaled to those of the plan."""
_STANDARD_ANGLES, _STANDARD_PATCHES = 15, 8


@dataclasses.dataclass(frozen=True)
class PlannedExposure:
    """One line of a plan: what is set, how often it is exposed, the time (s) of all of it, and what it is worth.

    `number` is that of the Moon patch or star, −1 through the polariser; `left_out` the factor by which the criterion
    grows without this line.
    """

    kind: str
    filter: str
    positions: Mapping[str, float | None]
    polariser_angle: float
    number: int
    times: int
    seconds: float
    left_out: float


@dataclasses.dataclass(frozen=True, repr=False)
class ExposurePlan(Displayed):
    """The exposures of a budget, the proof, and the error of p over the field before and after.

    `value` is the criterion of the exposures, `bound` the least that any plan of the same time can have, both as the
    error of p (fraction) at the worst field point and colour, mean over draws; `before` and `after` (draw, point) are
    errors of p (fraction) at `x`, `y` (deg), NaN where one exposure holds no u. `beside` are other plans of the same
    time: their criterion, as the same error.
    """

    minutes: float
    lines: tuple[PlannedExposure, ...]
    value: float
    bound: float
    weights_gap: float
    truncation: float
    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    before: Float[np.ndarray, "r p"]
    after: Float[np.ndarray, "r p"]
    beside: Mapping[str, float]
    observing_plan: ObservingPlan

    @property
    def gap(self) -> float:
        """Proven relative distance of the exposures' variance from the best: that of the criterion of `optimal`."""
        return (self.value / self.bound) ** 2 - 1.0

    @property
    def share(self) -> float:
        """Share of the field points and colours, of those that hold u, at which the error of p is below 0.1 %."""
        seen = self.after[:, np.isfinite(self.after).all(axis=0)]
        return float(np.mean(seen < GOAL))

    def document(self) -> dict[str, Any]:
        """The plan as plain data."""
        middle = np.median(self.after, axis=0)
        return {
            "minutes": self.minutes,
            "exposures": [
                dataclasses.asdict(line) | {"positions": dict(line.positions)} for line in self.lines
            ],
            "p_error_worst": self.value,
            "p_error_bound": self.bound,
            "gap": self.gap,
            "gap_of_weights": self.weights_gap,
            "truncation": self.truncation,
            "draws": len(self.after),
            "share_below_goal": self.share,
            "beside": dict(self.beside),
            "field": {"x": self.x.tolist(), "y": self.y.tolist(), "p_error": middle.tolist()},
            "plan": self.observing_plan.document(),
        }

    def display(self) -> Display:
        """The exposures in order, and how good they are."""
        middle = np.median(self.after, axis=0)
        seen = np.isfinite(middle)
        facts = {
            "time": f"{sum(line.seconds for line in self.lines) / 60:.1f} of {self.minutes:g} min",
            "error of p": f"{100 * self.value:.3g} % at the worst point, "
            f"{100 * np.median(middle[seen]):.3g} % in the median",
            "below 0.1 %": f"{100 * self.share:.0f} % of the field that holds u in one exposure",
            "proof": f"no plan of this time is better than {100 * self.bound:.3g} % at the worst point",
        }
        for name, error in self.beside.items():
            facts[name] = f"{100 * error:.3g} %: {(error / self.value) ** 2:.2g} times the time for the same"
        rows = tuple(
            (
                line.kind if line.number < 0 else f"{line.kind} {line.number}",
                line.filter,
                ", ".join(f"{p} {_angle(a)}" for p, a in line.positions.items()),
                _angle(line.polariser_angle if np.isfinite(line.polariser_angle) else None),
                str(line.times),
                f"{line.seconds:.0f}",
                f"{100 * (np.sqrt(line.left_out) - 1):+.2g} %",
            )
            for line in self.lines
        )
        return Display(
            title=f"Plan of {sum(line.times for line in self.lines)} exposures for {self.observing_plan.name}",
            facts=tuple(facts.items()),
            head=("KIND", "FILTER", "POSITIONS", ">POLARISER", ">TIMES", ">TIME / s", ">WITHOUT IT"),
            rows=rows,
        )


def _angle(angle: float | None) -> str:
    return "out" if angle is None else f"{angle:.1f}°"


def plan_exposures(
    could: ObservingPlan,
    minutes: float,
    *,
    known: Calibration | None = None,
    draws: int = 20,
    seed: int = 0,
    gap: float = GAP,
    progress: Callable[[str], None] | None = None,
) -> ExposurePlan:
    """The calibration exposures that make the error of p at the worst field point and colour smallest.

    `could` says what could be observed (see `exposures`), `minutes` the time there is; `known` is a calibration that is
    there already. Raises ValueError for a time that pays for nothing, NotEstimableError where nothing that could be
    observed, or too little in that time, determines the matrix.
    """
    few = dataclasses.replace(could, grid=min(could.grid, GRID), standard_grid=min(could.standard_grid, 3))
    found = candidates(few, draws=draws, seed=seed, progress=progress)
    return plan_from(found, could, minutes, known=known, gap=gap, progress=progress)


def plan_from(
    found: Candidates,
    could: ObservingPlan,
    minutes: float,
    *,
    known: Calibration | None = None,
    gap: float = GAP,
    progress: Callable[[str], None] | None = None,
) -> ExposurePlan:
    """As `plan_exposures`, from candidates that are there; their field points may be fewer than those of `could`."""
    tell = progress or (lambda text: None)
    few = found.plan
    prior = found.prior if known is None else found.prior + _information_of(known, found)
    factor = (len(could.points()) - _star_places(could)) / (len(few.points()) - _star_places(few))
    experiment = _scaled(found.experiment(minutes, prior), factor, found)
    tell("looking for the best plan")
    weights = optimise(experiment, gap=0.5 * gap, progress=tell)
    best = rounded(experiment, weights)
    return _finished(could, found, experiment, weights, best, minutes)


def _star_places(plan: ObservingPlan) -> int:
    return plan.standard_grid**2 if plan.standards else 0


def _scaled(experiment: Experiment, factor: float, found: Candidates) -> Experiment:
    """The information of as many field points as a plan has, from that of fewer that are spread alike."""
    families = tuple(
        family if label == "standard" else dataclasses.replace(family, basis=factor * family.basis)  # type: ignore[type-var]
        for family, label in zip(experiment.families, found.labels, strict=True)
    )
    return dataclasses.replace(experiment, families=families)


def _information_of(known: Calibration, found: Candidates) -> Float[np.ndarray, "f f"]:
    """What a calibration says of the parameters that it shares with the candidates' model."""
    names = [found.model.names[i] for i in found.model.free]
    both = [i for i, name in enumerate(names) if name in known.model.names]
    there = [known.model.index(names[i]) for i in both]
    covariance = known.covariance[np.ix_(there, there)]
    size = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    varied = size > 0
    scaled = covariance[np.ix_(varied, varied)] / np.outer(size[varied], size[varied])
    inverse = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) / np.outer(size[varied], size[varied])
    at = np.array(both)[varied]
    whole = np.zeros((len(names), len(names)))
    whole[np.ix_(at, at)] = inverse
    return whole


def _total(experiment: Experiment, plan: Allocation) -> Float[np.ndarray, "r n n"]:
    """M of a plan in every draw."""
    total = experiment.known.copy()
    for number, place, weight in zip(plan.family, plan.place, plan.weight, strict=True):
        family = experiment.families[number]
        total += weight * np.tensordot(family.basis, family.coefficients(place[None])[0], (1, 0))
    return total


def _covariance(total: Float[np.ndarray, "r n n"]) -> Float[np.ndarray, "r n n"]:
    """M⁻¹, scaled so that gauges drop out."""
    found = []
    for matrix in total:
        size = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
        scaled = matrix / np.outer(size, size)
        found.append(np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) / np.outer(size, size))
    return np.stack(found)


def _criterion(experiment: Experiment, total: Float[np.ndarray, "r n n"]) -> float:
    a = experiment.targets
    c = _covariance(total)
    return float(np.einsum("rknq,rnm,rkmq->rk", a, c, a, optimize=True).max(axis=1).mean())


def _finished(
    could: ObservingPlan,
    found: Candidates,
    experiment: Experiment,
    weights: Allocation,
    best: Allocation,
    minutes: float,
) -> ExposurePlan:
    total = _total(experiment, best)
    lines = tuple(_lines(could, found, experiment, best, total))
    stops = tuple(
        Stop(
            line.polariser_angle,
            line.filter,
            line.positions.get("CHWP"),
            {p: a for p, a in line.positions.items() if p != "CHWP"},
            line.times,
        )
        for line in lines
        if line.kind == "clp"
    )
    chosen = {
        kind: tuple(line.number for line in lines if line.kind == kind for _ in range(line.times))
        for kind in ("moon", "standard")
    }
    observing = dataclasses.replace(could, stops=stops, patches=chosen["moon"], stars=chosen["standard"])
    return ExposurePlan(
        minutes=minutes,
        lines=lines,
        value=0.01 * float(np.sqrt(best.value)),
        bound=0.01 * float(np.sqrt(best.bound)),
        weights_gap=weights.gap,
        truncation=found.truncation,
        x=found.x,
        y=found.y,
        before=found.p_error(_covariance(experiment.known)),
        after=found.p_error(_covariance(total)),
        beside=dict(_beside(found, experiment)),
        observing_plan=observing,
    )


def _lines(
    could: ObservingPlan,
    found: Candidates,
    experiment: Experiment,
    best: Allocation,
    total: Float[np.ndarray, "r n n"],
) -> Iterator[PlannedExposure]:
    """The exposures in order: setting by setting, the polariser turning one way, then the sky."""
    here = _criterion(experiment, total)
    settings = found.settings
    order = sorted(range(len(best.family)), key=lambda i: (int(best.family[i]), float(best.place[i][0])))
    for i in order:
        family, place, times = experiment.families[best.family[i]], best.place[i], int(best.weight[i])
        own = times * np.tensordot(family.basis, family.coefficients(place[None])[0], (1, 0))
        seconds = times * float(family.cost_at(place[None])[0])
        left_out = _criterion(experiment, total - own) / here
        label = found.labels[best.family[i]]
        if isinstance(family, Listed):
            yield PlannedExposure(
                label, could.filters[0], {}, float("nan"), round(float(place[0])), times, seconds, left_out
            )
        else:
            filter_name, positions = settings[best.family[i]]
            angle = float(np.rad2deg(place[0]) / 2)
            yield PlannedExposure("clp", filter_name, positions, angle, -1, times, seconds, left_out)


def _beside(found: Candidates, experiment: Experiment) -> Iterator[tuple[str, float]]:
    """Plans of the same time that are usual: even angles with the Moon, over half a turn, with each plate setting."""

    def error(weight: Mapping[tuple[int, float], float]) -> float:
        costs = {key: float(experiment.families[key[0]].cost_at(np.array([[key[1]]]))[0]) for key in weight}
        share = experiment.budget / sum(w * costs[key] for key, w in weight.items())
        plan = Allocation(
            np.array([key[0] for key in weight]),
            [np.array([key[1]]) for key in weight],
            np.array([share * w for w in weight.values()]),
            0.0, 1.0, 0,
        )  # fmt: skip
        return 0.01 * float(np.sqrt(_criterion(experiment, _total(experiment, plan))))

    polariser = [i for i, label in enumerate(found.labels) if label.startswith("clp")]
    sky = {
        (i, float(k)): _STANDARD_PATCHES / experiment.families[i].spread().shape[0]
        for i, label in enumerate(found.labels)
        if label == "moon"
        for k in range(len(experiment.families[i].spread()))
    }
    angles = [np.deg2rad(2 * a) for a in polariser_turn(_STANDARD_ANGLES)]
    even = {(polariser[0], a): 1.0 for a in angles}
    yield "even angles", error(even)
    if sky:
        yield "even angles and the Moon", error(even | sky)
    if len(polariser) > 1:
        yield "even angles at each setting", error({(i, a): 1.0 for i in polariser for a in angles})

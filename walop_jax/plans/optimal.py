"""Optimal experiments on a grid of candidates, with a bound on how far a plan is from the best there is.

Nothing here depends on the kind of measurement. A candidate i has the Fisher information M_i (n × n) and the cost
c_i; a plan gives it the weight w_i ≥ 0, how often it is done. With the prior information M₀ a plan leaves

    M(w) = M₀ + Σ_i w_i M_i,      Σ_i c_i w_i ≤ B,

and the variance of target k, some linear functions A_k (n × q) of the parameters, is φ_k(w) = tr A_kᵀ M(w)⁻¹ A_k. The
criterion is the largest of them, averaged over draws r of the instrument,

    f(w) = mean_r max_k φ_rk(w),

which holds A-, I- and c-optimality (one target), G-optimality (one target for each place) as cases. f is convex. The
same experiment may be asked about in several sets of parameters T_b, of information T_bᵀ M T_b, as for the separation
of each pair of hypotheses (Atkinson & Fedorov 1975, Biometrika 62, 57): the maximum is then over the targets of all.

Bound        For multipliers π_rk ≥ 0, Σ_k π_rk = 1, let L_r = Σ_k π_rk A_rk A_rkᵀ, G_r = M_r(w)⁻¹ L_r M_r(w)⁻¹. Every
             other plan v has, by Cauchy and Schwarz,
                 f(v) ≥ mean_r tr L_r M_r(v)⁻¹ ≥ (mean_r tr L_r M_r(w)⁻¹)² / mean_r tr G_r M_r(v),
             and the denominator is at most mean_r tr G_r M₀r + B max_i d_i / c_i, d_i = mean_r tr G_r M_ir: the
             equivalence theorem of Kiefer & Wolfowitz (1960, Canad. J. Math. 12, 363) as an inequality that holds at
             any w. The maximum is that over the grid, and in the end once that over a finer one.
Weights      Exchange: candidates with the largest d_i / c_i join, those without weight leave, until the bound is near.
             The maximum over targets is a power mean of growing power, whose minimum L-BFGS-B finds.
Whole        Numbers: `rounding`.

Units        Those of the caller: information per unit of weight, cost in those of the budget.
Limits       Local design: the information is that at assumed parameters, or its average over draws of them.
"""

from __future__ import annotations

import abc
import copy
import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy import linalg
from scipy.optimize import minimize

WeightVector = Float[np.ndarray, " s"]
OfTargets = Float[np.ndarray, "r k"]
InformationMatrices = Float[np.ndarray, "r n n"]
Key = tuple[int, int]
"""Number of the family of a candidate, and its own there."""
Weights = Mapping[Key, float]

GAP = 0.01  # distance from the bound at which the search ends
_ROUNDS = 40  # of candidates that join and leave
_POWERS = (8.0, 40.0, 200.0, 1000.0, 5000.0)  # of the mean that stands for the maximum over targets
_QUICKLY = 2  # of these powers that have a round each, whatever it brings
_BETTER = 0.02  # of the gap: a round that brings less is idle
_PATIENCE = 6  # idle rounds in a row after which the search ends
_STEPS = 300  # of L-BFGS-B in a round
_SPREAD, _OF_EACH = 96, 3  # candidates that a search begins with: of all families, of each at least
_TOPS, _OF_FAMILY = 24, 3  # candidates that may join in a round: of all families, of each
_LEAST_WEIGHT = 1e-5  # fraction of the budget below which a candidate leaves
_UNSEEN = 1e-13  # eigenvalue, of the scaled information of everything, below which a direction is not seen
_NOTHING = 1e-9  # of the information of everything
_NEAR = 0.8  # of the largest variance: targets below it wait until they are among the largest
_BUDGETS = 8  # tried until a criterion is met
_HIGH = 0.8  # of the largest gain: families that reach it nowhere on the grid do not exceed it between
_ENDLESS = 1e6  # times the budget: no plan reaches the criterion
_SMALL = 1e-3  # of the budget: the prior reaches the criterion already


class NotEstimableError(ValueError):
    """A target depends on parameters that neither the candidates nor the prior inform about."""


class Family(abc.ABC):
    """Candidates that have something in common; each has a number, an information matrix in every draw, and a cost."""

    cost: Float[np.ndarray, " m"]

    @abc.abstractmethod
    def information(self, numbers: Sequence[int]) -> Float[np.ndarray, "r s n n"]:
        """The matrices of some candidates."""

    @abc.abstractmethod
    def gains(self, g: InformationMatrices) -> Float[np.ndarray, " m"]:
        """Σ_r tr G_r M_r of every candidate."""

    def between(self, g: InformationMatrices) -> float:
        """The largest gain for its cost of exposures that lie between the candidates, where there are such."""
        return 0.0


@dataclasses.dataclass(frozen=True)
class Listed(Family):
    """Candidates one by one, by their matrices (draw, candidate, parameter, parameter)."""

    matrices: Float[np.ndarray, "r m n n"]
    cost: Float[np.ndarray, " m"]

    @classmethod
    def of(
        cls, matrices: Float[np.ndarray, "r m n n"], cost: float | Float[np.ndarray, " m"] = 1.0
    ) -> Listed:
        """Candidates of one cost, or each of its own."""
        return cls(matrices, np.array(np.broadcast_to(cost, matrices.shape[1]), float))

    def information(self, numbers: Sequence[int]) -> Float[np.ndarray, "r s n n"]:
        """Matrices of the candidates with these numbers."""
        return self.matrices[:, list(numbers)]

    def gains(self, g: InformationMatrices) -> Float[np.ndarray, " m"]:
        """Σ_r tr G_r M_r of every candidate."""
        r, m = self.matrices.shape[:2]
        return np.einsum("rma,ra->m", self.matrices.reshape(r, m, -1), g.reshape(r, -1), optimize=True)


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Problem to be solved: targets, prior information and candidates.

    `families` are the candidates, of draws of n parameters; `blocks` T (block, n, own) lead from the parameters in
    which targets are asked for (None: the same). `known` is M₀ (draw and block, own, own), the blocks of a draw one
    after the other, `targets` A (draw and block, target, own, q); `budget` is the cost that a plan may have.
    """

    known: InformationMatrices
    targets: Float[np.ndarray, "r k n q"]
    families: tuple[Family, ...]
    budget: float
    blocks: Float[np.ndarray, "b f n"] | None = None

    @property
    def together(self) -> int:
        """Number of blocks, which share their largest variance."""
        return 1 if self.blocks is None else len(self.blocks)

    def cost(self, weights: Weights) -> float:
        """The cost Σ c w of a plan, in the unit of the budget."""
        return sum(weight * float(self.families[f].cost[i]) for (f, i), weight in weights.items())

    def information(self, keys: Sequence[Key]) -> Float[np.ndarray, "r s n n"]:
        """Matrices of candidates, in the parameters of the targets."""
        matrices = np.concatenate([self.families[f].information([i]) for f, i in keys], axis=1)
        if self.blocks is None:
            return matrices
        turned = self.blocks.swapaxes(1, 2)[:, None] @ matrices[:, None] @ self.blocks[:, None]
        return turned.reshape(-1, *turned.shape[2:])

    def total(self, weights: Weights) -> InformationMatrices:
        """Σ w M without the prior."""
        keys = list(weights)
        if not keys:
            return np.zeros_like(self.known)
        return np.einsum("s,rsab->rab", np.array([weights[key] for key in keys]), self.information(keys))

    def of_families(self, g: InformationMatrices) -> Float[np.ndarray, "d f f"]:
        """G in the parameters of the families, so that Σ tr G M is the same."""
        if self.blocks is None:
            return g
        each = g.reshape(-1, self.together, *g.shape[1:])
        return np.asarray(np.einsum("bfn,rbnm,bgm->rfg", self.blocks, each, self.blocks, optimize=True))

    def largest(self, phi: OfTargets) -> Float[np.ndarray, " g"]:
        """The largest variance of each draw."""
        return np.asarray(phi.reshape(len(phi) // self.together, -1).max(axis=1))

    def relative(self, phi: OfTargets) -> OfTargets:
        """Variances over the largest of their draw."""
        return phi / np.repeat(self.largest(phi), self.together)[:, None]

    def of_one(self, shares: OfTargets) -> OfTargets:
        """Multipliers with sum 1 in each draw."""
        total = shares.reshape(len(shares) // self.together, -1).sum(axis=1)
        return shares / np.repeat(total, self.together)[:, None]

    def reduced(self) -> Experiment:
        """The problem in coordinates in which the information of everything together is the identity.

        Directions that nothing informs about (gauges) are left out. Raises NotEstimableError if a target needs one.
        """
        start = spread(self)
        total = (self.known + self.total(start)).mean(axis=0)
        size = np.sqrt(np.clip(np.diag(total), 0.0, None))
        size = np.where(size > 0, size, 1.0)
        value, vector = linalg.eigh(total / np.outer(size, size))
        informed = value > _UNSEEN * value[-1]
        to_seen = vector[:, informed] / size[:, None] / np.sqrt(value[informed])  # θ = to_seen · z
        lost = np.einsum("na,rknq->rkaq", vector[:, ~informed] / size[:, None], self.targets)
        visible = np.einsum("na,rknq->rkaq", to_seen, self.targets)
        # A target is estimable if it has no part in the null space of the total information.
        lost_share = np.linalg.norm(lost, axis=(2, 3)) if lost.shape[2] else np.zeros(lost.shape[:2])
        bad = np.flatnonzero((lost_share > 1e-6 * np.linalg.norm(visible, axis=(2, 3))).any(axis=0))
        if len(bad):
            listed = ", ".join(map(str, bad[:5].tolist()))
            raise NotEstimableError(f"targets {listed} depend on parameters that no candidate informs about")
        # Directions that a few candidates leave open get next to no information: no target needs them, or it is bad.
        prior = to_seen.T @ self.known @ to_seen + _NOTHING * np.eye(int(informed.sum()))
        blocks = np.eye(len(to_seen))[None] if self.blocks is None else self.blocks
        return Experiment(prior, visible, self.families, self.budget, blocks @ to_seen)


def spread(experiment: Experiment) -> dict[Key, float]:
    """A few candidates, evenly through each family, that cost the budget: with them a search begins."""
    count = max(_SPREAD // len(experiment.families), _OF_EACH)
    keys = [
        (f, int(i))
        for f, family in enumerate(experiment.families)
        for i in np.unique(np.linspace(0, len(family.cost), count, endpoint=False).astype(int))
    ]
    each = experiment.budget / len(keys)
    return {(f, i): each / float(experiment.families[f].cost[i]) for f, i in keys}


@dataclasses.dataclass(frozen=True)
class Bound:
    """Bound on all plans: f ≥ here² / (known + budget · ratio), in the symbols of the module."""

    here: float
    known: float
    ratio: float

    def value(self, budget: float) -> float:
        """The least criterion of any plan of a budget."""
        return self.here**2 / (self.known + budget * self.ratio)

    def mean(self, budget: float) -> float:
        """The gain for its cost of the candidates of the plan from which the bound comes, on average."""
        return (self.here - self.known) / budget

    def budget(self, value: float) -> float:
        """The least budget of any plan that reaches a criterion."""
        return max((self.here**2 / value - self.known) / self.ratio, 0.0)


@dataclasses.dataclass(frozen=True)
class Allocation:
    """Number of times for each candidate in it, the criterion, and the least that any plan of this budget can have.

    `bound` ≤ the criterion of every plan; `proof` says so for other budgets as well.
    """

    weights: Weights
    value: float
    bound: float
    proof: Bound

    @property
    def gap(self) -> float:
        """Relative distance of the criterion from its bound, and so at most from that of the best plan."""
        return self.value / self.bound - 1.0


class Some:
    """The problem for a few candidates: their matrices laid out, with variances and slopes."""

    def __init__(self, experiment: Experiment, keys: Iterable[Key]) -> None:
        self.experiment, self.keys = experiment, list(keys)
        self.matrices = experiment.information(self.keys)
        self.costs = np.array([float(experiment.families[f].cost[i]) for f, i in self.keys])
        r, _, n, q = experiment.targets.shape
        self.wide = np.moveaxis(experiment.targets, 2, 1).reshape(r, n, -1)
        self.columns = q

    def with_more(self, keys: Iterable[Key]) -> Some:
        """This problem with further candidates at the end."""
        more = [key for key in keys if key not in self.keys]
        if not more:
            return self
        both = copy.copy(self)
        both.keys, costs = self.keys + more, [float(self.experiment.families[f].cost[i]) for f, i in more]
        both.matrices = np.concatenate([self.matrices, self.experiment.information(more)], axis=1)
        both.costs = np.append(self.costs, costs)
        return both

    def only(self, which: Sequence[int]) -> Some:
        """This problem with some of its candidates."""
        some = copy.copy(self)
        some.keys, some.matrices = [self.keys[i] for i in which], self.matrices[:, list(which)]
        some.costs = self.costs[list(which)]
        return some

    def covariance(self, weight: WeightVector) -> InformationMatrices:
        """M(w)⁻¹ of every draw (r, n, n), for the weights of the candidates."""
        r, s, n, _ = self.matrices.shape
        information = self.experiment.known + (weight @ self.matrices.reshape(r, s, -1)).reshape(r, n, n)
        return np.linalg.inv(0.5 * (information + np.swapaxes(information, 1, 2)))

    def variances(self, weight: WeightVector) -> OfTargets:
        """The variances φ of every target (draw, target)."""
        return self._by_target(self.wide * (self.covariance(weight) @ self.wide))

    def _by_target(self, products: Float[np.ndarray, "r n kq"]) -> OfTargets:
        return products.sum(axis=1).reshape(len(products), -1, self.columns).sum(axis=-1)

    def value(self, weight: WeightVector) -> float:
        """The criterion f(w); infinite where a target is not determined."""
        try:
            return float(self.experiment.largest(self.variances(weight)).mean())
        except np.linalg.LinAlgError:
            return np.inf

    def near(self, *weights: WeightVector) -> Some:
        """This problem for the targets with the largest variances in some plans: its value is at most that for all
        targets.
        """
        relative = np.maximum.reduce([self.experiment.relative(self.variances(weight)) for weight in weights])
        kept = np.argsort(-relative, axis=1)[:, : int((relative >= _NEAR).sum(axis=1).max())]
        some, (r, n, _) = copy.copy(self), self.wide.shape
        columns = np.take_along_axis(
            self.wide.reshape(r, n, -1, self.columns), kept[:, None, :, None], axis=2
        )
        some.wide = columns.reshape(r, n, -1)
        return some

    def power_mean(self, weight: WeightVector, power: float) -> tuple[float, WeightVector]:
        """mean_r (Σ_k φ_rk^p)^(1/p) and its slope."""
        covariance = self.covariance(weight)
        y = covariance @ self.wide
        phi = self._by_target(self.wide * y)
        top = self.experiment.largest(phi)
        raised = self.experiment.relative(phi) ** power
        total = raised.reshape(len(top), -1).sum(axis=1)
        # d‖φ‖_p / dφ_k = (φ_k / ‖φ‖_p)^(p − 1)
        each = np.repeat(top * total ** (1.0 / power), self.experiment.together)[:, None]
        push = (phi / each) ** (power - 1.0) / len(top)
        g = (y * np.repeat(push, self.columns, axis=1)[:, None]) @ y.swapaxes(1, 2)
        r, s = self.matrices.shape[:2]
        slope = -np.einsum("rsa,ra->s", self.matrices.reshape(r, s, -1), g.reshape(r, -1), optimize=True)
        return float((top * total ** (1.0 / power)).mean()), slope

    def solved(self, share: WeightVector, power: float, gap: float) -> WeightVector:
        """Fractions of the budget with the least power mean; those given are where the search begins."""
        each, begin = self.experiment.budget / self.costs, [share]
        if power <= _POWERS[0]:
            return self._solved(share, power, gap)
        while True:
            # Targets that are not among the largest wait until they are.
            near = self.near(*(each * one for one in begin))
            share = near._solved(begin[-1], power, gap)
            if self.value(each * share) <= near.value(each * share) * (1 + 0.1 * gap):
                return share
            begin.append(share)

    def _solved(self, share: WeightVector, power: float, gap: float) -> WeightVector:
        each = self.experiment.budget / self.costs

        def function(free: WeightVector) -> tuple[float, WeightVector]:
            total = free.sum()
            value, slope = self.power_mean(each * free / total, power)
            along = each * slope
            # Only the proportions of the weights matter: their sum is kept near 1.
            return np.log(value) + 0.5 * (total - 1.0) ** 2, (
                (along - along @ free / total) / total / value + total - 1.0
            )

        options = {"maxiter": _STEPS, "maxcor": 30, "ftol": 1e-3 * gap / _STEPS, "gtol": 0.02 * gap}
        found = minimize(
            function, share, jac=True, method="L-BFGS-B", bounds=[(1e-9, None)] * len(share), options=options
        )
        return found.x / found.x.sum()


def optimise(
    experiment: Experiment, *, gap: float = GAP, progress: Callable[[str], None] | None = None
) -> Allocation:
    """The plan with the least criterion, to a relative `gap` from its bound, and the bound.

    `progress` gets value, bound and gap of every round.
    Raises NotEstimableError for a target that nothing informs about, ValueError for a budget that is not positive. The
    gap that was reached is `Allocation.gap`.
    """
    if not experiment.budget > 0:
        raise ValueError(f"the budget is {experiment.budget:g}: nothing can be done with it")
    return _best(experiment.reduced(), gap, progress)


def _best(problem: Experiment, gap: float, progress: Callable[[str], None] | None = None) -> Allocation:
    """The plan of `optimise`, for a problem in the coordinates of `Experiment.reduced`."""
    some = Some(problem, spread(problem))
    share, level = np.full(len(some.keys), 1.0 / len(some.keys)), 0
    proof, value, weight, at, idle = None, np.inf, share, some, 0
    for turn in range(1, _ROUNDS + 1):
        power, each = _POWERS[level], problem.budget / some.costs
        share = some.solved(share, power, gap)
        here, covariance = some.value(each * share), some.covariance(each * share)
        shares = multipliers(some, each * share, power)
        bound, gains = bounded(problem, covariance, shares)
        new, known = bound.value(problem.budget), 0.0 if proof is None else proof[0].value(problem.budget)
        better = here < value * (1 - _BETTER * gap) or new > known * (1 + _BETTER * gap)
        idle = 0 if better else idle + 1
        if here < value:
            value, weight, at = here, each * share, some
        if proof is None or new > known:
            proof = bound, covariance, shares
        least = proof[0].value(problem.budget)
        if progress is not None:
            progress(
                f"round {turn}: criterion {value:g}, bound {least:g}, gap {100 * (value / least - 1):.2g} %"
            )
        if value <= least * (1 + gap) or idle >= _PATIENCE:
            break
        kept = np.flatnonzero(share > _LEAST_WEIGHT)
        some, share = some.only(kept.tolist()), share[kept]
        # The slope of the power mean: candidates above it lower it.
        promising = [key for key, ratio in tops(problem, gains) if ratio > bound.mean(problem.budget)]
        larger = some.with_more(promising)
        news = len(larger.keys) - len(some.keys)
        some, share = larger, np.append(share, np.full(news, 1e-3))
        share = share / share.sum()
        converged = bound.ratio < (1 + 0.5 * gap) * bound.mean(problem.budget)
        if converged or not news or level < _QUICKLY or idle:
            level = min(level + 1, len(_POWERS) - 1)
    assert proof is not None
    final, _ = bounded(problem, proof[1], proof[2], finer=True)
    used = np.flatnonzero(weight * at.costs > _LEAST_WEIGHT * problem.budget)
    weights = {at.keys[i]: float(weight[i]) for i in used}
    return Allocation(weights, value, final.value(problem.budget), final)


def lower_bound(
    experiment: Experiment, covariance: InformationMatrices, shares: OfTargets, *, finer: bool = False
) -> Bound:
    """The least criterion that any plan can have (see the module), over the grid or the finer one.

    `covariance` is M(w)⁻¹ of a plan, `shares` multipliers π of the targets with sum 1 in each draw. Any of both gives
    a valid bound; those of the optimum give the largest.
    """
    return bounded(experiment, covariance, shares, finer=finer)[0]


def bounded(
    problem: Experiment, covariance: InformationMatrices, shares: OfTargets, finer: bool = False
) -> tuple[Bound, list[Float[np.ndarray, " m"]]]:
    """The bound, and the gains d_i of all candidates that it is made of."""
    r, _, n, q = problem.targets.shape
    wide = np.moveaxis(problem.targets, 2, 1).reshape(r, n, -1)
    y = covariance @ wide
    shared, draws = y * np.repeat(shares, q, axis=1)[:, None], r // problem.together
    g = shared @ y.swapaxes(1, 2) / draws
    of_families = problem.of_families(g)
    gains = [family.gains(of_families) for family in problem.families]
    ratio = max(float((gain / f.cost).max()) for gain, f in zip(gains, problem.families, strict=True))
    if finer:
        pairs = zip(gains, problem.families, strict=True)
        near = [family for gain, family in pairs if (gain / family.cost).max() >= _HIGH * ratio]
        ratio = max(ratio, *(family.between(of_families) for family in near))
    here = float((shared * wide).sum()) / draws
    return Bound(here, float((g * problem.known).sum()), ratio), gains


def multipliers(some: Some, weight: WeightVector, power: float) -> OfTargets:
    """π of the targets by the slope of a power mean."""
    relative = some.experiment.relative(some.variances(weight))
    return some.experiment.of_one(relative ** (power - 1.0))


def tops(problem: Experiment, gains: Sequence[Float[np.ndarray, " m"]]) -> list[tuple[Key, float]]:
    """The candidates with the largest gain for their cost, few of each family, and that ratio; largest first."""
    found = []
    for f, (gain, family) in enumerate(zip(gains, problem.families, strict=True)):
        ratio = gain / family.cost
        peaks = np.flatnonzero((ratio >= np.roll(ratio, 1)) & (ratio >= np.roll(ratio, -1)))
        best = peaks[np.argsort(-ratio[peaks])][:_OF_FAMILY]
        found += [((f, int(i)), float(ratio[i])) for i in best]
    return sorted(found, key=lambda pair: -pair[1])[:_TOPS]


def least_budget(experiment: Experiment, value: float, *, gap: float = GAP) -> tuple[Allocation, float]:
    """The plan of the least budget that reaches a criterion, to `gap`, and a budget that none can reach it below.

    The budget of the plan is Σ weight · cost. Raises as `optimise`, and NotEstimableError for a value that more and
    more of the candidates does not reach.
    """
    problem = experiment.reduced()

    def best(budget: float) -> Allocation:
        return _best(dataclasses.replace(problem, budget=budget), 0.5 * gap)

    budget = experiment.budget
    plan = best(budget)
    least = plan.proof.budget(value)
    for _ in range(_BUDGETS - 1):
        if abs(plan.value / value - 1.0) <= 0.5 * gap or budget <= _SMALL * experiment.budget:
            break
        # Prior information bends the law 1 / budget: the bound says where it meets the value.
        budget = max(plan.proof.budget(value) * plan.value / plan.bound, _SMALL * experiment.budget)
        if budget > _ENDLESS * experiment.budget:
            raise NotEstimableError(f"the criterion does not fall below {plan.bound:.3g}, whatever is spent")
        plan = best(budget)
        least = max(least, plan.proof.budget(value))
    return plan, least


def criterion_without_and_with(
    experiment: Experiment, plan: Allocation
) -> tuple[dict[Key, float], dict[Key, float]]:
    """The criterion of a plan without one candidate, and with one more of it, over that of the plan as it is.

    Two dictionaries by candidate: 1.2 in the first says that the error grows by 20 % without that candidate.
    """
    some = Some(experiment.reduced(), plan.weights)
    weight, units = np.array(list(plan.weights.values())), np.eye(len(plan.weights))
    value = some.value(weight)
    without = [some.value(weight * (1.0 - unit)) / value for unit in units]
    added = [some.value(weight + unit) / value for unit in units]
    return dict(zip(some.keys, without, strict=True)), dict(zip(some.keys, added, strict=True))

"""Optimal experiments from information matrices, with a proof of how far a plan is from the best there is.

Nothing here depends on the kind of measurement. A candidate i has the Fisher information M_i (n × n) and the cost
c_i; a plan gives it the weight w_i ≥ 0, how often it is done. With the prior information M₀ a plan leaves

    M(w) = M₀ + Σ_i w_i M_i,      Σ_i c_i w_i ≤ B,

and the variance of target k, some linear functions A_k (n × q) of the parameters, is φ_k(w) = tr A_kᵀ M(w)⁻¹ A_k. The
criterion is the largest of them, averaged over draws r of the instrument,

    f(w) = mean_r max_k φ_rk(w),

which holds A-, I- and c-optimality (one target), G-optimality (one target for each place) as cases. f is convex. Draws
may share their largest variance in groups: the same experiment in other parameters, as for the separation of each pair
of hypotheses (Atkinson & Fedorov 1975, Biometrika 62, 57). The mean is then one over groups, the maximum over all that
a group holds.

Proof        For multipliers π_rk ≥ 0, Σ_k π_rk = 1, let L_r = Σ_k π_rk A_rk A_rkᵀ, G_r = M_r(w)⁻¹ L_r M_r(w)⁻¹. Every
             other plan v has, by Cauchy and Schwarz,
                 f(v) ≥ mean_r tr L_r M_r(v)⁻¹ ≥ (mean_r tr L_r M_r(w)⁻¹)² / mean_r tr G_r M_r(v),
             and the denominator is at most mean_r tr G_r M₀r + B max_i d_i / c_i, d_i = mean_r tr G_r M_ir. The
             maximum over all candidates, a continuum of them included, therefore bounds f from below: the equivalence
             theorem of Kiefer & Wolfowitz (1960, Canad. J. Math. 12, 363) as an inequality that holds at any w.
Candidates   come in families (`families`): a list, of a million if need be, or a continuum of angles.
Solution     Column generation: a log-barrier Newton method solves the problem for a few candidates (min mean t_r with
             φ_rk ≤ t_r; Boyd & Vandenberghe 2004, Convex Optimization, 11.3), those with the largest d_i / c_i join,
             those without weight leave, until the proven gap is small.
Rounding     Weights rounded down, the rest of the budget spent where it lowers f most for its cost, then exchanges of
             single candidates while they lower f (Fedorov 1972, Theory of Optimal Experiments); the loss is proven by
             the same lower bound.

Units        Those of the caller: information per unit of weight, cost in those of the budget.
Limits       Local design: the information is that at assumed parameters, or its average over draws of them.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg

from walop_jax.likelihood.inverses import root_of
from walop_jax.plans.families import Family

Weight = Float[np.ndarray, " s"]
OfTargets = Float[np.ndarray, "r k"]
Matrices = Float[np.ndarray, "r n n"]
Levels = Float[np.ndarray, " g"]
Vector = Float[np.ndarray, " v"]

GAP = 0.01  # proven distance from the optimum at which the search ends
_ROUNDS = 60  # of column generation
_NEWTON = 80  # steps for one set of candidates
_SHARPER = 8.0  # factor by which the barrier falls between two Newton solutions
_LEAST_WEIGHT = 1e-5  # share of the budget below which a candidate leaves
_UNSEEN = 1e-13  # eigenvalue, of the scaled information of everything, below which a direction is not seen
_MAIN = 1e-5  # of the largest eigenvalue: curvature below it is left out of a step
_ROUGH, _EXACT = 0.1, 1e-4  # of μ: Newton's decrement at which a centre is left, and at which it is found
_BENT = 5  # draws whose curvature stands for that of all
_NEAR = 0.85  # of the largest variance: targets below it wait until they are among the largest
_ROUNDING = 1e-15  # of a matrix of unit diagonal, for each of its rows
_NOTHING = 1e-9  # of the information of everything
_HOPELESS = 1e3  # times the criterion of the best weights: some target is not determined
_EXCHANGES = 200
_TRIED = 60  # exchanges, most promising first, of which the first that lowers the criterion is made
_SHARPNESS = 20  # power of the variances by which targets share the slope of an exchange
_BUDGETS = 8  # tried until a criterion is met
_ENDLESS = 1e6  # times the budget: no plan reaches the criterion
_SMALL = 1e-3  # of the budget: the prior reaches the criterion already
_ONE_PLACE = 4e-3  # between coordinates that are one: 0.1° of half a turn, and less than a step in a list
_TOPS = 8  # candidates of each family that may join in a round
_PATIENCE = 4  # rounds without a better bound or value after which the search ends


class NotEstimableError(ValueError):
    """A target depends on parameters that neither the candidates nor the prior inform about."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Problem to be solved: targets, prior information and candidates.

    `known` is M₀ (draw, n, n), `targets` A (draw, target, n, q), `families` the candidates, `budget` the cost that a
    plan may have; `together` draws in a row share their largest variance. Raises NotEstimableError, when solved, if a
    target depends on a direction nothing informs about.
    """

    known: Matrices
    targets: Float[np.ndarray, "r k n q"]
    families: tuple[Family, ...]
    budget: float
    together: int = 1

    def largest(self, phi: OfTargets) -> Levels:
        """The largest variance of each group of draws."""
        return np.asarray(phi.reshape(len(phi) // self.together, -1).max(axis=1))

    def relative(self, phi: OfTargets) -> OfTargets:
        """Variances over the largest of their group."""
        return phi / np.repeat(self.largest(phi), self.together)[:, None]

    def of_one(self, shares: OfTargets) -> OfTargets:
        """Multipliers with sum 1 in each group."""
        total = shares.reshape(len(shares) // self.together, -1).sum(axis=1)
        return shares / np.repeat(total, self.together)[:, None]

    def reduced(self) -> Experiment:
        """The same in coordinates in which the information of everything together is the identity.

        Directions that nothing informs about (gauges) are left out. Raises NotEstimableError if a target needs one.
        """
        each = self.budget / len(self.families)
        shares = [each / family.cost_at(family.spread()) for family in self.families]
        total = self.known.mean(axis=0) + sum(
            np.tensordot(w / len(w), f.information(f.spread()).mean(axis=0), (0, 0))
            for w, f in zip(shares, self.families, strict=True)
        )
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
        families = tuple(family.turned(to_seen[None]) for family in self.families)
        # Directions that a few candidates leave open get next to no information: no target needs them, or it is bad.
        prior = to_seen.T @ self.known @ to_seen + _NOTHING * np.eye(int(informed.sum()))
        return Experiment(prior, visible, families, self.budget, self.together)


@dataclasses.dataclass(frozen=True)
class Bound:
    """Bound on all plans: f ≥ here² / (known + budget · ratio), in the symbols of the module.

    `tops` are the candidates that promise most, as number of the family and place.
    """

    here: float
    known: float
    ratio: float
    tops: tuple[tuple[int, Float[np.ndarray, " _"]], ...]

    def value(self, budget: float) -> float:
        """The least criterion of any plan of a budget."""
        return self.here**2 / (self.known + budget * self.ratio)

    def budget(self, value: float) -> float:
        """The least budget of any plan that reaches a criterion."""
        return max((self.here**2 / value - self.known) / self.ratio, 0.0)


@dataclasses.dataclass(frozen=True)
class Allocation:
    """Number of times for each candidate, the criterion, and the least that any plan of this budget can have.

    `family` (number of the family), `place` (its coordinates there) and `weight` are one for each candidate in it.
    `bound` ≤ the criterion of every plan; `proof` says so for other budgets as well.
    """

    family: Int[np.ndarray, " s"]
    place: list[Float[np.ndarray, " _"]]
    weight: Weight
    value: float
    bound: float
    proof: Bound

    @property
    def gap(self) -> float:
        """Proven relative distance of the criterion from that of the best plan."""
        return self.value / self.bound - 1.0

    @property
    def weights(self) -> dict[tuple[int, tuple[float, ...]], float]:
        """The weights by family and place."""
        keys = ((int(f), tuple(p.tolist())) for f, p in zip(self.family, self.place, strict=True))
        return dict(zip(keys, self.weight.tolist(), strict=True))


class _Some:
    """The problem for a few candidates: their matrices laid out, and the barrier method on them."""

    def __init__(self, experiment: Experiment, chosen: Sequence[tuple[int, Float[np.ndarray, " _"]]]) -> None:
        self.experiment, self.chosen = experiment, list(chosen)
        places = [(experiment.families[number], np.atleast_2d(place)) for number, place in self.chosen]
        self.matrices = np.stack([f.information(at)[:, 0] for f, at in places], axis=1)  # (r, s, n, n)
        self.costs = np.array([float(family.cost_at(at)[0]) for family, at in places])
        _, k, _, q = experiment.targets.shape
        self.wide = _side_by_side(experiment.targets)
        self.per_target = (k, q)

    def information(self, weight: Weight) -> Matrices:
        """M(w) of every draw."""
        r, s, n, _ = self.matrices.shape
        information = self.experiment.known + (weight @ self.matrices.reshape(r, s, -1)).reshape(r, n, n)
        return 0.5 * (information + np.swapaxes(information, 1, 2))

    def covariance(self, weight: Weight) -> Matrices:
        """M(w)⁻¹ of every draw."""
        return np.linalg.inv(self.information(weight))

    def variances(self, weight: Weight) -> OfTargets:
        """φ of every target."""
        return self._by_target(self.wide * (self.covariance(weight) @ self.wide))

    def _by_target(self, products: Float[np.ndarray, "*l n kq"]) -> Float[np.ndarray, "*l k"]:
        """Sums over the parameters and the columns of each target."""
        summed = products.sum(axis=-2)
        return summed.reshape(*summed.shape[:-1], *self.per_target).sum(axis=-1)

    def gains(self, y: Float[np.ndarray, "r n kq"]) -> Float[np.ndarray, "r s k"]:
        """−∂φ/∂w: tr y_kᵀ M_s y_k of every target and candidate, y = M⁻¹ A."""
        (k, q), (r, s, n, _) = self.per_target, self.matrices.shape
        gains = np.empty((r, s, k))
        for columns, matrices, into in zip(y, self.matrices, gains, strict=True):
            by_target = columns.reshape(n, k, q).transpose(1, 0, 2)
            into[:] = matrices.reshape(s, -1) @ (by_target @ by_target.swapaxes(1, 2)).reshape(k, -1).T
        return gains

    def plan(self, weight: Weight, least: float, bound: float, proof: Bound) -> Allocation:
        """The candidates that cost more than `least` with their weights."""
        used = np.flatnonzero(weight * self.costs > least)
        family, place = np.array([self.chosen[i][0] for i in used]), [self.chosen[i][1] for i in used]
        return Allocation(family, place, weight[used], self.value(weight), bound, proof)

    def value(self, weight: Weight) -> float:
        """The criterion f(w)."""
        return float(self.experiment.largest(self.variances(weight)).mean())

    def solve(self, weight: Weight, gap: float) -> tuple[Weight, OfTargets]:
        """Weights within `gap` of the best, and the multipliers π of the targets.

        Barrier: mean_g t_g − μ [Σ log(t_g − φ_rk) + Σ log w_s], g the group of r, Newton in (w, t) on the budget's
        plane.
        """
        weight = np.maximum(weight, 1e-3 * self.experiment.budget / self.costs.sum())
        weight *= self.experiment.budget / (self.costs @ weight)
        phi = self.variances(weight)
        peak = np.zeros(phi.shape)
        while True:
            peak = np.maximum(peak, self.experiment.relative(phi))
            near = _nearest(peak)
            weight, shares = self._of_targets(near)._solved(weight, gap)
            phi = self.variances(weight)
            top = self.experiment.largest(np.take_along_axis(phi, near, axis=1))
            if np.all(self.experiment.largest(phi) <= (1.0 + 0.1 * gap) * top):
                multipliers = np.zeros(phi.shape)
                np.put_along_axis(multipliers, near, shares, axis=1)
                return weight, multipliers

    def worst(self, phi: OfTargets) -> _Some:
        """The same for the targets with the largest variances: whose value bounds that of all from below."""
        return self._of_targets(_nearest(self.experiment.relative(phi)))

    def _of_targets(self, near: Int[np.ndarray, "r l"]) -> _Some:
        """The same for some of the targets of each draw."""
        subset = copy.copy(self)
        r, _, n, q = self.experiment.targets.shape
        columns = np.take_along_axis(self.wide.reshape(r, n, -1, q), near[:, None, :, None], axis=2)
        subset.wide = columns.reshape(r, n, -1)
        subset.per_target = (near.shape[1], q)
        return subset

    def _solved(self, weight: Weight, gap: float) -> tuple[Weight, OfTargets]:
        phi = self.variances(weight)
        constraints = phi.size + len(weight)
        level = self.experiment.largest(phi)
        mu = level.mean() / constraints
        level = level + len(level) * mu
        least = 0.2 * gap * level.mean() / constraints
        while mu > 1.1 * least:
            weight, level = self._centred(weight, level, mu, _ROUGH)
            mu = max(mu / _SHARPER, least)
        weight, level = self._centred(weight, level, mu, _EXACT)
        slack = self._slack(level, self.variances(weight))
        return weight, self.experiment.of_one(1.0 / np.maximum(slack, 1e-300))

    def _slack(self, level: Levels, phi: OfTargets) -> OfTargets:
        return np.repeat(level, self.experiment.together)[:, None] - phi

    def _barrier(self, weight: Weight, level: Levels, mu: float) -> float:
        if np.any(weight <= 0):
            return np.inf
        try:
            slack = self._slack(level, self.variances(weight))
        except np.linalg.LinAlgError:
            return np.inf
        if np.any(slack <= 0):
            return np.inf
        return float(level.mean() - mu * (np.log(slack).sum() + np.log(weight).sum()))

    def _centred(self, weight: Weight, level: Levels, mu: float, enough: float) -> tuple[Weight, Levels]:
        """Newton's method for one μ, until its decrement is `enough` of μ."""
        s, r = len(weight), len(level)
        sample = slice(None, None, -(-len(self.wide) // _BENT))

        def grouped(values: Float[np.ndarray, "*d"]) -> Float[np.ndarray, "*g"]:
            return values.reshape(r, -1, *values.shape[1:]).sum(axis=1)

        for _ in range(_NEWTON):
            covariance = self.covariance(weight)
            y = covariance @ self.wide
            slope = -self.gains(y)
            slack = self._slack(level, self._by_target(self.wide * y))
            push = mu / slack
            # Curvature of the φ: Σ_k push_k 2 tr(M_s P M_t Q), P = M⁻¹, Q = Σ_k push_k y_k y_kᵀ. Its main part in some
            # of the draws, which are much alike, is enough to step by.
            pushed = y[sample] * np.repeat(push[sample], self.per_target[1], axis=1)[:, None]
            inverse_root = np.linalg.inv(np.linalg.cholesky(self.information(weight)[sample]))
            right = root_of(pushed @ np.swapaxes(y[sample], 1, 2), _MAIN)
            products = inverse_root[:, None] @ (self.matrices[sample] @ right[:, None])
            flat = np.moveaxis(products, 1, 0).reshape(s, -1)
            alike = push.sum() / push[sample].sum()
            hessian = np.zeros((s + r, s + r))
            gradient = np.zeros(s + r)
            gradient[:s] = np.einsum("rk,rsk->s", push, slope) - mu / weight
            gradient[s:] = 1.0 / r - grouped(push.sum(axis=1))
            hessian[:s, :s] = 2.0 * alike * flat @ flat.T + np.diag(mu / weight**2)
            stiff = mu / slack**2
            hessian[:s, :s] += np.einsum("rsk,rtk->st", slope * stiff[:, None], slope, optimize=True)
            hessian[:s, s:] = -grouped(np.einsum("rk,rsk->rs", stiff, slope)).T
            hessian[s:, :s] = hessian[:s, s:].T
            hessian[s:, s:] += np.diag(grouped(stiff.sum(axis=1)))
            step = _on_the_budget(hessian, gradient, np.append(self.costs, np.zeros(r)))
            decrement = float(-gradient @ step)
            current, length = self._barrier(weight, level, mu), 1.0
            while length > 1e-10:
                new = weight + length * step[:s], level + length * step[s:]
                trial = self._barrier(*new, mu)
                if trial <= current - 0.1 * length * decrement:
                    break
                length *= 0.5
            else:
                break
            weight, level = new
            if decrement < enough * mu:
                break
        return weight, level


def _side_by_side(targets: Float[np.ndarray, "r k n q"]) -> Float[np.ndarray, "r n kq"]:
    """A of all targets in one matrix."""
    r, _, n, _ = targets.shape
    return np.moveaxis(targets, 2, 1).reshape(r, n, -1)


def _nearest(relative: OfTargets) -> Int[np.ndarray, "r l"]:
    """Numbers of the targets that come near the largest, as many in each draw."""
    count = int((relative >= _NEAR).sum(axis=1).max())
    return np.argsort(-relative, axis=1)[:, :count]


def _on_the_budget(hessian: Float[np.ndarray, "v v"], gradient: Vector, cost: Vector) -> Vector:
    """The Newton step that leaves cost · step = 0."""
    size = np.sqrt(np.diag(hessian))
    factor = linalg.cho_factor(hessian / np.outer(size, size) + _ROUNDING * len(size) * np.eye(len(size)))
    free = linalg.cho_solve(factor, gradient / size) / size
    along = linalg.cho_solve(factor, cost / size) / size
    return -(free - along * (cost @ free) / (cost @ along))


def optimise(
    experiment: Experiment, *, gap: float = GAP, progress: Callable[[str], None] | None = None
) -> Allocation:
    """The plan with the least criterion, to a proven relative `gap`, and the proof.

    `progress` gets value, bound and gap of every round.
    Raises NotEstimableError for a target that nothing informs about, ValueError for a budget that is not positive. The
    gap that was reached is `Allocation.gap`: larger than asked for only if rounding errors end the search.
    """
    if not experiment.budget > 0:
        raise ValueError(f"the budget is {experiment.budget:g}: nothing can be done with it")
    return _best(experiment.reduced(), gap, progress)


def _best(problem: Experiment, gap: float, progress: Callable[[str], None] | None = None) -> Allocation:
    """As `optimise`, for a problem in the coordinates of `Experiment.reduced`."""
    chosen = [(number, place) for number, f in enumerate(problem.families) for place in f.spread()]
    active_problem = _Some(problem, chosen)
    weight = np.full(len(chosen), problem.budget / active_problem.costs.sum())
    best_bound, best, plan, idle, accuracy = 0.0, None, None, 0, 0.2
    for turn in range(1, _ROUNDS + 1):
        weight, shares = active_problem.solve(weight, accuracy)
        value = active_problem.value(weight)
        proof = lower_bound(problem, active_problem.covariance(weight), shares)
        bound = proof.value(problem.budget)
        best = proof if best is None or bound > best_bound else best
        least = 1e-2 * gap
        better = plan is None or bound > best_bound * (1 + least) or value < plan.value * (1 - least)
        idle = 0 if better else idle + 1
        best_bound = max(best_bound, bound)
        least = _LEAST_WEIGHT * problem.budget
        plan = active_problem.plan(weight, least, best_bound, best)
        if progress is not None:
            numbers = f"criterion {value:.6g}, bound {best_bound:.6g}, gap {100 * plan.gap:.2g} %"
            progress(f"round {turn}: {numbers}")
        exact = accuracy <= 0.5 * gap
        if plan.gap <= gap or (exact and idle >= _PATIENCE):
            break
        used = weight * active_problem.costs > least
        active = [c for c, keep in zip(active_problem.chosen, used, strict=True) if keep]
        new = [top for top in proof.tops if not any(_same(top, candidate) for candidate in active)]
        if exact and not new and turn > 3:
            break
        # Far from the end candidates matter, not their exact weights.
        accuracy = 0.5 * gap if idle or not new else max(0.5 * gap, min(accuracy, 0.3 * plan.gap))
        share = 0.05 * problem.budget / max(len(new), 1)
        active_problem = _Some(problem, [*active, *new])
        weight = np.concatenate([0.95 * weight[used], share / active_problem.costs[len(active) :]])
    assert plan is not None
    return plan


def _same(one: tuple[int, Float[np.ndarray, " _"]], other: tuple[int, Float[np.ndarray, " _"]]) -> bool:
    return one[0] == other[0] and bool(np.allclose(one[1], other[1], atol=_ONE_PLACE, rtol=0.0))


def lower_bound(experiment: Experiment, covariance: Matrices, shares: OfTargets) -> Bound:
    """The least criterion that any plan can have (see the module).

    `covariance` is M(w)⁻¹ of a plan, `shares` multipliers π of the targets with sum 1 in each group. Any of both gives
    a valid bound; those of the optimum give the largest.
    """
    wide = _side_by_side(experiment.targets)
    y = covariance @ wide
    shared = y * np.repeat(shares, experiment.targets.shape[3], axis=1)[:, None]
    g = shared @ y.swapaxes(1, 2)
    groups = len(g) // experiment.together
    trace = float((shared * wide).sum()) / groups
    prior = float((g * experiment.known).sum()) / groups
    tops, ratio = [], 0.0
    for number, family in enumerate(experiment.families):
        places, largest = family.best(g / groups, _TOPS)
        ratio = max(ratio, largest)
        tops += [(number, place) for place in places]
    return Bound(trace, prior, ratio, tuple(tops))


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


def rounded(experiment: Experiment, plan: Allocation) -> Allocation:
    """A plan of whole numbers within the budget, and its proven distance from the best plan of any weights.

    Weights are rounded down, the remaining budget goes where it lowers the criterion most for its cost, then
    single candidates are exchanged while that lowers it further. Raises ValueError for a budget that pays for nothing,
    and NotEstimableError for one that does not pay for all that the targets need.
    """
    problem = experiment.reduced()
    chosen = _Some(problem, list(zip(plan.family.tolist(), plan.place, strict=True)))
    if chosen.costs.min() > problem.budget:
        cheapest = f"the cheapest candidate costs: {chosen.costs.min():g}"
        raise ValueError(f"the budget, {problem.budget:g}, is less than {cheapest}")
    count = _filled(chosen, np.floor(plan.weight + 1e-9), plan.weight)
    if chosen.value(count) > _HOPELESS * plan.value:
        what = f"the budget, {problem.budget:g}, pays for {count.sum():.0f} of the candidates"
        raise NotEstimableError(f"{what}, which do not determine all targets: raise it")
    for _ in range(_EXCHANGES):
        chosen, count, better = _exchanged(chosen, count)
        if not better:
            break
    return chosen.plan(count, 0.0, plan.bound, plan.proof)


def worth(experiment: Experiment, plan: Allocation) -> tuple[Weight, Weight]:
    """The criterion without each candidate of a plan, and with one more of it, over that of the plan."""
    problem = experiment.reduced()
    chosen = _Some(problem, list(zip(plan.family.tolist(), plan.place, strict=True)))
    value, units = chosen.value(plan.weight), np.eye(len(plan.weight))
    without = [chosen.value(plan.weight * (1.0 - unit)) for unit in units]
    added = [chosen.value(plan.weight + unit) for unit in units]
    return np.array(without) / value, np.array(added) / value


def _filled(some: _Some, count: Weight, weight: Weight) -> Weight:
    """Spend the remaining budget, one candidate at a time."""
    while True:
        remaining = some.experiment.budget - some.costs @ count
        can = np.flatnonzero(some.costs <= remaining * (1 + 1e-9))
        if not len(can):
            return count
        # A plan that is not whole yet may not determine everything: a thousandth of the weights stands in for the rest.
        base = count + 1e-3 * weight
        phi = some.variances(base)
        value, near = float(some.experiment.largest(phi).mean()), some.worst(phi)
        gain = [(value - near.value(base + (np.arange(len(count)) == i))) / some.costs[i] for i in can]
        count = count + (np.arange(len(count)) == can[int(np.argmax(gain))])


def _exchanged(support: _Some, count: Weight) -> tuple[_Some, Float[np.ndarray, " _"], bool]:
    """One exchange that lowers the criterion, if there is one: the most promising by their slopes are tried."""
    problem, value = support.experiment, support.value(count)
    covariance = support.covariance(count)
    phi = support.variances(count)
    # The worst targets, smoothly: the slope of the maximum alone would forget the next one.
    shares = problem.of_one(problem.relative(phi) ** _SHARPNESS)
    promising = lower_bound(problem, covariance, shares).tops
    new = [top for top in promising if not any(_same(top, candidate) for candidate in support.chosen)]
    used = np.flatnonzero(count)
    support = _Some(problem, [*(support.chosen[i] for i in used), *new])
    count = np.concatenate([count[used], np.zeros(len(new))])
    y = covariance @ support.wide
    slope = np.einsum("rsk,rk->s", support.gains(y), shares)
    worst = support.worst(phi)
    remaining = problem.budget - support.costs @ count
    out, into = np.meshgrid(np.arange(len(used)), np.arange(len(count)), indexing="ij")
    fits = (support.costs[into] - support.costs[out] <= remaining * (1 + 1e-9)) & (out != into)
    promise = np.where(fits, slope[into] - slope[out], -np.inf)
    for flat in np.argsort(-promise, axis=None)[:_TRIED]:
        i, j = np.unravel_index(flat, promise.shape)
        if not np.isfinite(promise[i, j]):
            break
        changed = count.copy()
        changed[i] -= 1
        changed[j] += 1
        least = value * (1 - 1e-9)
        if worst.value(changed) < least and support.value(changed) < least:
            return support, changed, True
    return support, count, False

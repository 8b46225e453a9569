"""Plans of whole numbers: weights of an optimal experiment rounded, filled and exchanged within a budget.

Weights are rounded down, the rest of the budget spent where it lowers the criterion most for its cost, then single
candidates exchanged while that lowers it (Fedorov 1972, Theory of Optimal Experiments). What a plan must contain stays
in it. What it costs may be more than the sum over its candidates: changes between settings, of which those that are not
worth their changes are dropped.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator

import numpy as np
from jaxtyping import Float

from walop_jax.plans.optimal import (
    Allocation,
    Experiment,
    Key,
    NotEstimableError,
    Some,
    Weights,
    WeightVector,
    bounded,
    multipliers,
    tops,
)

_HOPELESS = 1e3  # times the criterion of the best weights: some target is not determined
_FEW = 3  # settings at most with which a search begins, beside that with all of them
_EXCHANGES, _TRIED = 200, 40  # exchanges, and those tried for each, most promising first
_PROMISING = 6  # of the candidates that may be added, most promising first, whose criterion is computed
_SHARPNESS = 20.0  # power of the mean whose slope says which exchanges are promising


def rounded(
    experiment: Experiment,
    plan: Allocation,
    *,
    required: Weights | None = None,
    time: Callable[[Weights], float] | None = None,
    setting: Callable[[Key], Hashable] | None = None,
) -> Allocation:
    """A plan of whole numbers within the budget; its bound is that of `plan`.

    `required` are numbers of candidates that it must contain. `time` is the cost of a plan where it is more than the
    sum over its candidates: changes between settings; whether each `setting` is worth its changes is tried. Raises
    ValueError for a budget that pays for nothing, and NotEstimableError for one that does not pay for all that the
    targets need.
    """
    search = _Whole(experiment.reduced(), plan, required or {}, time or experiment.cost)
    count = search.exchanged(min(search.starts(setting), key=search.value))
    while setting is not None:
        used = {setting(key) for key in search.weights(count)}
        trials = [search.without(count, {k for k in search.some.keys if setting(k) == one}) for one in used]
        best = min(trials, key=search.value, default=count)
        if len(used) < 2 or search.value(best) >= search.value(count):
            break
        count = search.exchanged(best)
    value = search.value(count)
    if value > _HOPELESS * plan.value:
        what = f"the budget, {experiment.budget:g}, pays for {count.sum():.0f} of the candidates"
        raise NotEstimableError(f"{what}, which do not determine all targets: raise it")
    return dataclasses.replace(plan, weights=search.weights(count), value=value)


class _Whole:
    """The search for whole numbers: a list of candidates, how often each is done, and what that costs."""

    def __init__(
        self, problem: Experiment, plan: Allocation, required: Weights, time: Callable[[Weights], float]
    ) -> None:
        self.problem, self.time = problem, time
        self.some = Some(problem, {**required, **plan.weights})
        self.weight = np.array([plan.weights.get(key, 0.0) for key in self.some.keys])
        self.least = np.array([required.get(key, 0.0) for key in self.some.keys])

    def weights(self, count: WeightVector) -> dict[Key, float]:
        """The candidates in a plan."""
        return {self.some.keys[i]: float(count[i]) for i in np.flatnonzero(count)}

    def value(self, count: WeightVector) -> float:
        """The criterion of a plan."""
        return self.some.value(count)

    def cost(self, count: WeightVector) -> float:
        """What a plan costs, changes and all."""
        return self.time(self.weights(count))

    def fits(self, count: WeightVector) -> bool:
        """Whether the budget pays for a plan."""
        return self.cost(count) <= self.problem.budget * (1 + 1e-9)

    def first(self) -> WeightVector:
        """Weights rounded down, beside what is required, so far as the budget pays for both."""
        for scale in np.linspace(1.0, 0.0, 41):
            count = self.least + np.floor(scale * self.weight + 1e-9)
            if self.fits(count):
                return count
        least = self.cost(self.least)
        raise ValueError(
            f"the budget, {self.problem.budget:g}, is less than what is required costs: {least:g}"
        )

    def starts(self, setting: Callable[[Key], Hashable] | None) -> Iterator[WeightVector]:
        """Plans to begin with: of all candidates with weight, and of the settings that have most of it."""
        yield self.filled(self.first())
        if setting is None:
            return
        keys = self.some.keys
        cost = self.weight * self.some.costs
        total: dict[Hashable, float] = {setting(key): 0.0 for key in keys}
        for key, of_key in zip(keys, cost, strict=True):
            total[setting(key)] += float(of_key)
        order = sorted(total, key=lambda one: -total[one])
        for few in range(1, min(_FEW, len(order) - 1) + 1):
            others = {key for key in keys if setting(key) in order[few:]}
            with contextlib.suppress(ValueError):  # what is required may be all that the budget pays for
                yield self.filled(self.least, others)

    def filled(self, count: WeightVector, forbidden: Collection[Key] = ()) -> WeightVector:
        """A plan with the remaining budget spent, one candidate at a time."""
        units = np.eye(len(self.some.keys))
        while True:
            spent = self.cost(count)
            more = {
                i: self.cost(count + units[i]) - spent
                for i, key in enumerate(self.some.keys)
                if key not in forbidden and self.fits(count + units[i])
            }
            if not more:
                break
            # A plan that is not whole yet may not determine everything: a thousandth of the weights stands in.
            base = count + 1e-3 * self.weight
            near = self.some.near(base)
            value, slope = near.power_mean(base, _SHARPNESS)
            promising = sorted(more, key=lambda i: slope[i] / more[i])[:_PROMISING]
            value = near.value(base)
            count = (
                count + units[min(promising, key=lambda i: (near.value(base + units[i]) - value) / more[i])]
            )
        if not count.any():
            cheapest = min(self.cost(unit) for unit in units)
            raise ValueError(
                f"the budget, {self.problem.budget:g}, is less than the cheapest candidate costs: {cheapest:g}"
            )
        return count

    def without(self, count: WeightVector, forbidden: set[Key]) -> WeightVector:
        """The same without some candidates, but for those required, and the time that they took spent on others."""
        among = np.array([key in forbidden for key in self.some.keys])
        count = np.where(among, self.least, count)
        return (
            self.filled(count, forbidden) if count.any() else np.where(among, self.least, self.weight * 0.0)
        )

    def exchanged(self, count: WeightVector) -> Float[np.ndarray, " _"]:
        """A plan that no exchange of one candidate for another of those tried makes better."""
        for _ in range(_EXCHANGES):
            count, better = self._exchange(count)
            if not better:
                break
            count = self.filled(count)
        return count

    def _exchange(self, count: WeightVector) -> tuple[Float[np.ndarray, " _"], bool]:
        """One exchange that lowers the criterion, if there is one: the most promising by their slopes are tried."""
        # The worst targets, smoothly: the slope of the maximum alone would forget the next one.
        shares = multipliers(self.some, count, _SHARPNESS)
        _, gains = bounded(self.problem, self.some.covariance(count), shares)
        self._join(key for key, _ in tops(self.problem, gains))
        count = np.append(count, np.zeros(len(self.some.keys) - len(count)))
        value, near = self.value(count), self.some.near(count)
        slope = np.array([gains[f][i] for f, i in self.some.keys])
        promise = np.where((count > self.least)[:, None], slope - slope[:, None], -np.inf)
        for flat in np.argsort(-promise, axis=None)[:_TRIED]:
            i, j = np.unravel_index(flat, promise.shape)
            if promise[i, j] == -np.inf:
                break
            changed = count.copy()
            changed[i] -= 1
            changed[j] += 1
            least = value * (1 - 1e-6)
            if self.fits(changed) and near.value(changed) < least and self.value(changed) < least:
                return changed, True
        return count, False

    def _join(self, keys: Iterable[Key]) -> None:
        """Further candidates, at the end."""
        self.some = self.some.with_more(keys)
        none = np.zeros(len(self.some.keys) - len(self.weight))
        self.weight, self.least = np.append(self.weight, none), np.append(self.least, none)

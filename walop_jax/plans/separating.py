"""The class of a diagnosis as an experiment: the exposures that separate its members.

Members      the addition of a diagnosis and its rivals, which the data of the run cannot tell from it. Each may be the
             truth, at the size at which the data of the run would have been fitted with it.
Distance     Δχ²_AB of the run and the new exposures together when A is true at its size a and B is fitted in its place:
             B's amplitudes and all parameters of the base model take up what they can by a linear step, priors and the
             data of the run included. With N the information of everything on (a, x), x all that is fitted,
             Δχ² = a (N_aa − N_ax N_xx⁻¹ N_xa) a; for one rival without parameters a² |A|² sin² of the angle between the
             columns of A and B.
Exposures    one, or two that differ, repeated for the time there is: those for which the least Δχ² of all pairs is
             largest.
Limits       Linear in the amplitudes. Only members that act on light, each by a size, can be planned for.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.io.errors import fail
from walop_jax.io.run_folder import RunFolder
from walop_jax.likelihood.inverses import pseudo_inverse
from walop_jax.likelihood.likelihood import Likelihood, prior_rows
from walop_jax.model.effects import Described, Deviations, Effect
from walop_jax.model.effects.in_models import model_without
from walop_jax.model.sources import MoonSky
from walop_jax.model.specification import Model
from walop_jax.plans.criteria import effects_alike
from walop_jax.plans.exposures import Candidates, with_members
from walop_jax.plans.optimal import Experiment, Key, Weights
from walop_jax.posterior.run import Run

DECIDED = thresholds.SEPARATION**2
"""Δχ² from which a rival is excluded."""
STEPS = 4  # of the grid of the polariser, from one angle that is tried at first to the next
_FIRSTS = 4  # exposures that are tried as the first of two
_PROMISING = 8  # pairs that are tried in several fractions of the time
_SHARES = (0.25, 0.375, 0.5, 0.625, 0.75)  # of the time for the first of two exposures
_WORTH = 1.02  # times the least Δχ² of one exposure that a second one has to bring
_INFORMED = 1e-12  # fraction of the largest eigenvalue from which a direction is informed

Information = Float[np.ndarray, "f f"]


class Pair(NamedTuple):
    """Expected Δχ² of a rival when a member is the truth: of the data there are, and with the exposures of a plan."""

    truth: str
    rival: str
    before: float
    after: float

    def in_words(self) -> str:
        """A sentence on how well the pair is separated."""
        excluded = "excluded" if self.after >= DECIDED else "not excluded"
        return f"if {self.truth} is true, {self.rival} is {excluded}: Δχ² {self.after:.3g} (now {self.before:.2g})"


@dataclasses.dataclass(frozen=True)
class ClassOfRun:
    """The class of a run: names of its members, all effects that a fit has with them, the data, remarks.

    `effects` are those of the members ahead, then others that were found; `calset` are the data of the run, `known` is
    its calibration.
    """

    names: tuple[str, ...]
    effects: tuple[str | Effect, ...]
    calset: CalibrationSet
    known: Calibration
    notes: tuple[str, ...] = ()

    @property
    def base(self) -> Model:
        """The model of the run without its effects."""
        model = self.known.model
        for name in model.effect_names:
            model = model_without(model, name)
        return model


def class_of_run(after: Any, known: Calibration) -> ClassOfRun:
    """The class that a diagnosis left, `after` a `Diagnosis` or its folder, `known` its calibration.

    Raises `DataError` where there is none, where its data cannot be read again, and where fewer than two of its members
    can be planned for.
    """
    first, *rivals = effects_alike(after, known)
    given = ClassOfRun((), (), data_of(after), known)
    kept, notes = [first], []
    for rival in rivals:
        try:
            with_members(given.base, given.calset, (first, rival))
            kept.append(rival)
        except ValueError as error:
            notes.append(f"{rival} is not among the pairs: {error}")
    if len(kept) < 2:
        advice = "observe what `separated_by` of diagnosis.json names"
        raise fail(f"no plan separates {first.name} from its rivals: {'; '.join(notes)}", advice=advice)
    members = (first.name, *kept[1:])
    truth = known.model.instrument(known.values)
    others = [e for e in truth.effects if e.name not in members and not isinstance(e, Described | Deviations)]
    return dataclasses.replace(given, names=members, effects=(*kept, *others), notes=tuple(notes))


def data_of(after: Any) -> CalibrationSet:
    """The data of a diagnosis, those of a folder read again (`Run.calset`).

    Raises `DataError` where they cannot be found or are not what they were.
    """
    if isinstance(after, Diagnosis):
        return after.before.calset
    folder = after.folder if isinstance(after, RunFolder) else Path(os.fspath(after))
    return Run(folder).calset


def information_of_data(of: ClassOfRun, found: Candidates) -> Information:
    """Information of the data of the run on the parameters of the candidates, without priors of these.

    The moonlit sky, and what only the run has, is fitted to the run alone.
    """
    model, _ = with_members(of.base, of.calset, of.effects)
    at = dict(zip(of.known.model.names, of.known.values, strict=True))
    at |= dict(zip(found.model.names, found.values[0], strict=True))
    values = np.array([at.get(p.name, p.start) for p in model.parameters])
    select = model.selection()
    likelihood = Likelihood.of(of.calset, model)
    matrix = select.T @ likelihood.data_terms(values)[0].matrix @ select
    rows = prior_rows(model).jacobian(select)
    names = [model.names[i] for i in model.free]
    shared = [name in found.names and model[name].part != MoonSky.name for name in names]
    both, own = np.flatnonzero(shared), np.flatnonzero(~np.array(shared))
    of_own = matrix[np.ix_(own, own)] + rows[:, own].T @ rows[:, own]
    across = matrix[np.ix_(both, own)]
    left = matrix[np.ix_(both, both)] - across @ pseudo_inverse(of_own, _INFORMED) @ across.T
    information = np.zeros((len(found.names), len(found.names)))
    at_names = [found.names.index(names[i]) for i in both]
    information[np.ix_(at_names, at_names)] = 0.5 * (left + left.T)
    return information


def sizes(
    information: Information, columns: Mapping[str, Sequence[int]], first: Float[np.ndarray, " f"]
) -> dict[str, Float[np.ndarray, " f"]]:
    """The size of each member as the data of a run would have been fitted with it, where the `first` is the truth.

    `columns` are the places of the amplitudes of each member, `first` amplitudes of the first of them; what belongs to
    no member is fitted beside each. `information` has the priors of that.
    """
    members = list(columns)
    amplitudes = np.concatenate([columns[name] for name in members]).astype(int)
    base = np.setdiff1d(np.arange(len(information)), amplitudes)
    found = {members[0]: first}
    for name in members[1:]:
        fitted = np.concatenate([base, columns[name]]).astype(int)
        matrix = information[np.ix_(fitted, fitted)]
        step = pseudo_inverse(matrix, _INFORMED) @ (information[fitted] @ first)
        found[name] = np.zeros(len(information))
        found[name][list(columns[name])] = step[len(base) :]
    return found


def pairs_of(names: Iterable[str]) -> list[tuple[str, str]]:
    """Every member as the truth, with every other as its rival."""
    return list(itertools.permutations(names, 2))


def distances(experiment: Experiment, weights: Weights) -> list[float]:
    """Δχ² of every pair with the exposures of a plan."""
    return _distances(experiment.reduced(), weights).tolist()


def few_exposures(
    experiment: Experiment, time: Callable[[Weights], float], steps: Callable[[int], int]
) -> dict[Key, float]:
    """One exposure, or two that differ, repeated in the budget, for which the least Δχ² of all pairs is largest.

    `time` is what a plan costs with changes, `steps` the number of candidates of a family from one that is tried to
    the next. Raises ValueError for a budget that pays for none.
    """
    problem = experiment.reduced()

    def repeated(shares: Mapping[Key, float]) -> dict[Key, float]:
        """As many exposures as the budget pays for, in these fractions of it; none where one of them has no place."""
        for scale in np.linspace(1.0, 0.0, 101)[:-1]:
            plan = {
                (f, i): float(np.floor(scale * share * problem.budget / problem.families[f].cost[i] + 1e-9))
                for (f, i), share in shares.items()
            }
            if min(plan.values()) < 1:
                return {}
            if time(plan) <= problem.budget * (1 + 1e-9):
                return plan
        return {}

    def grid() -> Iterator[Key]:
        for f, family in enumerate(problem.families):
            yield from ((f, i) for i in range(0, len(family.cost), steps(f)))

    def beside(key: Key) -> Iterator[Key]:
        """The neighbours of a candidate on the grid."""
        f, i = key
        count, width = len(problem.families[f].cost), steps(f)
        yield from ((f, (i + k) % count) for k in range(1 - width, width))

    def told(trials: Iterable[dict[Key, float]]) -> list[tuple[Float[np.ndarray, " p"], dict[Key, float]]]:
        """Δχ² of every pair and the plan, those with the largest least one first."""
        found = [(_distances(problem, plan), plan) for plan in trials if plan]
        return sorted(found, key=lambda each: -each[0].min())

    alone = told(repeated({key: 1.0}) for key in grid())
    if not alone:
        raise ValueError(f"{problem.budget / 60:g} minutes do not pay for a single exposure")
    # Where none alone separates all pairs, what separates one of them may be the first of two.
    of_pairs = [max(alone, key=lambda each: each[0][k]) for k in range(len(alone[0][0]))]
    firsts = list(dict.fromkeys(key for _, plan in (alone[0], *of_pairs) for key in plan))[:_FIRSTS]
    alone = told(repeated({key: 1.0}) for key in beside(next(iter(alone[0][1]))))
    both = told(repeated({one: 0.5, key: 0.5}) for one in firsts for key in grid() if key != one)[:_PROMISING]
    if both:
        one, other = both[0][1]
        twos = [tuple(plan) for _, plan in both] + [(one, key) for key in beside(other)]
        twos += [(key, other) for key in beside(one)]
        both = told(
            repeated({two[0]: share, two[1]: 1.0 - share})
            for two in twos
            if len(set(two)) == 2
            for share in _SHARES
        )
    if both and both[0][0].min() > _WORTH * alone[0][0].min():
        return both[0][1]
    return alone[0][1]


def _distances(problem: Experiment, plan: Weights) -> Float[np.ndarray, " p"]:
    """Δχ² of every pair, of a problem in the coordinates of `Experiment.reduced`."""
    information = problem.known + problem.total(plan)
    a = problem.targets[:, 0, :, 0]
    variance = np.einsum("rn,rn->r", a, np.linalg.solve(information, a[..., None])[..., 0])
    return np.asarray(1.0 / variance)

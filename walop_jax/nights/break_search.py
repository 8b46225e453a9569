"""The search for breaks: changes with dates, sizes and rivals. Asked of a stack, not of its data.

A change of any parameter or candidate is a step at the boundary of two nights, one bad night, or a drift. Its z and
size come from `changes`, with everything else fitted anew: the course of a random walk is no break. The largest
|z| of all is one if chance makes one as large in less than `CHANCE` of series:

    P(max |z| ≥ u)  ≤  Σ P(|z_i| ≥ u)  −  Σ_(i,k) P(|z_i| ≥ u, |z_k| ≥ u)

over any forest of pairs (Hunter 1976; Worsley 1982, Biometrika 69, 297). Steps of one parameter at neighbouring
boundaries are pairs, and each bad night with a step beside it: a step less the next one is the night between, and
their information I gives the correlations, ρ = (I_b + I_(b+1) − I_night)/2√(I_b I_(b+1)). z is normal, as the
equations are linear. Then the break becomes a law, and the search goes on. Its date is that of the largest z² of its
parameter; dates within `DATES` of that may be it as well. Others whose z² stays within `RIVAL` look alike; the break
becomes a law of the best of them that stars can be corrected for.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.model.effects import EFFECTS, EffectKind
from walop_jax.model.laws import YEAR, Law
from walop_jax.model.parameters import Parameter
from walop_jax.nights import changes
from walop_jax.nights.algebra import LawOfEach, Solution, UndeterminedError
from walop_jax.nights.breaks import Break, solved, with_breaks
from walop_jax.nights.together import EffectAmplitude, Together

CHANCE = 0.005  # of any break in a series that has none: half of one in a hundred
RIVAL = 2.0 * math.log(1000.0)  # z² behind the best at which another name is improbable
DATES = 9.0  # z² behind the best within which a date may be it: 99.7 %
SURE = 5.0  # standard errors that keep one name from another
MOST = 40  # breaks that are looked for
ROUNDS = 3  # in which all are named again
KINDS = ("step", "bad night", "drift")
STEP, BAD_NIGHT, DRIFT = range(len(KINDS))
Carried = Callable[[Parameter], bool]  # true for a candidate that stars can be corrected for


def both_beyond(u: float, rho: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """P(|z₁| ≥ u, |z₂| ≥ u) of two normal deviates of unit variance with correlation ρ (Owen 1956)."""
    rho = np.clip(np.abs(rho), 0.0, 1.0 - 1e-12)
    slope = np.sqrt((1.0 - rho) / (1.0 + rho))
    corners = 2.0 * special.ndtr(-u) - 2.0 * (special.owens_t(u, slope) + special.owens_t(u, 1.0 / slope))
    return np.clip(2.0 * corners, 0.0, None)


class Tried(NamedTuple):
    """Scores and information of all changes of a solution, by kind, cell and parameter (drifts have one cell).

    A value in all nights is no change; `always` is the information on it.
    """

    score: tuple[Float[np.ndarray, "_ n"], ...]
    information: tuple[Float[np.ndarray, "_ n"], ...]
    always: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, solution: Solution, barred: Sequence[int] = ()) -> Tried:
        """The scores of all changes; for `barred` parameters the information is 0."""
        mjd, n = solution.system.equations.mjd, len(solution.system.laws)
        course = np.repeat(((mjd - mjd.mean()) / YEAR)[:, None], n, axis=1)
        drift, of_drift = changes.weighted(solution, course, np.arange(n))
        scores, by_cell = changes.scan(solution)
        always, by_cell[0, 0] = by_cell[0, 0].copy(), 0.0
        information = *by_cell, np.diag(of_drift)[None].copy()
        for of_kind in information:
            of_kind[:, list(barred)] = 0.0
        return cls((*scores, drift[None]), information, always)

    def z(self, kind: int) -> Float[np.ndarray, "_ n"]:
        """Changes of a kind in their standard errors; 0 where the laws take them up."""
        score, information = self.score[kind], self.information[kind]
        return np.divide(score, np.sqrt(information), out=np.zeros_like(score), where=information > 0)

    def chance(self, u: float) -> float:
        """The bound on the probability of a |z| of u or more anywhere, if nothing has changed."""
        step, once, _ = self.information
        single = 2.0 * float(special.ndtr(-u))
        total = single * sum(int((information > 0).sum()) for information in self.information)
        if u < 3.0:
            return 1.0
        whole, after = np.vstack([self.always, step[1:]]), np.vstack([step[1:], np.zeros_like(step[:1])])

        def correlation(first: Any, second: Any, between: Any) -> Any:
            product = first * second
            correlations = (first + second - between) / (2.0 * np.sqrt(np.where(product > 0, product, 1.0)))
            return np.where(product > 0, np.abs(correlations), 0.0)

        beside = np.maximum(correlation(step, once, after), correlation(after, once, whole))
        rho = np.concatenate([correlation(step, after, once).ravel(), beside.ravel()])
        rho = np.minimum(rho[rho > 0.5], 1.0)
        return float(min(1.0, max(total - both_beyond(u, rho).sum(), single)))

    def largest(self) -> tuple[int, int, int]:
        """Kind, cell and parameter of the largest |z|."""
        strengths = [np.abs(self.z(kind)) for kind in range(len(KINDS))]
        kind = int(np.argmax([z.max() for z in strengths]))
        cell, parameter = np.unravel_index(strengths[kind].argmax(), strengths[kind].shape)
        return kind, int(cell), int(parameter)


def find(
    data: Together, laws: LawOfEach, catalogue: Sequence[EffectKind] = EFFECTS, carried: Carried | None = None
) -> tuple[tuple[Break, ...], tuple[Law | None, ...]]:
    """The breaks of a series, and the laws with them. Raises `UndeterminedError` where there is no solution.

    Of several names that explain a break equally well, the first one that is `carried` to stars becomes a law (None:
    all are carried).
    """

    def largest_beside(others: Sequence[Break], chance: float) -> Break | None:
        return _largest(data, solved(data, with_breaks(data, laws, others)), chance, catalogue, carried)

    breaks: list[Break] = []
    while len(breaks) < MOST and (candidate := largest_beside(breaks, CHANCE)) is not None:
        breaks.append(candidate)
    # The first were named while the others were not known: each is named again beside all others.
    for _ in range(ROUNDS if len(breaks) > 1 else 0):
        before = breaks.copy()
        for k in range(len(breaks)):
            breaks[k] = largest_beside(breaks[:k] + breaks[k + 1 :], 1.1) or breaks[k]
        pairs = zip(breaks, before, strict=True)
        if all((now.kind, now.name, now.night) == (then.kind, then.name, then.night) for now, then in pairs):
            break
    for k, candidate in enumerate(breaks):
        laws_of_others = with_breaks(data, laws, breaks[:k] + breaks[k + 1 :])
        breaks[k] = dataclasses.replace(candidate, held_out=_held_out(data, laws_of_others, candidate))
    return tuple(sorted(breaks, key=lambda candidate: candidate.night)), with_breaks(data, laws, breaks)


def _other_shapes(data: Together, laws: LawOfEach) -> list[int]:
    """Candidates that are another shape of an effect that the model or a law has: a model holds one shape alone."""
    shapes: dict[str, tuple[int, int] | None] = {}
    for p, law in zip(data.parameters, laws, strict=True):
        if not isinstance(p, EffectAmplitude):
            shapes[p.part] = None
        elif law is not None:
            shapes.setdefault(p.part, p.shape)
    amplitudes = ((i, p) for i, p in enumerate(data.parameters) if isinstance(p, EffectAmplitude))
    return [i for i, p in amplitudes if shapes.get(p.part, p.shape) != p.shape]


def _largest(
    data: Together,
    solution: Solution,
    chance: float,
    catalogue: Sequence[EffectKind],
    carried: Carried | None,
) -> Break | None:
    """The most significant change; of changes that look alike the first that is carried; None where chance does as
    well.
    """
    tried = Tried.of(solution, _other_shapes(data, solution.system.laws))
    kind, cell, i = tried.largest()
    z = tried.z(kind)
    p_value = tried.chance(abs(float(z[cell, i])))
    if p_value >= chance:
        return None
    low = max(cell - 1, 0)
    near = z[low : cell + 2] ** 2
    alike = [int(j) for j in np.argsort(-near.max(axis=0)) if near[:, j].max() > z[cell, i] ** 2 - RIVAL]
    chosen = next((j for j in alike if carried is None or carried(data.parameters[j])), i)
    if chosen != i:
        i, cell = chosen, low + int(near[:, chosen].argmax())
    rivals = [j for j in alike if j != i]
    best, p, scale = float(z[cell, i] ** 2), data.parameters[i], float(data.equations.scale[i])
    members = {data.parameters[j].part for j in (i, *rivals)}
    remedies = [effect.separated_by for effect in catalogue if effect.name in members and effect.separated_by]
    information = float(tried.information[kind][cell, i])
    change = Break(
        kind=KINDS[kind],
        name=p.name,
        unit=f"{p.unit}/yr".lstrip("/") if kind == DRIFT else p.unit,
        size=float(tried.score[kind][cell, i]) / information * scale,
        error=scale / math.sqrt(information),
        z=float(z[cell, i]),
        p_value=p_value,
        **_dates(data, solution, kind, cell, z[:, i] ** 2 > best - DATES),
        alike=tuple(data.names[j] for j in rivals),
        separated_by=tuple(dict.fromkeys(remedies)) if rivals else (),
    )
    if rivals:
        held = 1 if change.kind == "bad night" else len(solution.system.cells) - cell
        needed = _nights_needed(solution, _course(data, change), np.array([i, *rivals]), best, held)
        change = dataclasses.replace(change, nights_needed=needed)
    return change


def _course(data: Together, change: Break) -> Float[np.ndarray, " u"]:
    """A change of size 1 in every unit."""
    mjd = data.equations.mjd
    return change.form(float(mjd.mean())).at(mjd)


def _dates(data: Together, solution: Solution, kind: int, cell: int, may: np.ndarray) -> dict[str, Any]:
    """The fields of a `Break` that say when; `may`: the cells that it may begin with."""
    cells, nights = solution.system.cells, data.nights
    numbers = [nights[entry.units[0]].number for entry in cells]
    if kind == DRIFT:
        span = numbers[0], numbers[-1]
        return {"night": numbers[0], "nights": span, "before": math.nan, "after": math.nan}
    begin = [min(nights[u].begin for u in entry.units) for entry in cells]
    end = [max(nights[u].end for u in entry.units) for entry in cells]
    before, after = end[cell - 1] if cell else begin[cell] - 1.0, begin[cell]
    if kind == BAD_NIGHT:
        later = begin[cell + 1] if cell + 1 < len(cells) else end[cell] + 1.0
        before, after = 0.5 * (before + after), 0.5 * (end[cell] + later)
    possible = np.flatnonzero(may)
    span = numbers[possible[0]], numbers[possible[-1]]
    return {"night": numbers[cell], "nights": span, "before": before, "after": after}


def _nights_needed(
    solution: Solution, course: np.ndarray, parameters: np.ndarray, best: float, held: int
) -> float:
    """Nights like the `held` ones of a change, until its nearest rival is `SURE` standard errors away.

    `parameters` are those of the change, whose z² is `best`, and of its rivals.
    """
    courses = np.repeat(course[:, None], len(parameters), axis=1)
    _, shared = changes.weighted(solution, courses, parameters)
    rival_information = np.maximum(np.diag(shared)[1:], 1e-300)
    least = float(np.min(best * (1.0 - shared[0, 1:] ** 2 / (shared[0, 0] * rival_information))))
    return math.inf if least < 1e-6 * best else float(max(0, math.ceil(held * (SURE**2 / least - 1.0))))


def _held_out(data: Together, laws: LawOfEach, entry: Break) -> float:
    """Gain in χ² of every other night by the size that the others give; NaN where that cannot be asked."""
    i, halves = data.names.index(entry.name), []
    for odd in (0, 1):
        keep = data.equations.night % 2 == odd
        half = data.equations.only(keep)
        half_laws = [None if law is None else law.seen_at(half.mjd) for law in laws]
        try:
            solution = solved(dataclasses.replace(data, equations=half), half_laws)
        except UndeterminedError:
            return math.nan
        score, half_information = changes.weighted(solution, _course(data, entry)[keep, None], np.array([i]))
        halves.append((float(score[0]), float(half_information[0, 0])))
    (score, half_information), (other_score, information) = halves
    if not half_information > 0 or not information > 0:
        return math.nan
    size = score / half_information
    return 2.0 * size * other_score - size**2 * information

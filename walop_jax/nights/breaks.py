"""Breaks, changes with dates and sizes, as parts of the laws of time of a series."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.model.laws import Form, Law
from walop_jax.nights.algebra import LawOfEach, Solution, System, solve
from walop_jax.nights.together import Together


@dataclasses.dataclass(frozen=True)
class Break:
    """A change that was found, in the unit of its parameter; a drift per year.

    `night` is the first night for which it holds (MJD of the evening), `nights` the first and the last night that may
    be this one. `before` and `after` are the last exposure before the change and the first after it (MJD), NaN for a
    drift; for a bad night they lie half-way to the nights beside it. `p_value` is corrected for all that was tried.
    `alike` are names that explain the same equally well, `separated_by` observations that would separate them,
    `nights_needed` how many more nights like these would separate them (0: they are separated, inf: no number would).
    `held_out` is the gain in χ² on every other night by the size that the rest give: more than 0 if the change is real.
    Example: a step of `half2.plate` by 0.06° in the night 61230.
    """

    kind: str
    name: str
    unit: str
    size: float
    error: float
    z: float
    p_value: float
    night: int
    nights: tuple[int, int]
    before: float
    after: float
    alike: tuple[str, ...] = ()
    separated_by: tuple[str, ...] = ()
    nights_needed: float = 0.0
    held_out: float = math.nan

    @property
    def date(self) -> float:
        """The moment (MJD) from which a step holds: half-way between the exposures beside it."""
        return 0.5 * (self.before + self.after)

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Break:
        """A break as a document holds it."""
        values = {field.name: entry[field.name] for field in dataclasses.fields(cls)}
        for name, value in values.items():
            if value is None:
                values[name] = math.inf if name == "nights_needed" else math.nan
            elif isinstance(value, list):
                values[name] = tuple(value)
        return cls(**values)

    def form(self, middle: float) -> Form:
        """The change in its size against time; a drift is counted from `middle` (MJD)."""
        if self.kind == "drift":
            return Form("linear", middle)
        return Form("window", self.date) if self.kind == "step" else Form("window", self.before, self.after)

    def law(self, law: Law | None, *, gauge: bool = False) -> Law:
        """A law with the break added.

        None stands for the law of a candidate, which is 0 without the break, or of a `gauge`, which has a value.
        """
        if self.kind == "drift":
            # A candidate that drifts has a value as well.
            return (law or Law(() if gauge else ("shared",))).adding("linear")
        if self.kind == "step":
            return (law or Law(())).adding("step", self.date)
        return (law or Law(())).adding("bad", self.before, self.after)


def solved(data: Together, laws: LawOfEach) -> Solution:
    """The solution of nights under laws. Raises `UndeterminedError` where there is none."""
    return solve(System.of(data.equations, laws, data.mean, data.width, data.has_value))


def among_globals(data: Together, solution: Solution, entry: Break) -> Float[np.ndarray, " g"]:
    """The size of a break, which is a law, as a sum of global unknowns: their weights."""
    system, i = solution.system, data.names.index(entry.name)
    form, law = entry.form(float(data.equations.mjd.mean())), system.laws[i]
    change = np.array([float((f.kind, f.start) == (form.kind, form.start)) for f in system.forms])
    # Intervals have values before and after, and no change.
    if entry.kind == "step" and law is not None and law.base == "interval":
        change -= [f.stop == form.start for f in system.forms]
    return np.where(system.at == i, change, 0.0)


def at_solution(data: Together, solution: Solution, entry: Break) -> Break:
    """A break with the size that a solution under its law gives it."""
    change, scale = among_globals(data, solution, entry), data.equations.scale[data.names.index(entry.name)]
    size, error = change @ solution.shared, math.sqrt(change @ solution.covariance @ change)
    return dataclasses.replace(entry, size=float(scale * size), error=float(scale * error))


def with_breaks(data: Together, laws: LawOfEach, breaks: Sequence[Break]) -> tuple[Law | None, ...]:
    """The laws with each of the breaks added to the law of its parameter."""
    changed = list(laws)
    for entry in breaks:
        i = data.names.index(entry.name)
        changed[i] = entry.law(changed[i], gauge=bool(data.gauge[i]))
    return tuple(changed)

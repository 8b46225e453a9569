"""The parameters of a fit as a table and in print: values, priors, and constraints by the data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.io.display import Display, Result
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.shapes import Vector
from walop_jax.io.text import value_and_error, with_error, with_minus_sign
from walop_jax.model.parameters import Parameter
from walop_jax.model.specification import THROUGHPUT, Model

PRIOR_ONLY = 0.99  # of the prior width: an error above it owes nothing to the data
PRIOR_WORDS = "prior only"
MOST_LISTED = 6  # parameters by name, in a note
HEAD = ("parameter", ">value", ">error", "unit", ">start", "prior", "")


class ParameterValue(NamedTuple):
    """A number with its standard error and unit; prints as 15.649 ± 0.004 deg."""

    value: float
    sigma: float
    unit: str

    def __str__(self) -> str:
        return f"{with_error(self.value, self.sigma)} {self.unit}".rstrip()

    __repr__ = __str__


class Fitted(Result):
    """A model with values (n) and a covariance (n, n) of all its parameters, by name and as a table."""

    _working = ("shown",)

    model: Model
    values: Vector
    covariance: Float[np.ndarray, "n n"]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, in the order of `values`."""
        return self.model.names

    @property
    def sigma(self) -> Vector:
        """Standard errors (n) of all parameters, each in its unit; 0 for a fixed one."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    def __getitem__(self, name: str) -> ParameterValue:
        """A parameter by name: value, standard error and unit; ValueError with the nearest names if there is none."""
        at = self.model.index(name)
        return ParameterValue(float(self.values[at]), float(self.sigma[at]), self.model.parameters[at].unit)

    def to_table(self) -> Any:
        """All parameters as an astropy table: value, error, unit, start, prior, and whether it was free."""
        return parameter_table(self.model, self.values, self.sigma)

    def shown(self, title: str, facts: Mapping[str, str], notes: tuple[str, ...]) -> Display:
        """The parameters under a title, with facts about them."""
        rows = parameter_rows(self.model, self.values, self.sigma)
        return Display(title, tuple(facts.items()), HEAD, rows, notes)


def unconstrained(model: Model, sigma: Vector) -> tuple[str, ...]:
    """Names of the free parameters on which the data hold no information: their error is the width of their prior."""
    return tuple(
        p.name
        for p, s in zip(model.parameters, sigma, strict=True)
        if p.free and p.tie is None and p.prior is not None and s > PRIOR_ONLY * p.prior[1]
    )


def parameter_table(model: Model, values: Vector, sigma: Vector) -> Any:
    """An astropy table with a row for every parameter; errors of fixed ones are 0, priors NaN where there is none."""
    idle = unconstrained(model, sigma)
    columns = model.columns()
    states = np.array([_state(p, idle) or "free" for p in model.parameters])
    fitted = {
        "NAME": columns["NAME"],
        "VALUE": (np.asarray(values), "", "fitted value, or the one that it was held at"),
        "SIGMA": (np.asarray(sigma), "", "standard error"),
    }
    state = {"STATE": (states, "", "free, fixed, tied to another, or known from its prior only")}
    return astropy_table(fitted | columns | state)


def parameter_rows(model: Model, values: Vector, sigma: Vector) -> tuple[tuple[str, ...], ...]:
    """Rows below `HEAD`, without terms of the throughput and unlisted effects.

    There is no start where it is the mean of the prior.
    """
    unlisted = {THROUGHPUT, *(effect.name for effect in model.template.effects if effect.unlisted)}
    idle = unconstrained(model, sigma)
    rows = []
    for p, value, s in zip(model.parameters, values, sigma, strict=True):
        if p.part in unlisted:
            continue
        prior = "" if p.prior is None else with_error(p.prior[0] + 0.0, p.prior[1])
        same = p.prior is not None and p.prior[0] == p.start
        start = "" if same else with_minus_sign(f"{p.start + 0.0:.6g}")
        texts = value_and_error(float(value), float(s))
        rows.append((p.name, *texts, p.unit, start, prior, _state(p, idle)))
    # Measured parameters first. Standards last: they are no part of the instrument.
    return tuple(sorted(rows, key=lambda row: (row[0].startswith("standard."), row[-1] == PRIOR_WORDS)))


def parameter_notes(model: Model, sigma: Vector) -> tuple[str, ...]:
    """Notes on parameters missing in a table of `parameter_rows`, and on parameters that the data do not constrain."""
    hidden = len(model.positions(THROUGHPUT))
    idle = unconstrained(model, sigma)
    notes = [f"{hidden} throughput terms not shown; to_table() has them"] if hidden else []
    for effect in model.template.effects:
        if effect.unlisted:
            notes.append(
                f"errors include {len(model.positions(effect.name))} {effect.unlisted} ({effect.name})"
            )
    if idle:
        listed = f": {', '.join(idle)}" if len(idle) <= MOST_LISTED else " (marked in to_table())"
        notes.append(f"{len(idle)} parameters are constrained only by their priors{listed}")
    return tuple(notes)


def _state(p: Parameter, idle: tuple[str, ...]) -> str:
    return p.freedom or (PRIOR_WORDS if p.name in idle else "")

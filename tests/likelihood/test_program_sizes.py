"""An alarm on the time of compilation: the largest programs of a fit, in equations as they are traced.

What XLA takes for a program grows with its equations, and these are the same on every machine, however busy; jax 0.10
and 0.12 differ by 3 % at most. A program that has to grow moves its bound, and says why.
"""

from collections.abc import Iterator
from typing import Any

import jax
import pytest
from jax.extend import core
from small_run import SMALL

from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import columns, engine, optics
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate


def equations(jaxpr: core.Jaxpr) -> int:
    """Number of equations, those of inner programs among them."""
    inner = (part for one in jaxpr.eqns for value in one.params.values() for part in jaxprs(value))
    return len(jaxpr.eqns) + sum(map(equations, inner))


def jaxprs(value: Any) -> Iterator[core.Jaxpr]:
    if isinstance(value, core.ClosedJaxpr):
        yield value.jaxpr
    elif isinstance(value, core.Jaxpr):
        yield value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from jaxprs(part)


def test_equations_are_counted_within():
    """A sine, a loop, and two equations of its body."""

    def function(x):
        return jax.lax.fori_loop(0, 3, lambda _, y: y * y, jax.numpy.sin(x))

    found = jax.make_jaxpr(function)(1.0)
    assert equations(found.jaxpr) > len(found.jaxpr.eqns)


@pytest.fixture(scope="module")
def likelihood():
    calset = simulate(SMALL, seed=1).calset
    return Likelihood.of(calset, base_model(calset))


def test_programs_of_a_fit_stay_small(likelihood):
    """Residuals; their derivatives are two programs, of the optics and of all that is behind them."""
    instrument, plan = likelihood.model.instrument(likelihood.model.start), likelihood.plan
    batch = next(iter(likelihood.points))
    known = engine.optics_of_points(instrument, plan, batch)
    programs = {
        1300: (engine.residuals, (instrument, plan, batch)),
        1900: (optics._known_optics, (instrument, plan, batch.x, batch.y)),
        1100: (engine._linearised_residuals, (instrument, plan, batch, known)),
    }
    for most, (program, args) in programs.items():
        found = jax.make_jaxpr(program.__wrapped__)(*args)
        assert 0.5 * most < equations(found.jaxpr) < most


def test_the_program_of_the_responses_stays_small(likelihood):
    every = columns.Columns(likelihood, likelihood.model.start)
    (data,) = every.reader.batches(0, 32, 32)
    found = jax.make_jaxpr(columns._at_points.__wrapped__)(every.instrument, every.plan, data)
    assert 4500 < equations(found.jaxpr) < 9500

"""The seed of a command is that of the Monte Carlo behind its verdict, not a number that is only written down."""

from __future__ import annotations

from typing import Any

import pytest
from small_run import small_fit

import walop_jax as walop
from walop_jax.diagnosis import workflow

from .conftest import FittedSet


class Examined(Exception):
    """The fit is about to be examined with this seed."""


CALLS = {
    "refit": lambda g, **k: walop.refit(g.calset, **k),
    "limits": lambda g, **k: walop.limits(g.calset, **k),
    "compare": lambda g, **k: walop.compare(g.calset, **k),
    "check": lambda g, **k: walop.check(g.run, g.calset, **k),
}


@pytest.mark.parametrize("name", CALLS)
def test_the_seed_reaches_the_verdict(name: str, fitted: FittedSet, monkeypatch):
    def stop(result: Any, seed: int = 0, **more: Any) -> None:
        raise Examined(seed)

    monkeypatch.setattr("walop_jax.diagnosis.trust.examined", stop)
    with pytest.raises(Examined, match=r"^5$"):
        CALLS[name](fitted, seed=5)


def test_so_does_that_of_a_diagnosis(monkeypatch):
    """Of both of its fits."""
    seeds = []

    def note(result: Any, seed: int = 0, **more: Any) -> Any:
        seeds.append(seed)
        return result.with_verdict()

    monkeypatch.setattr(workflow, "examined", note)
    fit = small_fit().with_verdict()
    workflow.diagnose(fit.calset, fit.model, catalogue=(), seed=7, minutes=0.0)
    assert set(seeds) == {7}

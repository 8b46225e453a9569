"""A small part of the blind suite; the whole is `blind.py` (scores) and `blind_sets.py` (whole sets)."""

import blind as suite
import pytest

from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate


@pytest.fixture(scope="module")
def blind():
    plan = ObservingPlan(
        grid=8, standard_grid=3, polariser_angles=polariser_turn(12), moon_patches=6, standards=6
    )
    return suite.Blind(simulate(plan, seed=41).calset, seed=2)


@pytest.mark.long
def test_verdicts_on_hidden_effects(blind):
    found = suite.study(blind, each=1, ratios=(10.0,), nulls=100)
    rates = found["rates"]
    print(rates, found["confusion"])
    assert rates["false alarm"][0] <= 0.02
    assert rates["detected, SNR 10"][0] >= 0.95
    assert rates["top-1 right, SNR 10, separable"][0] >= 0.85
    assert rates["confident and wrong, SNR 10"][0] <= 0.05
    # Of things that are in no catalogue half are sentences. At this ratio another one often describes the data as well;
    # what must not happen is that it is called by a name.
    held = sum(rates[f"outside: {one}, SNR 10"][0] for one in ("right", "in its class"))
    assert held >= 0.4
    assert rates["outside: wrong name, SNR 10"][0] <= 0.15
    assert rates["pair: both named or in a class"][0] >= 0.8
    assert rates["removed: wrong name, SNR 10"][0] <= 0.1
    assert 0.7 < found["amplitude pulls"]["rms"] < 1.3

"""The throughput at which a fit starts where some exposures have a known flux."""

from __future__ import annotations

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.fit.base_model import LEVEL, LEVEL_POINTS, base_model

ANGLES = [0.0, 30.0, 60.0, 90.0]


def a_set(points: int, kind: str, counts: float, first: float):
    x = np.linspace(first, first + 0.2, points)
    values = counts * (1.0 + 1e-3 * np.random.default_rng(points).normal(size=(points, 4, 4)))
    return walop.from_arrays(values, 1e-3 * np.abs(values), x, 0.0 * x, ANGLES, kind)


@pytest.mark.parametrize("before", [2, LEVEL_POINTS + 44])
def test_light_of_known_flux_says_the_level_wherever_it_stands(before):
    """Of unpolarised light a camera gets half: N = 0.2 of unit flux is a throughput of 0.4."""
    merged = merge_calibration_sets(a_set(before, "clp", 1e5, -0.1), a_set(5, "flux", 0.2, 0.0))
    model = base_model(merged)
    assert [model[f"throughput.n{k}.p00"].start for k in range(4)] == pytest.approx([0.4] * 4, rel=1e-2)


def test_without_it_the_level_is_a_gauge():
    assert base_model(a_set(2, "clp", 1e5, 0.0))["throughput.n2.p00"].start == LEVEL

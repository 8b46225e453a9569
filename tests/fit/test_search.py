"""Where a minimum is sought when the first place explains nothing."""

from __future__ import annotations

import numpy as np
import pytest
from small_run import SEED, SMALL

from walop_jax.fit.model_file import base_model
from walop_jax.fit.search import _order_starts
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate

# Dodge 1984 at 0.62 µm: n_e − n_o = 1.38892 − 1.37714; one wave is 0.62 µm / 0.01178.
ONE_WAVE = 52.6  # µm


def test_every_plate_is_tried_one_order_up_and_one_down():
    calset = simulate(SMALL, seed=SEED).calset
    model = base_model(calset)
    steps = []
    for label, start in _order_starts(Likelihood.of(calset, model)):
        (changed,) = np.flatnonzero(start != model.start)
        assert model.names[changed] in label
        steps.append((model.names[changed], start[changed] - model.start[changed]))
    plates = {name for name in model.names if name.endswith("plate.mgf2")}
    assert len(plates) >= 2
    assert {name for name, _ in steps} == plates
    for name in plates:
        found = sorted(step for other, step in steps if other == name)
        assert found == pytest.approx([-ONE_WAVE, ONE_WAVE], rel=0.01)

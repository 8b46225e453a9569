"""What looks at some hundred points of frames sees all cells, and structure of single places as large as it is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from changed_sets import block_of, with_block
from frame_run import frame_run

from walop_jax.data.joined_cells import joined_cells
from walop_jax.data.records import FineStructure
from walop_jax.diagnosis import trust, workflow
from walop_jax.diagnosis.design import Design, pattern_scores
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood import limits
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import effect_by_name
from walop_jax.simulation.simulate import simulate

SIDE, SEEN = 30, 150
RUN = frame_run(SIDE)
NOTHING = FineStructure(np.zeros(1), np.zeros(1), np.zeros((1, 4)), np.ones((1, 4)))


@pytest.fixture(autouse=True)
def _a_sixth_is_seen(monkeypatch):
    monkeypatch.setattr(trust, "TRUST_ROWS", SEEN * len(RUN.exposures()))


def fitted(calset):
    model = base_model(calset, throughput_degree=2)
    return fit(Likelihood.of(dataclasses.replace(calset, fine=NOTHING), model))


def test_a_pattern_that_a_sixth_of_the_cells_would_not_show():
    """A retarder of 3 mrad, eight standard errors in all of the cells."""
    effect = effect_by_name("upstream_retarder").of(RUN.context(), delta=3e-3, axis=20.0)
    result = fitted(simulate(RUN, seed=3, effects=(effect,)).calset)
    seen = trust.sampled(result)
    assert len(seen.calset.points) <= SEEN
    assert pattern_scores(Design.of(seen)).p_global < 1e-6
    some = thinned(result.calset, SEEN, neighbours=1)
    some = dataclasses.replace(result, likelihood=Likelihood.of(some, result.model))
    assert pattern_scores(Design.of(some)).p_global > 0.01


def test_structure_of_places_is_that_of_single_cells():
    """Gains of 0.2 % of every cell and camera; the means of six cells would have 0.08 %."""
    made = simulate(RUN, seed=4).calset
    gains = np.random.default_rng(5).normal(1.0, 2e-3, (SIDE**2, 1, 4))
    block = block_of(made)
    result = examined(fitted(with_block(made, counts=block.counts * gains)))
    assert result.verdict.structure.gain == pytest.approx(2e-3, rel=0.2)


class SeenError(Exception):
    pass


def test_a_diagnosis_looks_at_joined_cells(monkeypatch):
    calset = dataclasses.replace(simulate(RUN, seed=3).calset, fine=NOTHING)
    monkeypatch.setattr(limits, "DIAGNOSED_ROWS", SEEN * len(calset.exposures))
    told = []

    def looked_at(likelihood):
        expected = block_of(joined_cells(calset, SEEN))
        np.testing.assert_array_equal(block_of(likelihood.calset).counts, expected.counts)
        raise SeenError

    monkeypatch.setattr(workflow, "fit", looked_at)
    with pytest.raises(SeenError):
        workflow.diagnose(calset, progress=told.append)
    assert told[0] == "looking at 144 field points, joined from 900 cells"

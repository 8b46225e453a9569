"""What is decided before anything is computed, and that nothing computed changes it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from frame_run import frame_run

from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import limits
from walop_jax.likelihood.layout import Layout
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate

RUN = frame_run(20)


@pytest.fixture(scope="module")
def calset():
    return simulate(RUN, seed=2).calset


@pytest.fixture(scope="module")
def model(calset):
    return base_model(calset, throughput_degree=2)


@pytest.mark.parametrize("batch", [None, 7, 64, 10_000])
def test_parts_are_whole_batches_and_cover_the_set(calset, model, batch):
    layout = Layout.of(calset, model, batch=batch)
    assert layout.points == 400
    assert layout.batch == min(batch or limits.BATCH, 400)
    assert layout.part % layout.batch == 0
    assert layout.part == layout.batch or 400 // layout.part >= limits.PARTS
    assert (layout.batches - 1) * layout.batch < 400 <= layout.batches * layout.batch


def test_the_size_of_a_set_decides_how_it_is_handled(calset, model, monkeypatch):
    def handled():
        layout = Layout.of(calset, model)
        return layout.interpolated, layout.large, layout.batch

    assert handled() == (False, False, limits.BATCH)
    monkeypatch.setattr(limits, "INTERPOLATE_ABOVE", 399)
    monkeypatch.setattr(limits, "LARGE_BATCH", 100)
    assert handled() == (True, False, 100)
    monkeypatch.setattr(limits, "LARGE_ABOVE", 399)
    assert handled() == (True, True, 100)
    # Where the optics are solved point by point a matrix costs little more than a gradient.
    assert not Layout.of(calset, model, interpolate=False).large


def test_what_was_computed_before_changes_nothing(calset, model):
    """Steeper rays need more nodes; back at the start it is as if nobody had been there."""
    likelihood = Likelihood.of(calset, model, interpolate=True)
    steep = model.start.copy()
    steep[model.index("pupil.magnification")] *= 1.7
    first = likelihood.expand(model.start)
    far = likelihood.expand(steep)
    again = likelihood.expand(model.start)
    assert far.optics.nodes_per_side > first.optics.nodes_per_side
    assert again.optics == first.optics
    assert again.data == first.data
    np.testing.assert_array_equal(again.matrix, first.matrix)


def test_nothing_can_be_installed_afterwards(calset, model):
    likelihood = Likelihood.of(calset, model)
    for record in (likelihood, likelihood.layout, likelihood.points, likelihood.runner):
        for field in dataclasses.fields(record):
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(record, field.name, None)

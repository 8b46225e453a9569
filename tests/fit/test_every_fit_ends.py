"""A model that cannot explain its data: bounded work, the best place so far with its verdict, and what to do."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SEED, SMALL

from walop_jax.data.records import Position
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.fit.search import FAR_OFF, most_passes
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate


def as_it_is(calset, rng):
    return calset


def with_cameras_exchanged(calset, rng):
    block, order = block_of(calset), [2, 1, 0, 3]
    return with_block(calset, counts=block.counts[..., order], sigma=block.sigma[..., order])


def with_random_intensities(calset, rng):
    counts = rng.uniform(1e5, 1e6, block_of(calset).counts.shape)
    return with_block(calset, counts=counts, sigma=np.sqrt(counts))


def with_scrambled_angles(calset, rng):
    e = calset.exposures
    angle, there = e.clp_angle.copy(), np.flatnonzero(e.clp_in)
    angle[there] = rng.permutation(angle[there])
    return dataclasses.replace(calset, exposures=e.placed(CLP=Position.at(angle)))


def from_elsewhere(calset, rng):
    return dataclasses.replace(calset, instrument="WALOP-NORTH")


MISTAKES = [
    with_cameras_exchanged,
    pytest.param(with_random_intensities, marks=pytest.mark.long),
    pytest.param(with_scrambled_angles, marks=pytest.mark.long),
    pytest.param(from_elsewhere, marks=pytest.mark.long),
]


@pytest.fixture
def passes(monkeypatch):
    """How often the data are gone through."""
    count, plain = [0], Likelihood.data_terms

    def counted(self, *args, **options):
        count[0] += 1
        return plain(self, *args, **options)

    monkeypatch.setattr(Likelihood, "data_terms", counted)
    return count


@pytest.mark.parametrize("mistake", MISTAKES)
def test_bad_data_cost_no_more_passes_than_they_are_worth(mistake, passes):
    calset = mistake(simulate(SMALL, seed=SEED).calset, np.random.default_rng(1))
    model, told = base_model(calset), []
    result = refit(calset, model, progress=told.append)
    assert passes[0] <= most_passes(model)
    assert not result.with_verdict().trusted
    assert result.chi2 > FAR_OFF * result.dof
    assert result.converged or "walop-jax diagnose" in result.minimum.message
    steps = [line for line in told if "step" in line]
    assert all(" of at most " in line and "χ²/dof" in line for line in steps)
    assert any(f"start {result.minimum.starts} of 13" in line for line in steps)
    # The best of all places looked at is what comes back.
    scaled = result.expansion.noise_scale
    at_start = Likelihood.of(calset, model).expand(model.start, scaled)
    assert result.expansion.objective <= at_start.objective


def test_good_data_take_one_search(passes):
    calset = simulate(SMALL, seed=SEED).calset
    result = refit(calset)
    assert result.explains_data
    assert passes[0] == result.minimum.steps <= 10


def test_a_diagnosis_of_data_far_off_has_fewer_fits(monkeypatch):
    calset = with_random_intensities(simulate(SMALL, seed=SEED).calset, np.random.default_rng(1))
    monkeypatch.setattr(thresholds, "MOST_FITS_FAR_OFF", 0)
    found = diagnose(calset, as_written=True)
    assert found.before.noise_scale > 1.0
    assert found.steps == ()
    assert found.verdict == "unexplained"
    assert "the search ended after 0 fits" in found.caution

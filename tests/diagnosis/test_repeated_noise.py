"""Exposures that hold the same noise, found in what a fit leaves; independent ones, and patterns, pass."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SEED, SMALL, small_fit

from walop_jax.data.records import Position
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.trust import examined
from walop_jax.diagnosis.variance_components import pairs_alike, repeated_noise
from walop_jax.fit.refit import refit
from walop_jax.simulation.observing_plan import polariser_turn
from walop_jax.simulation.simulate import simulate


@pytest.fixture(scope="module")
def design() -> Design:
    return Design.of(small_fit())


def drawn(design: Design, seed: int, change=lambda cube: cube) -> Design:
    """The design with noise of its own for residuals, changed before the fluxes and the fit have taken their part."""
    rng, measured = np.random.default_rng(seed), design.measured
    cube = change(rng.standard_normal((*measured.used.shape, measured.cameras)))
    weight = np.where(measured.known[..., None], 0.0, measured.model)
    unit = weight / np.where((size := np.linalg.norm(weight, axis=-1, keepdims=True)) > 0, size, 1.0)
    cube = cube - unit * np.sum(unit * cube, axis=-1, keepdims=True)
    data = cube[measured.used].reshape(-1)
    rest = np.zeros(len(design.residual) - len(data))
    return dataclasses.replace(design, residual=np.concatenate([data, rest]))


def test_independent_noise_is_hardly_ever_named(design):
    named = sum(bool(pairs_alike(drawn(design, seed))) for seed in range(100))
    assert named <= 2  # 0.5 % of them are expected at most


@pytest.mark.parametrize("share", [1.0, 0.8])
def test_copies_are_named_even_if_they_were_mixed_with_others(design, share):
    """The noise of exposure 4 in exposure 1: all of it, or as in a weighted mean with another."""

    def copied(cube):
        cube[:, 1] = share * cube[:, 4] + np.sqrt(1.0 - share**2) * cube[:, 1]
        return cube

    ((*pair, correlation),) = pairs_alike(drawn(design, 3, copied))
    assert pair == [1, 4]
    # Of four cameras the fluxes take a direction each: tr(P₁P₂) is 2 to 3 of 3.
    assert 0.6 * share < correlation < share + 0.05
    number = design.fit.calset.exposures.exposure
    (said,) = repeated_noise(drawn(design, 3, copied))
    assert f"{number[1]} and {number[4]}" in said


@pytest.mark.parametrize("size", [0.5, 1.0, 3.0])
def test_a_pattern_that_the_model_lacks_is_no_repetition(design, size):
    """The same disturbance in all exposures, half to three times the noise."""
    pattern = size * np.random.default_rng(9).standard_normal((design.measured.used.shape[0], 1, 4))
    assert pairs_alike(drawn(design, 5, lambda cube: cube + pattern)) == []


@pytest.mark.long
def test_a_copy_in_a_small_set_is_not_trusted():
    """Eleven exposures: too few for the reader to say whether there is noise at all."""
    plan = dataclasses.replace(SMALL, polariser_angles=polariser_turn(5), moon_patches=2, standards=2)
    calset = simulate(plan, seed=SEED).calset
    counts, sigma = (values.copy() for values in (block_of(calset).counts, block_of(calset).sigma))
    e = calset.exposures
    through = np.flatnonzero(e.clp_in)
    angle = e.clp_angle.copy()
    angle[through[1]] = angle[through[3]]
    counts[:, through[1]] = counts[:, through[3]] * 1.0001
    sigma[:, through[1]] = sigma[:, through[3]]
    turned = dataclasses.replace(calset, exposures=e.placed(CLP=Position.at(angle)))
    found = examined(refit(with_block(turned, counts=counts, sigma=sigma)))
    assert not found.trusted
    assert "the same noise" in "; ".join(found.verdict.residual_doubts)

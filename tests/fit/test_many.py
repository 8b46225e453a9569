"""Many sets fitted together: each fit is the one that its set has by itself, and failures are told."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SEED, SMALL

from walop_jax.data.records import CalibrationSet
from walop_jax.fit import many
from walop_jax.fit.base_model import base_model
from walop_jax.fit.many import ManyFits, refit_many
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.observing_plan import polariser_turn
from walop_jax.simulation.simulate import simulate


@functools.cache
def realisations(count: int) -> tuple[CalibrationSet, ...]:
    """Noise realisations of one simulated run."""
    quiet = simulate(SMALL, seed=SEED, noiseless=True).calset
    block, rng = block_of(quiet), np.random.default_rng(1)
    drawn = (block.counts + block.sigma * rng.standard_normal(block.counts.shape) for _ in range(count))
    return tuple(with_block(quiet, counts=counts) for counts in drawn)


@functools.cache
def together(approached: int = many.APPROACHED) -> ManyFits:
    """Four realisations, and the last of them once more with a camera that lost half of its light in one exposure.

    More sets than `approached` begin with steps whose derivatives are held.
    """
    *sets, last = realisations(4)
    counts = block_of(last).counts.copy()
    counts[:, 2, 0] *= 0.5
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(many, "APPROACHED", approached)
        return refit_many([*sets, last, with_block(last, counts=counts)])


@pytest.mark.parametrize("approached", [many.APPROACHED, 1])
def test_every_fit_is_the_one_of_its_own_set(approached):
    fits = together(approached)
    for number, calset in enumerate(realisations(4)):
        own = fit(Likelihood.of(calset, base_model(calset)))
        free = own.model.free
        assert fits[number].chi2 == pytest.approx(own.chi2, abs=1e-4)  # the last step is not looked at
        assert fits[number].dof == own.dof
        difference = (fits[number].values - own.values)[free] / own.sigma[free]
        assert np.abs(difference).max() < 1e-3
        np.testing.assert_allclose(fits[number].sigma[free], own.sigma[free], rtol=1e-4)


def test_steps_with_held_derivatives_lead_near_the_minimum():
    """Two places are looked at instead of four, and the first of them is lower already than the one without."""
    few, many_sets = together(), together(1)
    for number in (1, 2, 3):
        assert many_sets[number].minimum.steps <= few[number].minimum.steps - 1
        assert many_sets[number].minimum.history[0] < few[number].minimum.history[1]


@pytest.mark.parametrize("approached", [many.APPROACHED, 1])
def test_a_set_that_is_far_from_the_model_is_fitted_alone_and_told(approached):
    fits = together(approached)
    assert fits.alone == (4,)
    assert "fitted by themselves" in str(fits)
    assert fits[4].chi2 / fits[4].dof > 25.0
    assert fits[4].noise_scale > 1.0  # as `refit` has it: errors made from the residuals


def test_the_table_has_the_scatter_of_the_fits_beside_their_errors():
    fits = together()
    table = fits.to_table()
    assert list(table["NAME"]) == list(fits.names)
    row = fits.names.index("pupil.magnification")
    converged = fits.values[fits.converged, row]
    assert table["SCATTER"][row] == pytest.approx(np.std(converged, ddof=1))
    assert table["MEAN"][row] == pytest.approx(converged.mean())


def test_every_set_has_the_catalogue_of_its_own_standards():
    """Standards with other catalogue values: priors are those of each set, and a model for all is refused."""
    one = realisations(4)[0]
    moved = dataclasses.replace(one.sources, q=one.sources.q + 2e-4)
    other = dataclasses.replace(one, sources=moved)
    fits = refit_many([one, other])
    own = fit(Likelihood.of(other, base_model(other)))
    free = own.model.free
    assert np.abs((fits[1].values - own.values)[free] / own.sigma[free]).max() < 1e-3
    assert np.abs((fits[1].values - fits[0].values)[free] / own.sigma[free]).max() > 0.1
    with pytest.raises(DataError, match="set 1 has other SOURCES than set 0"):
        refit_many([one, other], base_model(one))


def test_sets_of_another_layout_are_refused_by_their_number():
    one = realisations(4)[0]
    longer = simulate(dataclasses.replace(SMALL, polariser_angles=polariser_turn(9)), seed=SEED).calset
    with pytest.raises(DataError, match="set 1 has another layout than set 0"):
        refit_many([one, longer])
    other = simulate(dataclasses.replace(SMALL, standards=2), seed=SEED).calset
    with pytest.raises(DataError, match="set 1 has another model than set 0"):
        refit_many([one, other])
    with pytest.raises(DataError, match="no sets"):
        refit_many([])

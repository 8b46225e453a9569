"""Many sets fitted together: each fit is the one that its set has by itself, and failures are told."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SEED, SMALL

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import base_model
from walop_jax.fit.many import ManyFits, refit_many
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate


@functools.cache
def realisations(count: int) -> tuple[CalibrationSet, ...]:
    """Noise realisations of one simulated run."""
    quiet = simulate(SMALL, seed=SEED, noiseless=True).calset
    block, rng = block_of(quiet), np.random.default_rng(1)
    drawn = (block.counts + block.sigma * rng.standard_normal(block.counts.shape) for _ in range(count))
    return tuple(with_block(quiet, counts=counts) for counts in drawn)


@functools.cache
def together() -> ManyFits:
    """Four realisations, and the last of them once more with a camera that lost half of its light in one exposure."""
    *sets, last = realisations(4)
    counts = block_of(last).counts.copy()
    counts[:, 2, 0] *= 0.5
    return refit_many([*sets, last, with_block(last, counts=counts)])


def test_every_fit_is_the_one_of_its_own_set():
    fits = together()
    for number, calset in enumerate(realisations(4)):
        own = fit(Likelihood.of(calset, base_model(calset)))
        free = own.model.free
        assert fits[number].chi2 == pytest.approx(own.chi2, abs=1e-4)  # the last step is not looked at
        assert fits[number].dof == own.dof
        difference = (fits[number].values - own.values)[free] / own.sigma[free]
        assert np.abs(difference).max() < 1e-3
        np.testing.assert_allclose(fits[number].sigma[free], own.sigma[free], rtol=1e-4)


def test_a_set_that_is_far_from_the_model_is_fitted_alone_and_told():
    fits = together()
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


def test_sets_of_another_layout_are_refused_by_their_number():
    one = realisations(4)[0]
    other = simulate(dataclasses.replace(SMALL, standards=2), seed=SEED).calset
    with pytest.raises(DataError, match="set 1 has another layout than set 0"):
        refit_many([one, other], base_model(one))
    with pytest.raises(DataError, match="no sets"):
        refit_many([])

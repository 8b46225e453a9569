"""The noise object against the distributions of scipy: what it draws and the errors that it states."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from walop_jax.simulation.simulate import PhotonNoise

DRAWS = 20_000
LEVELS = (0.0, 3.0, 400.0, 2e4, 1e6)


@pytest.mark.parametrize("expected", LEVELS)
def test_draws_have_the_variance_that_is_scored(expected: float):
    noise = PhotonNoise(30.0)
    counts, _ = noise.draw(np.random.default_rng(1), np.full(DRAWS, expected))
    error = np.sqrt((expected + 900.0) / DRAWS)
    assert counts.mean() == pytest.approx(expected, abs=4 * error)
    assert counts.var() == pytest.approx(expected + 900.0, rel=4 * np.sqrt(2 / DRAWS))


def test_draws_are_poisson_plus_normal():
    # With next to no read noise rounding gives the photons back, exactly Poisson.
    counts, _ = PhotonNoise(1e-6).draw(np.random.default_rng(2), np.full(DRAWS, 4.0))
    seen = np.bincount(np.rint(counts).astype(int), minlength=16)
    share = stats.poisson.pmf(np.arange(len(seen) - 1), 4.0)
    share = np.append(share, 1.0 - share.sum())
    enough = share * DRAWS > 5
    low = ~enough
    observed = np.append(seen[enough], seen[low].sum())
    wanted = np.append(share[enough], share[low].sum()) * DRAWS
    assert stats.chisquare(observed, wanted).pvalue > 1e-3


@pytest.mark.parametrize("expected", LEVELS[2:])
def test_residuals_of_draws_are_standard_normal(expected: float):
    mean = np.full(DRAWS, expected)
    counts, _ = PhotonNoise(30.0).draw(np.random.default_rng(3), mean)
    assert stats.kstest((counts - mean) / np.sqrt(mean + 900.0), "norm").pvalue > 1e-3


def test_stated_errors_come_from_what_was_measured():
    noise, rng = PhotonNoise(30.0), np.random.default_rng(5)
    counts, stated = noise.draw(rng, np.full(100, 1e4))
    np.testing.assert_array_equal(stated, np.sqrt(counts + 900.0))
    # Below zero there are no photons to add noise.
    np.testing.assert_allclose(noise.sigma(np.array([-50.0, 0.0])), 30.0)


def test_the_same_generator_draws_the_same():
    first, second = (PhotonNoise().draw(np.random.default_rng(6), np.full(50, 1e5))[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_impossible_expectations_are_refused(bad: float):
    with pytest.raises(ValueError, match="expected counts"):
        PhotonNoise().draw(np.random.default_rng(0), np.array([bad]))


@pytest.mark.parametrize("bad", [0.0, -3.0, np.nan])
def test_impossible_read_noise_is_refused(bad: float):
    with pytest.raises(ValueError, match="read noise"):
        PhotonNoise(bad)

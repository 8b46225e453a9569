"""Draws spread as a covariance wants them: numbers by hand, ties included."""

from __future__ import annotations

import dataclasses

import numpy as np

from walop_jax.fit.verdict import STATED
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.parameters import Parameter
from walop_jax.model.specification import Model, make_model
from walop_jax.posterior.result import Convergence, PosteriorSample
from walop_jax.posterior.sampling import sandwich_adjusted

# Three parameters, the third tied to the first.
TIES = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
STATED_COVARIANCE = TIES @ np.array([[4.0, 1.0], [1.0, 9.0]]) @ TIES.T
WANTED = TIES @ np.array([[64.0, -20.0], [-20.0, 25.0]]) @ TIES.T


def tied_model() -> Model:
    """A model of three parameters, the third tied to the first."""
    model = make_model("", nominal_instrument("WALOP-LAB"))
    few = tuple(
        Parameter(name, "", "", "", 0.0, None, True, 1.0, tie=tie)
        for name, tie in (("a", None), ("b", None), ("c", "a"))
    )
    return dataclasses.replace(model, parameters=few)


def sample(draws: np.ndarray, covariance: np.ndarray) -> PosteriorSample:
    one = np.ones(1)
    return PosteriorSample(
        sampler="emcee", names=("a", "b", "c"), units=("",) * 3, draws=draws, log_posterior=draws[..., 0],
        mean=draws.mean(axis=(0, 1)), covariance=covariance, chains=np.zeros((len(draws), 1, 1, 1)),
        sampled=("a",), thin=1,
        convergence=Convergence(("a",), 1, one, (1.0, 1.0, 1.0), one, one, 0, ()), accuracy=None, acceptance=0.5,
        counts={}, seconds=0.0, fingerprint={},
    )  # fmt: skip


def test_draws_have_the_covariance_that_is_wanted():
    """Draws whose covariance is exactly the stated one come out with exactly the other."""
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((1000, 2))
    normal -= normal.mean(axis=0)
    normal = normal @ np.linalg.inv(np.linalg.cholesky(np.cov(normal, rowvar=False))).T
    free = np.array([10.0, -3.0]) + normal @ np.linalg.cholesky(STATED_COVARIANCE[:2, :2]).T
    before = sample((free @ TIES.T).reshape(2, 500, 3), np.cov((free @ TIES.T), rowvar=False))
    after = sandwich_adjusted(before, tied_model(), STATED_COVARIANCE, WANTED, "residuals")
    flat = after.draws.reshape(-1, 3)
    np.testing.assert_allclose(np.cov(flat, rowvar=False), WANTED, rtol=1e-10)
    np.testing.assert_allclose(after.covariance, WANTED, rtol=1e-10)
    np.testing.assert_allclose(flat.mean(axis=0), [10.0, -3.0, 10.0], rtol=1e-12)
    np.testing.assert_array_equal(flat[:, 2], flat[:, 0])
    assert after.errors_from == "residuals"
    assert before.errors_from == STATED


def test_the_same_covariance_changes_nothing():
    draws = np.random.default_rng(1).standard_normal((1, 50, 2)) @ TIES.T
    before = sample(draws, STATED_COVARIANCE)
    after = sandwich_adjusted(before, tied_model(), STATED_COVARIANCE, STATED_COVARIANCE, "the same")
    np.testing.assert_allclose(after.draws, draws, rtol=0, atol=1e-12)

"""The exact log density and its gradient: what the fit minimises, in however many batches the data are."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.posterior.samplers import Density
from walop_jax.posterior.target import ExactPosterior, choose_sampled

from .conftest import Scene

ROUNDING = 1e-10  # counts agree to 10⁻¹³, residuals of a thousand standard deviations to 10⁻¹⁰


@pytest.fixture(scope="module")
def density(scene: Scene) -> Density:
    return ExactPosterior(scene.target, choose_sampled(scene.target)).density()


@pytest.fixture(scope="module")
def place(scene: Scene) -> np.ndarray:
    return np.random.default_rng(1).standard_normal(len(scene.target.free))


def test_it_is_the_objective_of_the_fit_in_whitened_coordinates(
    scene: Scene, density: Density, place: np.ndarray
) -> None:
    """The fit has all points in one batch; the density has more, the last of them filled up."""
    target = scene.target
    assert len(scene.result.likelihood.points) == 1 < len(density.arrays[0].data.x)
    sigma = np.sqrt(np.diag(target.covariance))
    again, given = (c / np.outer(sigma, sigma) for c in (target.root @ target.root.T, target.covariance))
    np.testing.assert_allclose(again, given, atol=1e-11)
    for w in (np.zeros_like(place), place, -3.0 * place):
        expected = -0.5 * target.objective(target.centre + target.root @ w)
        assert density.log_density(w[None])[0] == pytest.approx(expected, rel=ROUNDING)
        assert density.value_and_gradient(w)[0] == pytest.approx(expected, rel=ROUNDING)


def test_its_gradient_is_that_of_finite_differences(
    scene: Scene, density: Density, place: np.ndarray
) -> None:
    """Central differences along random directions; and zero at the fit, where the posterior has its mode."""
    _, gradient = density.value_and_gradient(place)
    for step in 1e-3 * np.random.default_rng(2).standard_normal((4, len(place))):
        up, down = density.log_density(np.array([place + step, place - step]))
        assert 0.5 * (up - down) == pytest.approx(gradient @ step, rel=1e-6, abs=1e-8)
    at_the_fit = density.value_and_gradient(np.zeros_like(place))[1]
    assert np.abs(at_the_fit).max() < 0.02 < np.abs(gradient).max()


def test_inflation_divides_chi2_by_f_squared(scene: Scene, density: Density, place: np.ndarray) -> None:
    """ln p = −½ (χ²/f² + priors + ln² f) − n ln f, by hand; its coordinate is ln f √(2n)."""
    target = scene.target
    inflated = ExactPosterior(target, choose_sampled(target), inflate=True).density()
    assert inflated.dimension == density.dimension + 1
    x, n = target.centre + target.root @ place, target.measured
    chi2, priors = target.data(x), float(np.sum(target.prior_rows(x) ** 2))
    for ln_f in (-0.2, 0.0, 0.1):
        w = np.append(place, ln_f * np.sqrt(2.0 * n))
        expected = -0.5 * (chi2 * np.exp(-2.0 * ln_f) + priors + ln_f**2) - n * ln_f
        value, gradient = inflated.value_and_gradient(w)
        assert value == pytest.approx(expected, rel=ROUNDING)
        slope = (chi2 * np.exp(-2.0 * ln_f) - ln_f - n) / np.sqrt(2.0 * n)
        assert gradient[-1] == pytest.approx(slope, rel=1e-9)
    at_one = inflated.value_and_gradient(np.append(place, 0.0))[1][:-1]
    # Two programs: counts are alike to 1e-13, residuals to N/σ = 1000 times that; each element is a sum of thousands.
    np.testing.assert_allclose(at_one, density.value_and_gradient(place)[1], rtol=0, atol=2e-9)

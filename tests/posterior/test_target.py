"""The exact log density and its gradient: what the fit minimises, in however many batches the data are."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.noise import with_noise
from walop_jax.posterior.samplers import Density
from walop_jax.posterior.target import ExactPosterior, Target, choose_sampled

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


def test_parameters_of_the_errors_are_coordinates_of_it(scene: Scene) -> None:
    """−2 ln p with a scale s: χ²/s² + 2 (n − n_F) ln s, by hand, at the fit of all other parameters."""
    model = with_noise(scene.result.model, scale="all")
    start = np.append(scene.result.values, 1.0)
    result = fit(Likelihood.of(scene.result.calset, model), start=start).with_verdict()
    target = Target(result)
    density = ExactPosterior(target, choose_sampled(target)).density()
    assert density.dimension == len(scene.target.free) + 1
    value, error = result.value("noise.scale")
    chi2 = value**2 * result.expansion.data  # with the errors as stated
    ln_p = []
    for away in (-3.0, 0.0, 3.0):
        w = np.zeros(density.dimension)
        w[target.names.index("noise.scale")] = away
        at = np.linalg.solve(target.root, target.covariance[:, target.names.index("noise.scale")]) / error
        value_here, _ = density.value_and_gradient(away * at)
        s = value + away * error
        ln_p.append(value_here + 0.5 * (chi2 / s**2 + 2.0 * target.measured * np.log(s)))
    assert np.ptp(ln_p) < 1e-6 * abs(ln_p[0])

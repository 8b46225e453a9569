"""The surrogate: its algebra on a Gaussian that can be integrated by hand, its accuracy on the real model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from walop_jax.posterior.surrogate import Surrogate, build_surrogate, compare_with_exact
from walop_jax.posterior.target import Target, choose_sampled, ln_scale_unit, near_linear

from .conftest import Scene


def test_marginal_of_a_gaussian_is_the_block_of_its_covariance(gaussian: Surrogate) -> None:
    linear = [1, 2, 3, 4, -3, -2, -1]
    precision = (gaussian.data + gaussian.prior)[np.ix_(linear, linear)]
    covariance = np.linalg.inv(precision)
    z = np.random.default_rng(1).standard_normal((50, 4))
    expected = -0.5 * np.einsum("ni,ij,nj->n", z, np.linalg.inv(covariance[:4, :4]), z)
    np.testing.assert_allclose(gaussian.density().log_density(z), expected, atol=1e-12)

    draws = z[:1].repeat(40_000, axis=0)
    s = gaussian.draw(draws, np.random.default_rng(2))[:, 4:]
    np.testing.assert_allclose(np.cov(s.T), np.linalg.inv(precision[4:, 4:]), atol=0.02)
    np.testing.assert_allclose(
        s.mean(axis=0), -np.linalg.solve(precision[4:, 4:], precision[4:, :4] @ z[0]), atol=0.02
    )

    sampled = np.random.default_rng(3).multivariate_normal(np.zeros(4), covariance[:4, :4], 40_000)
    mean, found = gaussian.moments(sampled)
    np.testing.assert_allclose(mean, 0.0, atol=0.03)
    np.testing.assert_allclose(found, covariance, atol=0.04)


def test_a_scale_of_errors_is_the_plain_posterior_at_its_fit_and_the_integral_elsewhere(
    gaussian: Surrogate,
) -> None:
    inflated = dataclasses.replace(gaussian, scale=1.3)
    z = np.random.default_rng(1).standard_normal((20, 4))
    at_one = inflated.density().log_density(np.column_stack([z, np.zeros(20)]))
    np.testing.assert_allclose(at_one, gaussian.density().log_density(z), atol=1e-12)
    # ∫ exp(−½ (χ²_data/f² + χ²_prior)) ds by brute force, up to a constant that f does not enter
    ln_f = np.array([-0.2, 0.0, 0.3])
    coordinates = np.column_stack([z[:3], ln_f / ln_scale_unit(inflated.measured)])
    linear = [1, 2, 3, 4, -3, -2, -1]
    values = []
    for one, log in zip(z[:3], ln_f, strict=True):
        q = gaussian.data[np.ix_(linear, linear)] / np.exp(2 * log) + gaussian.prior[np.ix_(linear, linear)]
        own, mixed = q[4:, 4:], q[4:, :4] @ one
        chi2 = one @ q[:4, :4] @ one - mixed @ np.linalg.solve(own, mixed)
        log_determinant = (
            np.linalg.slogdet(own)[1] - np.linalg.slogdet((gaussian.data + gaussian.prior)[-3:, -3:])[1]
        )
        values.append(-0.5 * (chi2 + log_determinant) - 999 * log)
    np.testing.assert_allclose(inflated.density().log_density(coordinates), values, rtol=1e-10)


@pytest.mark.parametrize("scale", [None, 1.3])
def test_the_density_that_is_compared_is_that_of_the_draws(gaussian: Surrogate, scale: float | None) -> None:
    """The density of sampled coordinates times the normal distribution of the others, by scipy, up to a constant."""
    rng, weak = np.random.default_rng(5), np.zeros_like(gaussian.data)
    weak[5:15, -3:] = 0.1 * rng.standard_normal((10, 3))
    skewed = dataclasses.replace(
        gaussian, data=gaussian.data + weak + weak.T, scale=scale, slope=0.2 * rng.standard_normal(4),
        skew=rng.standard_normal(3),
    )  # fmt: skip
    z = rng.standard_normal((30, 4 + (scale is not None)))
    x = skewed.draw(z, rng)
    f = np.exp(z[:, 4:] / np.sqrt(2.0 * skewed.measured)) if scale else np.ones((30, 1))
    expected = []
    for at, place, factor in zip(z[:, :4], x, f[:, 0], strict=True):
        h = skewed.features(at[None])[0]
        q = skewed.data / factor**2 + skewed.prior
        own = np.linalg.inv(q[-3:, -3:])
        mean = -own @ (q[-3:, :15] @ h + 0.5 * skewed.skew)
        expected.append(multivariate_normal(mean, own).logpdf(place[4:]))
    ln_f = np.log(f[:, 0])
    # A flat prior of the scale, and its part of the likelihood, which cancel in the comparison.
    own_of_f = ln_f - 1000 * ln_f
    total = skewed.density().log_density(z) + np.array(expected) - own_of_f
    np.testing.assert_allclose(np.diff(-0.5 * skewed.joint(z, x)), np.diff(total), atol=1e-9)


def test_physics_is_sampled_and_series_and_catalogue_are_not(scene: Scene) -> None:
    names = [scene.surrogate.names[i] for i in scene.surrogate.sampled]
    assert {"half1.wedge", "half2.plate.mgf2", "sky.depolarisation", "collimator.q"} <= set(names)
    assert not [name for name in names if name.startswith(("throughput.", "standard."))]
    assert len(names) + len(near_linear(scene.target)) == len(scene.target.free)
    fewer = choose_sampled(scene.target, limit=3)
    rest = np.setdiff1d(scene.surrogate.sampled, fewer)
    covariance = scene.target.covariance
    bent = scene.target.bending(covariance / np.sqrt(np.diag(covariance)))
    assert min(bent[fewer]) >= max(bent[rest]) > 0
    with pytest.raises(ValueError, match=r"half1\.wedge"):
        choose_sampled(scene.target, ["half1.wegde"])


def test_surrogate_is_the_exact_posterior_near_the_fit(scene: Scene) -> None:
    """All coefficients at once, at draws of the surrogate: measured spread of ln p 0.1, 0.02 σ, 2 %."""
    rng = np.random.default_rng(4)
    z = rng.standard_normal((200, scene.surrogate.dimension))
    accuracy = compare_with_exact(scene.target, scene.surrogate, z, rng)
    assert accuracy.exact_enough, accuracy
    assert accuracy.spread < 0.35, accuracy
    assert accuracy.efficiency > 0.9, accuracy


def test_a_wrong_surrogate_is_found_out(scene: Scene) -> None:
    """Fault: a mean displaced by 0.3 σ. The check has to see it."""
    k = len(scene.surrogate.slope)
    wrong = scene.surrogate.prior.copy()
    wrong[0, 3] += 0.3
    wrong[3, 0] += 0.3
    bad = dataclasses.replace(scene.surrogate, prior=wrong)
    rng = np.random.default_rng(5)
    z = rng.standard_normal((200, k))
    z[:, 2] -= 0.3
    accuracy = compare_with_exact(scene.target, bad, z, rng)
    assert not accuracy.exact_enough, accuracy
    assert abs(accuracy.shift[1]) > 0.15


def test_means_of_series_are_displaced_from_the_mode_as_the_skewness_says(scene: Scene) -> None:
    """Without the skewness term the check finds the series displaced, with it it does not."""
    plain = dataclasses.replace(scene.surrogate, skew=np.zeros_like(scene.surrogate.skew))
    moved = scene.surrogate.across @ (-0.5 * scene.surrogate.skew) / np.sqrt(np.diag(scene.target.covariance))
    z = np.zeros((2, scene.surrogate.dimension))
    difference = scene.surrogate.moments(z)[0] - plain.moments(z)[0]
    np.testing.assert_allclose(
        difference / np.sqrt(np.diag(scene.target.covariance)), moved, atol=0.1 * np.abs(moved).max()
    )


def test_only_orders_2_and_3(scene: Scene) -> None:
    with pytest.raises(ValueError, match="order 4"):
        build_surrogate(scene.target, order=4)


def test_target_is_what_the_fit_minimises(scene: Scene) -> None:
    target = scene.target
    posterior = scene.world.likelihood.expand(np.asarray(scene.result.values), scene.result.noise_scale)
    assert target.objective(target.centre) == pytest.approx(posterior.objective, rel=1e-12)
    step = (
        0.3
        * np.sqrt(np.diag(target.covariance))
        * np.random.default_rng(1).standard_normal(len(target.centre))
    )
    slope = (target.objective(target.centre + step) - target.objective(target.centre - step)) / 2
    gradient = 2 * target.half_gradient(target.centre) @ step
    assert slope == pytest.approx(gradient, abs=0.02 * target.covariance.shape[0])
    assert isinstance(target, Target)


def test_draws_take_their_share_of_errors_that_are_inflated(gaussian: Surrogate) -> None:
    """A draw with ln f has the data's part of the quadratic form over f²; with ln f = 0 it is the plain one."""
    inflated = dataclasses.replace(gaussian, scale=1.3)
    rng = np.random.default_rng(4)
    z = np.column_stack([rng.standard_normal((5, 4)), [0.0, 0.0, 1.0, -1.0, 2.0]])
    x = gaussian.place(z[:, :4], rng.standard_normal((5, 3)))
    f = inflated.monitored(z)[:, -1] / 1.3
    assert f[:2].tolist() == [1.0, 1.0]
    np.testing.assert_allclose(inflated.weight(z), f**-2, rtol=1e-12)
    without = dataclasses.replace(gaussian, data=np.zeros_like(gaussian.data))
    data = gaussian.joint(z[:, :4], x) - without.joint(z[:, :4], x)
    np.testing.assert_allclose(inflated.joint(z, x), without.joint(z[:, :4], x) + data / f**2, rtol=1e-10)


def test_what_was_marginalised_is_drawn_with_the_errors_of_the_draw(gaussian: Surrogate) -> None:
    """Twice the errors: covariance of the marginalised coefficients given the others, by brute force."""
    inflated = dataclasses.replace(gaussian, scale=1.3)
    z = np.tile([0.3, -0.2, 0.1, 0.4, np.log(2.0) / ln_scale_unit(inflated.measured)], (40000, 1))
    x = inflated.draw(z, np.random.default_rng(6))
    offset = x - gaussian.centre - z[:, :4] @ gaussian.along.T
    s = np.linalg.lstsq(gaussian.across, offset.T, rcond=None)[0].T
    expected = np.linalg.inv(gaussian.data[-3:, -3:] / 4.0 + gaussian.prior[-3:, -3:])
    np.testing.assert_allclose(np.cov(s, rowvar=False), expected, atol=0.04 * np.diag(expected).max())

"""Counts to (q, u): closed forms, scipy on the same likelihood, Monte Carlo, and what has no answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from walop_jax.model.cameras import Cameras
from walop_jax.science.estimate import calibration_shift, estimate

# An ideal four-camera polarimeter, N_k = ½ F (1 ± q) and ½ F (1 ± u) per half, and one that holds no u.
IDEAL = 0.25 * np.array([[1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1]], float)
BLIND = 0.25 * np.array([[1, 1, 0], [1, -1, 0], [1, 1, 0], [1, -1, 0]], float)


def vectors(rng, rows):
    """Vectors of a polarimeter with imbalance and cross-talk, a different one for every row."""
    return IDEAL + 0.05 * rng.standard_normal((rows, 4, 3))


def observe(a, star, qu, flux, rng=None):
    s = np.concatenate([np.ones((len(star), 1)), qu[star]], axis=1)
    counts = flux[:, None] * np.einsum("rks,rs->rk", a, s)
    sigma = np.sqrt(np.abs(counts) + 900.0)
    return counts + (0.0 if rng is None else sigma * rng.standard_normal(counts.shape)), sigma


def test_ideal_instrument_by_hand():
    """q = (N0 − N1)/(N0 + N1) and u alike, where both halves hold the same light."""
    found = estimate(
        IDEAL[None], np.array([[110.0, 90.0, 95.0, 105.0]]), np.full((1, 4), 3.0), np.zeros(1, int)
    )
    np.testing.assert_allclose(found.qu, [[0.1, -0.05]], rtol=1e-13)
    # Var q for equal σ: model F(1 ± q)/4 and so on; at F = 400, (∂q) information 2 (F/4σ)² less what F takes.
    k, s, g = 1 / 8, np.array([1, 0.1, -0.05]), np.diag([2.0, 1.0, 1.0])
    information = 400**2 * k / 9 * (g - np.outer(g @ s, g @ s) / (s @ g @ s))[1:, 1:]
    np.testing.assert_allclose(found.photon[0], np.linalg.inv(information), rtol=1e-12)
    assert found.dof.tolist() == [1]
    np.testing.assert_allclose(found.chi2, 0, atol=1e-20)


def test_noiseless_counts_give_the_truth():
    rng = np.random.default_rng(0)
    star = np.array([0, 0, 0, 1, 2, 2])
    qu = rng.uniform(-0.5, 0.5, (3, 2))
    a = vectors(rng, 6)
    counts, sigma = observe(a, star, qu, rng.uniform(1e4, 1e7, 6))
    found = estimate(a, counts, sigma, star)
    np.testing.assert_allclose(found.qu, qu, atol=1e-12)
    assert found.dof.tolist() == [7, 1, 4]


def test_agrees_with_scipy():
    """The same likelihood with the fluxes as plain parameters, minimised by somebody else's code."""
    rng = np.random.default_rng(1)
    for rows in (1, 2, 4):
        a, star, flux = vectors(rng, rows), np.zeros(rows, int), rng.uniform(2e3, 2e4, rows)
        counts, sigma = observe(a, star, np.array([[0.04, -0.3]]), flux, rng)

        def residual(theta, a=a, counts=counts, sigma=sigma):
            s = np.array([1.0, *theta[:2]])
            return ((counts - theta[2:, None] * (a @ s)) / sigma).ravel()

        start = np.concatenate([[0.0, 0.0], flux])
        best = optimize.least_squares(residual, start, x_scale=np.abs(start) + 0.1, xtol=1e-15, ftol=1e-15)
        found = estimate(a, counts, sigma, star)
        np.testing.assert_allclose(found.qu[0], best.x[:2], atol=2e-8)
        np.testing.assert_allclose(found.chi2, 2 * best.cost, rtol=1e-9)
        covariance = np.linalg.inv(best.jac.T @ best.jac)[:2, :2]
        np.testing.assert_allclose(
            found.photon[0], covariance, rtol=0.02
        )  # up to the curvature of the residuals


def test_pulls_and_chi2_of_many_stars():
    rng = np.random.default_rng(2)
    star = np.repeat(np.arange(4000), 2)
    a, qu = vectors(rng, len(star)), rng.uniform(-0.05, 0.05, (4000, 2))
    counts, sigma = observe(a, star, qu, rng.uniform(1e5, 1e6, len(star)), rng)
    found = estimate(a, counts, sigma, star)
    pulls = (found.qu - qu) / np.sqrt(np.einsum("sii->si", found.photon))
    assert np.all(np.abs(pulls.mean(axis=0)) < 4 / np.sqrt(4000))
    np.testing.assert_allclose(pulls.std(axis=0), 1.0, atol=4 / np.sqrt(8000))
    assert found.chi2.sum() / found.dof.sum() == pytest.approx(1.0, abs=4 * np.sqrt(2 / found.dof.sum()))


def test_bias_of_faint_stars_is_of_order_one_over_counts():
    """At 2000 electrons a camera the mean of q is off by less than 1/N = 5e-4."""
    rng = np.random.default_rng(3)
    n = 200_000
    star = np.arange(n)
    a = np.broadcast_to(vectors(rng, 1), (n, 4, 3))
    qu = np.tile([[0.03, -0.02]], (n, 1))
    counts, sigma = observe(a, star, qu, np.full(n, 8000.0), rng)
    off = estimate(a, counts, sigma, star).qu.mean(axis=0) - qu[0]
    assert np.all(np.abs(off) < 5e-4)


def test_a_row_without_u_is_rescued_by_another():
    star = np.zeros(2, int)
    qu = np.array([[0.02, 0.03]])
    alone = estimate(BLIND[None], *observe(BLIND[None], star[:1], qu, np.array([1e6])), star[:1])
    assert np.isnan(alone.qu).all()
    assert np.isinf(alone.condition).all()
    both = np.stack([BLIND, IDEAL])
    found = estimate(both, *observe(both, star, qu, np.array([1e6, 3e5])), star)
    np.testing.assert_allclose(found.qu, qu, atol=1e-12)
    assert found.condition[0] < 5


def test_three_cameras_are_enough_and_two_are_not():
    a, star = vectors(np.random.default_rng(4), 1), np.zeros(1, int)
    qu = np.array([[0.02, -0.01]])
    counts, sigma = observe(a, star, qu, np.array([1e6]))
    counts[0, 3] = np.nan
    found = estimate(a, counts, sigma, star)
    np.testing.assert_allclose(found.qu, qu, atol=1e-12)
    assert found.dof.tolist() == [0]
    sigma[0, 2] = np.inf
    assert np.isnan(estimate(a, counts, sigma, star).qu).all()


def test_no_light_and_negative_light_have_no_answer_and_harm_nobody():
    rng = np.random.default_rng(5)
    a, star = vectors(rng, 3), np.arange(3)
    counts, sigma = observe(a, star, np.zeros((3, 2)), np.full(3, 1e5))
    counts[0], counts[1] = 0.0, -counts[1]
    found = estimate(a, counts, sigma, star)
    assert np.isnan(found.qu[:2]).all()
    np.testing.assert_allclose(found.qu[2], 0, atol=1e-13)


def test_calibration_shift_is_the_derivative():
    """Against the estimate with the vectors really changed; two rows of a star see the same change."""
    rng = np.random.default_rng(6)
    star = np.array([0, 0, 1])
    a, qu = vectors(rng, 3), rng.uniform(-0.05, 0.05, (2, 2))
    counts, sigma = observe(a, star, qu, rng.uniform(1e5, 1e6, 3))
    found = estimate(a, counts, sigma, star)
    change = 1e-6 * rng.standard_normal(a.shape)
    s = np.concatenate([np.ones((3, 1)), qu[star]], axis=1)
    predicted = calibration_shift(found.gain, np.einsum("rks,rs->rk", change, s)[..., None], star)[..., 0]
    moved = estimate(a + change, counts, sigma, star).qu - estimate(a - change, counts, sigma, star).qu
    np.testing.assert_allclose(predicted, 0.5 * moved, rtol=1e-5, atol=1e-12)


def test_arms_with_fluxes_of_their_own():
    """Whatever share of the light an arm gets, q is (N0 − N1)/(N0 + N1) and u is (N2 − N3)/(N2 + N3)."""
    pairs = Cameras(("O1", "E1", "O2", "E2"), arms=((0, 1), (2, 3)), split=True)
    counts = np.array([[110.0, 90.0, 9500.0, 10500.0]])
    found = estimate(IDEAL[None], counts, np.full((1, 4), 3.0), np.zeros(1, int), pairs)
    np.testing.assert_allclose(found.qu, [[0.1, -0.05]], rtol=1e-9)
    assert found.dof.tolist() == [0]
    # For equal σ of N0 and N1: σ(q)² = 2 (1 + q²) σ² / (N0 + N1)².
    np.testing.assert_allclose(np.sqrt(found.photon[0, 0, 0]), np.sqrt(2 * 1.01) * 3.0 / 200.0, rtol=1e-9)
    assert abs(found.photon[0, 0, 1]) < 1e-12
    rng = np.random.default_rng(4)
    star, qu = np.array([0, 0, 1]), rng.uniform(-0.3, 0.3, (2, 2))
    a = vectors(rng, 3)
    counts, sigma = observe(a, star, qu, rng.uniform(1e4, 1e6, 3))
    shares = np.repeat(rng.uniform(0.5, 2.0, (3, 2)), 2, axis=1)
    found = estimate(a, counts * shares, sigma, star, pairs)
    np.testing.assert_allclose(found.qu, qu, atol=1e-10)
    # The gain is the shift of (q, u) for a change of the model: by a finite difference.
    change = 1e-6 * rng.standard_normal(a.shape)
    moved = estimate(a + change, counts * shares, sigma, star, pairs)
    s = np.concatenate([np.ones((3, 1)), qu[star]], axis=1)
    shift = calibration_shift(found.gain, np.einsum("rks,rs->rk", change, s)[..., None], star)[..., 0]
    np.testing.assert_allclose(moved.qu - found.qu, shift, rtol=0, atol=1e-10)
    # Counts that a camera loses are as many of those of its arm, whatever light the other arm has.
    lost = counts * shares * [0.0, 0.0, 1e-6, 0.0]
    fainter = estimate(a, counts * shares - lost, sigma, star, pairs)
    shift = calibration_shift(found.gain, found.relative(lost)[..., None], star)[..., 0]
    np.testing.assert_allclose(fainter.qu - found.qu, shift, rtol=0, atol=1e-10)


def test_an_arm_without_counts_has_no_flux_and_leaves_that_of_others():
    pairs = Cameras(("O1", "E1", "O2", "E2"), arms=((0, 1), (2, 3)), split=True)
    counts = np.array(
        [[110.0, 90.0, 220.0, 180.0], [np.nan, 90.0, np.nan, np.nan], [110.0, 90.0, np.nan, np.nan]]
    )
    star = np.zeros(3, int)
    found = estimate(np.repeat(IDEAL[None], 3, axis=0), counts, np.full((3, 4), 3.0), star, pairs)
    # N0 + N1 = F/2.
    np.testing.assert_allclose(found.flux[0], [400.0, 400.0, 800.0, 800.0], rtol=0.01)
    np.testing.assert_allclose(found.flux[1:], [[400.0, 400.0, 0.0, 0.0]] * 2, rtol=0.02)
    np.testing.assert_array_equal(found.relative(np.ones((3, 4)))[1:, 2:], 0.0)

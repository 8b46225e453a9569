"""Averages over what cannot be told apart: closed forms of mixtures, and of one linear step from model to model."""

import numpy as np
import pytest

from walop_jax.diagnosis import class_product as average
from walop_jax.diagnosis.score import Projector


def test_two_members_as_probable_by_hand():
    """Means ±d with variance s²: mean 0, variance s² + d²; at odds of 3 to 1 d/2 and s² + 3 d²/4."""
    d, square = 2.0, 0.25
    values, covariances = np.array([[d], [-d]]), [np.array([[square]])] * 2
    mean, covariance = average.mixture(np.array([0.5, 0.5]), values, covariances)
    assert mean == pytest.approx([0.0])
    assert covariance == pytest.approx(np.array([[square + d**2]]))
    mean, covariance = average.mixture(np.array([0.75, 0.25]), values, covariances)
    assert mean == pytest.approx([d / 2])
    assert covariance == pytest.approx(np.array([[square + 0.75 * d**2]]))


def test_moments_of_a_mixture_are_those_of_its_draws():
    rng = np.random.default_rng(1)
    weights, values = np.array([0.2, 0.5, 0.3]), rng.normal(size=(3, 2))
    roots = 0.3 * rng.normal(size=(3, 2, 2))
    mean, covariance = average.mixture(weights, values, [root @ root.T for root in roots])
    member = rng.choice(3, 400_000, p=weights)
    draws = values[member] + np.einsum("kij,kj->ki", roots[member], rng.normal(size=(len(member), 2)))
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=5e-3)
    np.testing.assert_allclose(covariance, np.cov(draws.T), rtol=2e-2, atol=5e-3)


def test_truth_drawn_from_the_members_has_pulls_of_one():
    """The law of total variance: errors of a mixture are right on average, whoever of them is true."""
    rng = np.random.default_rng(2)
    weights, values = np.array([0.6, 0.3, 0.1]), np.array([[0.0], [5.0], [-9.0]])
    mean, covariance = average.mixture(weights, values, [np.eye(1)] * 3)
    true = values[rng.choice(3, 100_000, p=weights), 0] + rng.normal(size=100_000)
    pulls = (true - mean[0]) / np.sqrt(covariance[0, 0])
    assert np.mean(pulls) == pytest.approx(0.0, abs=0.02)
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.02)


def test_one_linear_step_is_the_least_squares_fit_of_the_other_model():
    rng = np.random.default_rng(3)
    others, told, instead = rng.normal(size=(40, 3)), rng.normal(size=(40, 1)), rng.normal(size=(40, 2))
    data = rng.normal(size=40)
    fit = np.linalg.lstsq(np.hstack([others, told]), -data, rcond=None)[0]
    residual = data + np.hstack([others, told]) @ fit
    lost = -told[:, 0] * fit[3]
    basis = np.linalg.qr(others)[0]
    left = residual + lost - basis @ (basis.T @ (residual + lost))
    projected = instead - basis @ (basis.T @ instead)
    b = -np.linalg.solve(projected.T @ projected, projected.T @ left)
    by = -Projector(others).taken_up(Projector(others).basis.T @ (lost + instead @ b))
    right = np.linalg.lstsq(np.hstack([others, instead]), -data, rcond=None)[0]
    np.testing.assert_allclose(b, right[3:], rtol=1e-10)
    np.testing.assert_allclose(fit[:3] + by, right[:3], rtol=1e-10)


def test_what_is_left_of_a_covariance_once_some_numbers_are_known():
    """Against the inverse of the information without their rows."""
    root = np.random.default_rng(4).normal(size=(5, 9))
    information = root @ root.T
    found = average.known_apart_from(np.linalg.inv(information), np.array([1, 3]))
    rest = [0, 2, 4]
    np.testing.assert_allclose(found[np.ix_(rest, rest)], np.linalg.inv(information[np.ix_(rest, rest)]))
    assert not found[[1, 3]].any()
    assert not found[:, [1, 3]].any()


def test_members_that_do_the_same_count_once_the_most_probable_of_them():
    errors, evidence = np.full((2, 1), 0.1), np.array([1.0, 2.0, 0.5])
    changes = np.array([[[1.0], [1.0]], [[1.01], [0.99]], [[0.0], [1.0]]])
    assert average.distinct(evidence, changes, errors, 0.3) == [[1, 0], [2]]
    assert average.distinct(evidence, changes, errors, 0.01) == [[1], [0], [2]]

"""Accuracy of p over the field, against a draw of matrices and the closed form of an ideal instrument."""

from __future__ import annotations

import dataclasses

import numpy as np
from small_run import small_fit

from walop_jax.calibration.accuracy import p_errors, sample_stars
from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.verdict import Hidden, UndetectedError
from walop_jax.science.field_accuracy import GROUPS, FieldAccuracy, field_accuracy

IDEAL = np.array([[0.0, 1.0, 0.0, 0.0, 0.0, 1.0]])


def test_ideal_instrument_with_uncertain_zero_points():
    covariance = np.diag([0.01, 0, 0, 0.01, 0, 0])[None] ** 2
    # δp = −e · (δm21, δm31) with |e| = 1: the error of a zero point.
    np.testing.assert_allclose(p_errors(IDEAL, covariance), 0.01, rtol=1e-12)


def test_ideal_instrument_with_an_uncertain_efficiency():
    covariance = np.diag([0, 0.01, 0, 0, 0, 0])[None] ** 2
    stars = np.array([[0.04, 0.0]])
    # δq = −q δm22
    np.testing.assert_allclose(p_errors(IDEAL, covariance, stars), 0.0004, rtol=1e-12)


def test_against_drawn_matrices():
    rng = np.random.default_rng(1)
    matrix = np.array([[0.02, 0.97, 0.1, -0.03, -0.2, 0.7]])
    root = 1e-4 * rng.standard_normal((6, 6))
    stars = sample_stars(20)
    drawn = matrix + rng.standard_normal((40_000, 6)) @ root.T
    measured = matrix[0, [0, 3]] + stars @ matrix[0, [1, 2, 4, 5]].reshape(2, 2).T
    inverse = np.linalg.inv(drawn[:, [1, 2, 4, 5]].reshape(-1, 2, 2))
    found = np.einsum("dij,dnj->dni", inverse, measured - drawn[:, None, [0, 3]])
    scatter = np.sqrt(np.mean((np.hypot(*np.moveaxis(found, -1, 0)) - np.hypot(*stars.T)) ** 2))
    np.testing.assert_allclose(p_errors(matrix, (root @ root.T)[None], stars), scatter, rtol=0.03)


def test_no_inverse_is_no_knowledge():
    blind = np.array([[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]])
    assert not np.isfinite(p_errors(blind, 1e-8 * np.eye(6)[None])).any()


def test_map_of_a_fit():
    found = field_accuracy(Calibration.from_fit(small_fit()), size=5)
    assert found is not None
    assert found.error.shape == (5, 5)
    assert found.filter == "SDSS-r"
    assert 0 < found.median < 0.01
    assert found.share == np.mean(found.error < 1e-3)


def test_good_enough_for_a_goal():
    """The calibration may make half of the goal in 95 % of the field where an exposure measures u; no more may hide."""
    error = np.full((10, 10), 2e-4)
    error[0, :3] = 9e-4  # 3 % of the field
    known = FieldAccuracy(error, (-0.3, 0.3, -0.3, 0.3), "SDSS-r", hidden=3e-4, hidden_by="x", remedy="look")
    assert known.shortfalls == ()
    assert dict(known.facts())["good for 0.1 %"] == "yes: 0.020 % in 95 % of the field"
    strict = dataclasses.replace(known, goal=2e-4)
    what = ["0.020 % in 95 % of the field, 0.010 % allowed"]
    what += ["a systematic error of 0.030 % of q or u would go undetected"]
    assert [one.found for one in strict.shortfalls] == what
    # Errors fall with the square root of the light.
    assert strict.shortfalls[0].advice.startswith("4.0 times the light")
    assert strict.shortfalls[1].advice == "look"
    assert dict(strict.facts())["good for 0.02 %"] == "no, for 2 reasons above"
    assert strict.document()["good_enough"] is False
    assert strict.share == 0.0
    untrusted = dataclasses.replace(known, trusted=False)
    assert untrusted.document()["good_enough"] is False


def test_what_limits_it_is_what_alone_is_uncertain():
    """With all but one part known exactly, that part makes the whole variance; a mistake that hides is told."""
    calibration = Calibration.from_fit(small_fit())
    parts = np.array([name.split(".")[0] for name in calibration.model.names])
    for part in ("collimator", "throughput"):
        only = np.outer(parts == part, parts == part)
        one = dataclasses.replace(calibration, covariance=np.where(only, calibration.covariance, 0.0))
        found = field_accuracy(one, size=3)
        assert found is not None
        assert found.limited_by == f"{GROUPS[part]} (100 % of the variance)"
    change = np.where(np.array(calibration.model.names) == "collimator.q", 0.002, 0.0)
    check = "an independent check of the field positions"
    hidden = Hidden((UndetectedError("the scale of X and Y", 0.02, "", remedy=check),), change[None])
    found = field_accuracy(dataclasses.replace(calibration, hidden=hidden), size=3)
    assert found is not None
    # A diattenuation of the light ahead of everything is an offset of q: 0.002, but for what p does to second order.
    np.testing.assert_allclose(found.hidden, 0.002, rtol=0.1)
    told = dict(found.facts())
    assert told["caused by"] == "the scale of X and Y (an error of 2 %)"
    assert told["remedy"] == check

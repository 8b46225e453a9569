"""Degree and angle of polarisation: numbers by hand, limits, invariance, and the bias that is taken away."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.science.polarisation import NO_ANGLE, polarisation

ROUND = 1e-6 * np.eye(2)[None]  # σ = 0.001


def test_numbers_by_hand():
    """q = 0.003, u = 0.004, σ = 0.001: p = 0.005, σ_p = 0.001, EVPA = ½ arctan2(4, 3), σ = 0.1 rad."""
    found = polarisation(np.array([[0.003, 0.004]]), ROUND)
    assert found.degree[0] == pytest.approx(0.005)
    assert found.degree_error[0] == pytest.approx(0.001)
    assert found.angle[0] == pytest.approx(26.5650512)
    assert found.angle_error[0] == pytest.approx(5.7295780)
    # 0.005 − 1e-6 (1 − e⁻²⁵) / 0.01, and √(25 − 1) · 0.001
    assert found.debiased[0] == pytest.approx(0.0049, rel=1e-9)
    assert polarisation(np.array([[0.003, 0.004]]), ROUND, "WK").debiased[0] == pytest.approx(0.00489897949)


def test_angles_go_from_north_to_east_within_half_a_turn():
    qu = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, -1e-3]]) * 0.01
    np.testing.assert_allclose(polarisation(qu, np.repeat(ROUND, 5, 0)).angle[:4], [0, 45, 90, 135])
    assert 179.9 < polarisation(qu, np.repeat(ROUND, 5, 0)).angle[4] < 180


def test_limits_at_no_signal():
    found = polarisation(np.array([[1e-9, 0.0], [0.0, 0.0]]), np.repeat(ROUND, 2, 0))
    assert found.debiased[0] == pytest.approx(0.5e-9, rel=1e-6)  # MAS → p/2
    assert found.debiased[1] == 0
    np.testing.assert_allclose(found.angle_error, NO_ANGLE, rtol=1e-4)
    assert polarisation(np.array([[1e-9, 0.0]]), ROUND, "WK").debiased[0] == 0
    nothing = polarisation(np.full((1, 2), np.nan), np.full((1, 2, 2), np.nan))
    assert np.isnan(nothing).all()


def test_axes_do_not_matter():
    """Turned (q, u) with their turned covariance: same degree, debiased degree and errors."""
    qu, c = np.array([[0.004, 0.001]]), np.array([[[2e-6, 5e-7], [5e-7, 1e-6]]])
    one = polarisation(qu, c)
    for angle in (0.3, 1.1, 2.5):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        other = polarisation(qu @ turn.T, turn @ c @ turn.T)
        for name in ("degree", "debiased", "degree_error", "angle_error"):
            np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=1e-10)
        assert np.mod(other.angle - one.angle, 180.0)[0] == pytest.approx(np.rad2deg(angle) / 2)


@pytest.mark.parametrize(
    ("qu", "covariance"),
    [
        ([0.004, -0.040], [[1e-6, 0.0], [0.0, 1e-3]]),  # u hardly known: the angle may lie 90° away
        ([0.004, 0.002], [[1e-12, 0.0], [0.0, 1e-4]]),
        ([1e-5, 0.002], [[1e-12, 0.0], [0.0, 1e-4]]),
        ([0.002, 0.001], [[1e-6, 5e-7], [5e-7, 2e-6]]),
        ([0.0, 0.0045], [[1e-6, 0.0], [0.0, 1e-6]]),
        ([0.010, 0.0], [[1e-6, 0.0], [0.0, 4e-4]]),  # p is ten of its errors, half of one across
        ([0.010, 0.0], [[1e-6, 0.0], [0.0, 2.5e-5]]),
    ],
)
def test_angles_of_weak_light_scatter_as_drawn_ones(qu, covariance):
    qu, covariance = np.array([qu]), np.array([covariance])
    found = polarisation(qu, covariance)
    drawn = np.random.default_rng(1).multivariate_normal(qu[0], covariance[0], 400_000)
    away = np.rad2deg(0.5 * np.arctan2(drawn[:, 1], drawn[:, 0])) - found.angle[0]
    rms = np.sqrt(np.mean((np.mod(away + 90.0, 180.0) - 90.0) ** 2))
    assert found.angle_error[0] == pytest.approx(rms, rel=0.01)


@pytest.mark.parametrize("estimator", ["MAS", "WK"])
def test_bias_is_taken_away(estimator):
    """p₀ = 3 σ along the narrow and the wide axis of an ellipse: naive bias σ_t²/2p₀, debiased far less."""
    rng = np.random.default_rng(0)
    c = np.diag([1e-6, 2.25e-6])
    for truth, across in (([0.004, 0.0], 2.25e-6), ([0.0, 0.005], 1e-6)):
        qu = truth + rng.multivariate_normal([0, 0], c, 200_000)
        found = polarisation(qu, np.broadcast_to(c, (len(qu), 2, 2)), estimator)
        p0 = np.hypot(*truth)
        naive = across / (2 * p0)
        assert found.degree.mean() - p0 == pytest.approx(naive, rel=0.15)
        assert abs(found.debiased.mean() - p0) < 0.25 * naive


def test_unknown_estimators_are_refused():
    with pytest.raises(ValueError, match="choose MAS or WK"):
        polarisation(np.zeros((1, 2)), ROUND, "simple")

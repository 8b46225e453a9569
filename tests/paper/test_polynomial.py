"""Paper II's method: closed forms of its steps, and why it needs Δ."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.calibration.accuracy import p_errors
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.data.settings import Settings
from walop_jax.fit.verdict import Structure
from walop_jax.io.errors import DataError
from walop_jax.paper import comparison
from walop_jax.paper import polynomial as paper
from walop_jax.science import star_errors as accuracy
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import _catalogue, _without_light, simulate

ANGLES = np.arange(15) * 12.0


def pair(alpha: float, eta: float = 1.0) -> np.ndarray:
    """An instrument without cross-talk whose pairs have throughputs 1 ± alpha."""
    signs = np.array([[1, eta, 0], [1, -eta, 0], [1, 0, eta], [1, 0, -eta]], float)
    return 0.5 * signs * (1 + alpha * np.array([1, -1, 1, -1]))[:, None]


def test_stars_are_spread_evenly():
    stars = paper.sample_stars(20_000)
    p = np.hypot(*stars.T)
    assert p.max() <= 0.05
    assert p.mean() == pytest.approx(0.025, rel=0.02)
    np.testing.assert_allclose(stars.mean(axis=0), 0, atol=1e-3)


def test_measured_ratio_of_an_imbalanced_pair_is_not_linear():
    """r = (α + q)/(1 + αq)."""
    stars = np.array([[0.4, -0.3], [-1.0, 0.0], [0.0, 0.0]])
    alpha = 0.03
    found = paper.measured_qu(paper.transmitted(pair(alpha)[None], stars))[0]
    np.testing.assert_allclose(found, (alpha + stars) / (1 + alpha * stars), rtol=1e-13)


def test_polynomial_is_least_squares():
    rng = np.random.default_rng(0)
    measured, states = rng.uniform(-1, 1, (3, 15, 2)), rng.uniform(-1, 1, (15, 2))
    coefficients, condition = paper.fit_polynomials(measured, states)
    for p in range(3):
        q, u = measured[p].T
        design = np.stack([np.ones(15), q, u, q**2, u**2], axis=1)
        np.testing.assert_allclose(
            coefficients[p].T, np.linalg.lstsq(design, states, rcond=None)[0], rtol=1e-9
        )
        assert condition[p] == pytest.approx(np.linalg.cond(design / np.linalg.norm(design, axis=0)))


def test_between_points_on_a_line_all_is_linear_along_it():
    tilts, rng = np.array([10.0, 0.0, 5.0]), np.random.default_rng(3)
    coefficients, transmission = rng.standard_normal((3, 2, 5)), rng.standard_normal((3, 4, 3))
    made = paper.PaperCalibration(
        tilts, np.ones(3), coefficients, transmission, coefficients[:, :, 0], coefficients[:, :, 1], tilts
    )
    at = made.between(np.array([5.0, 1.0, 12.5]), np.ones(3))
    expected = [
        transmission[2],
        0.8 * transmission[1] + 0.2 * transmission[2],
        1.5 * transmission[0] - 0.5 * transmission[2],
    ]
    np.testing.assert_allclose(at.transmission, expected, rtol=1e-12)
    np.testing.assert_allclose(at.condition, [5.0, 1.0, 12.5], rtol=1e-12)
    with pytest.raises(ValueError, match="nothing between them"):
        made.between(np.array([5.0]), np.array([0.9]))


def test_transmissions_do_not_need_the_fluxes():
    rng = np.random.default_rng(1)
    vectors = pair(0.04)[None] * rng.uniform(0.9, 1.1, (5, 4, 1)) + 0.03 * rng.standard_normal((5, 4, 3))
    states = paper.polariser_states(ANGLES)
    counts = rng.uniform(0.7, 1.0, (5, 15, 1)) * 1e6 * paper.transmitted(vectors, states)
    found = paper.fit_transmissions(counts, states)
    expected = vectors / vectors[..., 0].mean(axis=1)[:, None, None]
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_why_there_is_a_delta():
    """α = 0.03, no noise, no cross-talk: the polarised states alone leave Δ; one unpolarised exposure takes it away.

    On these states q² + u² = 1 and q = (r − α)/(1 − αr), so q_m² + u_m² = 1 to first order in α: the design matrix
    has a direction (1, 0, 0, −1, −1) along which next to nothing is known.
    """
    vectors, stars = pair(0.03, 0.999)[None], paper.sample_stars()
    states = paper.polariser_states(ANGLES)
    measured = paper.measured_qu(paper.transmitted(vectors, states))
    coefficients, condition = paper.fit_polynomials(measured, states)
    rng = np.random.default_rng(2)
    noisy = measured + 1e-3 * rng.standard_normal(measured.shape)
    spoilt, _ = paper.fit_polynomials(noisy, states)
    zero = np.zeros(1)
    made = paper.with_test_stars(zero, zero, spoilt, condition, vectors, stars)
    why = comparison.offsets(made, noisy, states, vectors, stars)
    weakest = np.linalg.svd(paper.polynomial_terms(measured[0]), full_matrices=False)[2][-1]
    np.testing.assert_allclose(weakest / weakest[0], [1, 0, 0, -1, -1], atol=0.1)
    assert condition[0] > 15
    assert np.abs(made.delta).max() > 2e-3
    np.testing.assert_allclose(why.along, made.delta, atol=0.1 * np.abs(made.delta).max())
    assert np.abs(why.anchored).max() < 0.15 * np.abs(made.delta).max()
    np.testing.assert_allclose(
        made.recover(paper.measured_qu(paper.transmitted(vectors, stars)))[0].mean(axis=0),
        stars.mean(axis=0),
        atol=1e-12,
    )
    assert coefficients.shape == (1, 2, 5)


def test_between_is_bilinear_and_wants_a_grid():
    x, y = (a.ravel() for a in np.meshgrid([0.0, 0.1, 0.3], [-0.2, 0.2]))
    plane = 1 + 2 * x - 3 * y
    grid = paper.PaperCalibration(
        x,
        y,
        plane[:, None, None] * np.ones((6, 2, 5)),
        np.ones((6, 4, 3)),
        np.ones((6, 2)),
        np.ones((6, 2)),
        plane,
    )
    rng = np.random.default_rng(3)
    px, py = rng.uniform(0, 0.3, 9), rng.uniform(-0.2, 0.2, 9)
    np.testing.assert_allclose(grid.between(px, py).coefficients[:, 1, 3], 1 + 2 * px - 3 * py, rtol=1e-12)
    broken = paper.PaperCalibration(*(getattr(grid, n)[1:] for n in grid.__dataclass_fields__))
    with pytest.raises(ValueError, match="no regular grid"):
        broken.between(px, py)


def test_statistics_by_hand():
    errors = np.outer([0.0002, 0.0004, 0.0030, 0.0008], [1.0, 0.5, 0.0])
    found = accuracy.statistics(errors)
    assert found["q"]["median"] == pytest.approx(0.06)
    assert found["q"]["rms"] == pytest.approx(100 * np.sqrt((4 + 16 + 900 + 64) / 4) * 1e-4)
    assert found["q"]["max"] == pytest.approx(0.3)
    assert found["q"]["share_below_goal"] == 0.75
    assert found["p"]["share_below_goal"] == 1.0
    assert accuracy.statistics(errors, np.array([True, False, False, False]))["q"]["rms"] == pytest.approx(
        0.02
    )


def test_perfect_calibrations_make_no_error():
    vectors, stars = pair(0.02)[None], paper.sample_stars(20)
    np.testing.assert_allclose(accuracy.joint_errors(vectors, vectors, stars), 0, atol=1e-12)
    rows = [(vectors[:, i] - vectors[:, i + 1]) / (vectors[:, i] + vectors[:, i + 1])[:, :1] for i in (0, 2)]
    again = accuracy.truth_vectors(vectors, np.concatenate(rows, axis=1))
    np.testing.assert_allclose(again, vectors, atol=1e-15)
    np.testing.assert_allclose(accuracy.determinant(vectors), 1 - 0.02**2, atol=2e-3)


def test_too_few_angles_are_refused():
    plan = ObservingPlan(grid=3, polariser_angles=polariser_turn(4), moon_patches=0, standards=0)
    with pytest.raises(DataError, match=r"4 polariser angles .* needs 5"):
        paper.fit_paper(simulate(plan).calset)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        # Eight angles of a full turn are four directions: the plan of a user.
        ({"polariser_angles": 8, "full_turn": True}, r"4 polariser angles .* needs 5"),
        ({"polariser_angles": 9, "filters": ("NB-660",)}, r"0 polariser angles .* in SDSS-r .* --filter"),
    ],
)
def test_a_set_without_enough_angles_is_refused_before_the_joint_fit(monkeypatch, plan, message):
    def fit(*args, **options):
        raise AssertionError("the joint model was fitted, in vain")

    monkeypatch.setattr("walop_jax.fit.refit.refit", fit)
    observing, rng = (
        ObservingPlan(grid=2, moon_patches=0, standards=0, unpolarised=0, **plan),
        np.random.default_rng(0),
    )
    blank = _without_light(observing, _catalogue(observing, rng)[0], 0, 4)
    counts = rng.uniform(1e4, 2e4, np.shape(blank.intensities.counts))
    lit = dataclasses.replace(blank.intensities, counts=counts, sigma=np.sqrt(counts))
    calset = dataclasses.replace(blank, intensities=lit)
    with pytest.raises(DataError, match=message):
        walop.compare(calset)


@pytest.mark.long
def test_promised_errors_are_the_covariance(calibration):
    """Against a set of wrong calibrations: root mean square of `joint_errors` over draws."""
    analysis, setting = AnalysisVectors(calibration), Settings.default(1)
    x, y, stars = np.array([-0.1, 0.05, 0.2]), np.array([-0.1, -0.2, 0.1]), paper.sample_stars(5)
    promised = accuracy.promised_errors(analysis, setting, x, y, stars)
    reference = analysis.exact(setting, x, y, [np.nan])[:, 0]
    value, vector = np.linalg.eigh(calibration.covariance)
    root = vector * np.sqrt(np.clip(value, 0, None))
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(60):
        values = calibration.values + root @ rng.standard_normal(len(root))
        there = AnalysisVectors(dataclasses.replace(calibration, values=values))
        squares.append(
            accuracy.joint_errors(there.exact(setting, x, y, [np.nan])[:, 0], reference, stars) ** 2
        )
    ratio = np.sqrt(np.mean(squares, axis=0)) / promised
    assert np.all((ratio > 0.7) & (ratio < 1.35))


def test_promised_errors_hold_the_structure_of_field_points(calibration):
    """Gains and responses of 2·10⁻³: the error of p is that by the matrix, whose covariance has them in closed form."""
    verdict = dataclasses.replace(calibration.verdict, structure=Structure(gain=2e-3, response=2e-3))
    there = dataclasses.replace(calibration, verdict=verdict)
    x, y, stars = np.array([-0.1, 0.05, 0.2]), np.array([-0.1, -0.2, 0.1]), paper.sample_stars(5)
    promised = accuracy.promised_errors(AnalysisVectors(there), Settings.default(1), x, y, stars)
    np.testing.assert_allclose(promised[:, 2], p_errors(*there.matrix(x, y), stars), rtol=0.05)

"""Errors from residuals: closed forms, understated errors, and exposures that each have a disturbance of their own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import small_fit

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.certify import certify
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.calibration.summary import summary
from walop_jax.data.records import CalibrationSet, Position
from walop_jax.diagnosis.trust import examined
from walop_jax.fit import robust
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit, refit
from walop_jax.fit.robust import field_cells, larger, states
from walop_jax.fit.verdict import STATED
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate, truth_values

PLAN = ObservingPlan(
    grid=6, standard_grid=2, polariser_angles=polariser_turn(24), moon_patches=2, standards=4, unpolarised=1
)


def test_larger_of_diagonal_ones_is_the_larger_of_each():
    one, other = np.diag([4.0, 1.0, 9.0]), np.diag([1.0, 25.0, 9.0])
    np.testing.assert_allclose(larger(one, other), np.diag([4.0, 25.0, 9.0]), atol=1e-12)


def test_larger_is_nowhere_smaller_and_nothing_where_both_agree():
    rng = np.random.default_rng(0)
    a, b = (m @ m.T + 0.1 * np.eye(5) for m in rng.normal(size=(2, 5, 5)))
    both = larger(a, b)
    assert np.linalg.eigvalsh(both - a).min() > -1e-12
    assert np.linalg.eigvalsh(both - b).min() > -1e-12
    np.testing.assert_allclose(larger(a, a), a, atol=1e-12)
    np.testing.assert_allclose(larger(a, 0.5 * a), a, atol=1e-12)
    few = np.outer(b[0], b[0])  # of a single block: no knowledge in all other directions
    assert np.linalg.eigvalsh(larger(a, few) - a).min() > -1e-12


@pytest.fixture(scope="module")
def clean() -> tuple[CalibrationSet, dict[str, float]]:
    calset, truth = simulate(PLAN, seed=5)
    return calset, truth_values(truth)


def pulls(result: FitResult, true: dict[str, float]) -> np.ndarray:
    off = result.values - np.array([true[name] for name in result.model.names])
    return (off / np.where(result.sigma > 0, result.sigma, np.inf))[result.model.free]


def test_a_good_fit_keeps_its_errors(clean):
    result = examined(refit(clean[0]))
    assert result.errors_from == STATED
    assert summary(result, seconds=0.0)["errors_from"] == "N_ERR"


def test_understated_errors_are_found(clean):
    """N_ERR a third of the truth: errors of what has no prior become three times those stated, or somewhat more."""
    calset, true = clean
    block = block_of(calset)
    claimed = with_block(calset, sigma=np.where(block.used[..., None], block.sigma / 3.0, 1.0))
    plain = fit(Likelihood.of(claimed, base_model(claimed)))
    result = refit(claimed)
    free = [i for i in result.model.free if result.model.parameters[i].prior is None]
    ratio = result.sigma[free] / plain.sigma[free]
    assert ratio.min() > 2.9
    assert np.median(ratio) < 4.5  # few blocks: the largest of three noisy covariances is a third too large
    assert np.abs(pulls(result, true)).max() < 4.5


@pytest.mark.long
def test_exposures_with_a_disturbance_of_their_own(clean, tmp_path):
    """The polariser stands a twentieth of a degree from where its encoder says, each time another way."""
    calset, true = clean
    off = np.random.default_rng(3).normal(0.0, 0.05, len(calset.exposures))
    said = calset.exposures.placed(CLP=Position.at(calset.exposures.clp_angle + off))
    disturbed = dataclasses.replace(calset, exposures=said)
    plain = fit(Likelihood.of(disturbed, base_model(disturbed)))
    result = refit(disturbed)
    assert "states" in result.errors_from
    assert "36 cells" in result.errors_from
    assert np.abs(pulls(plain, true)).max() > 8.0
    assert np.abs(pulls(result, true)).max() < 4.5
    assert 0.3 < np.sqrt(np.mean(pulls(result, true) ** 2)) < 1.3

    write_calibration(tmp_path / "calibration.fits", Calibration.from_fit(result.with_verdict()))
    product = read_calibration(tmp_path / "calibration.fits")
    assert product.verdict.errors_from == result.errors_from
    [check] = [check for check in certify(product) if check.name == "covariance"]
    assert check.passed
    assert "residuals: chi2/dof" in check.found
    np.testing.assert_allclose(product.sigma, result.sigma)


def test_blocks(clean):
    calset, _ = clean
    e = calset.exposures
    assert len(np.unique(states(calset))) == len(e)
    coarse = np.round(e.clp_angle / 30.0) * 30.0
    at_once = dataclasses.replace(e, mjd=np.zeros(len(e)), temp=np.zeros(len(e))).placed(
        CLP=Position.at(coarse)
    )
    twice = dataclasses.replace(calset, exposures=at_once)
    through = e.clp_in
    assert len(np.unique(states(twice)[through])) == len(np.unique(coarse[through]))
    assert field_cells(calset).max() < 36


def test_blocks_that_scatter_widely_make_the_covariance(monkeypatch):
    """Sandwich written out: far larger than all else, it is the whole answer; B blocks know B − 1 differences."""
    result = small_fit()
    rng = np.random.default_rng(1)
    model, expansion = result.model, result.expansion
    size, count = np.sqrt(np.diag(expansion.matrix)), 2 * len(model.free)
    gradients = 100.0 * rng.standard_normal((count, len(size))) * size
    monkeypatch.setattr(robust, "_gradients", lambda *_: iter([("blocks", gradients)]))
    found, _ = robust.robust_errors(result.likelihood, result.values, expansion)
    inverse = np.linalg.inv(expansion.matrix / np.outer(size, size))
    scaled = gradients / size
    expected = inverse @ (count / (count - 1) * scaled.T @ scaled) @ inverse
    # The priors, which are no blocks, are 1e-4 of it.
    np.testing.assert_allclose(np.diag(found) * size**2, np.diag(expected), rtol=2e-3)

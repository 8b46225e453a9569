"""Structure that no smooth pattern holds: moments are those of dense algebra, noise passes, what is there is told."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SMALL, small_fit

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.trust import examined
from walop_jax.diagnosis.variance_components import _Grouping, asked, groupings, variance_components
from walop_jax.fit.refit import refit
from walop_jax.fit.verdict import Structure
from walop_jax.likelihood.flux import project_flux
from walop_jax.simulation.simulate import simulate


@pytest.fixture(scope="module")
def design() -> Design:
    return Design.of(small_fit())


def dense(design: Design, grouping: _Grouping) -> np.ndarray:
    """The columns of a grouping one by one, their fluxes and parameters projected out: P A."""
    measured, columns = design.measured, []
    for place in np.unique(grouping.place[grouping.place >= 0]):
        for k in range(measured.cameras):
            # A gain multiplies the counts of the model, a response adds a share of the mean counts of the camera.
            mean = measured.level[:, None, :] * measured.weight
            changed = [(measured.model, feature) for feature in np.moveaxis(grouping.gains, -1, 0)]
            changed += [(mean, feature) for feature in np.moveaxis(grouping.responses, -1, 0)]
            for counts, feature in changed:
                change = np.zeros_like(measured.model)
                here = measured.flux * feature * (grouping.place == place)
                change[..., k] = here * counts[..., k]
                left = project_flux(change, measured.model, measured.known, measured.shared)
                rows = np.zeros(len(design.residual))
                rows[: design.rows] = left[measured.used].reshape(-1)
                columns.append(design.projector(rows))
    return np.stack(columns, axis=1)


def noise(design: Design, draws: int, seed: int) -> np.ndarray:
    """Draws of the residuals that noise leaves."""
    rng, unit = np.random.default_rng(seed), design.measured.unit_model
    rows = rng.standard_normal((draws, *unit.shape))
    rows -= np.sum(rows * unit, axis=-1, keepdims=True) * unit
    # A weak pull is no datum: it has no noise.
    priors = (
        rng.standard_normal((draws, len(design.residual) - design.rows)) * design.fit.likelihood.priors.known
    )
    return design.projector(np.concatenate([rows.reshape(draws, -1), priors], axis=1).T)


def test_moments_are_those_of_dense_columns(design):
    """κ₂ and κ₃ of T = |Aᵀr|² − c |r|² from the eigenvalues of AᵀPA, and Aᵀr itself."""
    residual, free = noise(design, 2, 1), design.projector.free
    checked = 0
    for grouping in groupings(design):
        question, pull = asked(design, grouping, residual)
        columns = dense(design, grouping)
        np.testing.assert_allclose(
            np.sum(pull**2, axis=0), np.sum((columns.T @ residual) ** 2, axis=0), rtol=1e-8
        )
        value = np.linalg.eigvalsh(columns.T @ columns)
        share = value.sum() / free
        second = 2.0 * (np.sum(value**2) - share * value.sum())
        third = 8.0 * (np.sum(value**3) - 3 * share * np.sum(value**2) + 2 * share**2 * value.sum())
        assert question.share == pytest.approx(share, rel=1e-6)
        assert question.error == pytest.approx(2.0 / np.sqrt(second), rel=1e-5)
        assert question.skew == pytest.approx(third / second**1.5, rel=1e-4)
        checked += 1
    assert checked >= 5


def test_noise_raises_an_alarm_as_seldom_as_promised(design):
    """Of 3000 draws some 3 are expected with the correction for all groupings; 1 in 500 was asked for."""
    residual = noise(design, 3000, 2)
    square, smallest = np.sum(residual**2, axis=0), np.ones(3000)
    asked_of = list(groupings(design))
    for grouping in asked_of:
        question, pull = asked(design, grouping, residual)
        p = np.array([question.answered(pull[:, i], square[i]).p_value for i in range(3000)])
        assert 0.3 < np.mean(p < 0.1) / 0.1 < 1.3, grouping.name
        smallest = np.minimum(smallest, p)
    alarms = int(np.sum(smallest < 1.0 - (1.0 - thresholds.UNLIKELY) ** (1.0 / len(asked_of))))
    assert alarms <= 9  # 3 expected: more has a chance of 0.1 %


def with_gains(calset: CalibrationSet, size: float, seed: int = 3) -> CalibrationSet:
    """A gain of every field point and camera, the same in all exposures: a flat field that nobody divided by."""
    counts = block_of(calset).counts
    gain = 1.0 + size * np.random.default_rng(seed).standard_normal((len(counts), 1, counts.shape[2]))
    return with_block(calset, counts=counts * gain)


@pytest.fixture(scope="module")
def rough():
    """Gains of 0.1 % that nobody knows, in sixteen exposures of 25 field points."""
    return examined(refit(with_gains(simulate(SMALL, seed=4).calset, 1e-3)))


def test_structure_is_told_with_its_size(rough):
    assert not rough.trusted
    assert "residuals of the same field point agree between exposures" in "; ".join(
        rough.verdict.residual_doubts
    )
    assert rough.verdict.structure.gain == pytest.approx(1e-3, rel=0.3)


def test_errors_of_one_place_hold_its_structure(rough, tmp_path):
    """m21 = (N₁ − N₂)/(N₁ + N₂): gains that differ by √2 · 10⁻³ move it by 0.7 · 10⁻³ (1 − m21²); the file says so."""
    calibration = Calibration.from_fit(rough)
    x, y = np.array([0.05]), np.array([-0.1])
    values, covariance = calibration.matrix(x, y)
    verdict = dataclasses.replace(calibration.verdict, structure=Structure())
    _, smooth = dataclasses.replace(calibration, verdict=verdict).matrix(x, y)
    added = np.sqrt(covariance[0, 0, 0] - smooth[0, 0, 0])
    gain = rough.verdict.structure.gain
    assert added == pytest.approx(gain / np.sqrt(2.0) * (1.0 - values[0, 0] ** 2), rel=1e-6)
    write_calibration(tmp_path / "rough.fits", calibration)
    again = read_calibration(tmp_path / "rough.fits", any_model=True)
    assert again.verdict.structure.gain == pytest.approx(gain, rel=1e-12)


def test_parameters_know_of_the_structure_in_their_data(rough):
    """Errors grow by what the same gains do to the parameters of other draws: the two agree to a third."""
    plain = refit(with_gains(simulate(SMALL, seed=4).calset, 1e-3))
    ratio = rough.sigma[rough.sigma > 0] / plain.sigma[rough.sigma > 0]
    assert ratio.max() > 1.5
    assert ratio.min() > 0.99


def test_a_clean_fit_has_none():
    found = variance_components(Design.of(small_fit()))
    assert {one.grouping.name for one in found} >= {"field points", "field points in q and u", "exposures"}
    assert all(one.p_value > thresholds.UNLIKELY for one in found)

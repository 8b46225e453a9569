"""Fits that converge with a fine χ² and are wrong: what the residuals say against them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import numpy as np
import pytest
from changed_sets import block_of, with_block
from hypothesis import given
from hypothesis import strategies as st
from quick import quick
from scipy import stats
from small_run import SMALL

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet, FineStructure
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.score import Projector
from walop_jax.diagnosis.trust import examined, group_scores
from walop_jax.fit import refit as fitting
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import Doubt, Quality, Verdict
from walop_jax.model.noise import with_noise
from walop_jax.posterior.sampling import sample
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import effect_from_text, simulate


def refit(calset: CalibrationSet) -> FitResult:
    """A fit, and what its residuals say against it."""
    return examined(fitting.refit(calset))


def background(calset: CalibrationSet) -> CalibrationSet:
    """2000 electrons that nobody has taken away."""
    return with_block(calset, counts=block_of(calset).counts + 2000.0)


def displaced(calset: CalibrationSet) -> CalibrationSet:
    """The centre of the field 36 arcsec from where it is said to be."""
    points = dataclasses.replace(calset.points, x=calset.points.x + 0.01)
    return with_block(dataclasses.replace(calset, points=points), x=points.x)


def dark(calset: CalibrationSet) -> CalibrationSet:
    """One camera behind a closed shutter: nothing but read noise."""
    counts = block_of(calset).counts.copy()
    counts[..., 2] = np.random.default_rng(3).normal(5.0, 2.0, counts.shape[:-1])
    return with_block(calset, counts=counts)


def variances(calset: CalibrationSet) -> CalibrationSet:
    """The variance where the standard error belongs."""
    return with_block(calset, sigma=block_of(calset).sigma ** 2)


def noisy_camera(calset: CalibrationSet) -> CalibrationSet:
    """One camera of half the stated errors, another of more, so that χ² of all is what it should be."""
    seen = block_of(calset)
    sigma = seen.sigma.copy()
    sigma[..., 0] *= 2.0
    sigma[..., 1] /= np.sqrt(4.0 / 3.0)
    sigma[..., 3] /= np.sqrt(4.0 / 3.0)
    sigma[..., 2] /= np.sqrt(4.0 / 3.0)
    return with_block(calset, sigma=sigma)


@pytest.fixture(scope="module")
def calset() -> CalibrationSet:
    return simulate(SMALL, seed=7).calset


@pytest.fixture(scope="module")
def plain(calset) -> FitResult:
    return fitting.refit(calset)


@pytest.fixture(scope="module")
def clean(plain) -> FitResult:
    return examined(plain)


def test_a_fit_of_what_the_model_describes_is_trusted(clean):
    assert clean.trusted
    assert clean.verdict == dataclasses.replace(clean.verdict, doubts=())


@pytest.mark.long
def test_a_lamp_of_another_temperature(calset):
    """3200 K given as 5772 K: χ²/dof stays at 1, the matrix is off by half a per cent."""
    plan = dataclasses.replace(SMALL, teff=3200.0)
    warm = simulate(plan, seed=7).calset
    said = np.where(warm.exposures.kind == "clp", 5772.0, warm.exposures.teff)
    found = refit(dataclasses.replace(warm, exposures=dataclasses.replace(warm.exposures, teff=said)))
    assert found.explains_data
    assert not found.trusted
    assert "TEFF of exposures of kind clp" in found.verdict.residual_doubts[0]


MISTAKES = {
    background: "does not explain the data",
    displaced: "the residuals ask for X of all field points changed by −0.01",
    dark: "camera O2",
    variances: "N_ERR is not the standard error",
    noisy_camera: "camera",
}


@pytest.mark.parametrize("mistake", quick(MISTAKES, [displaced, variances]))
def test_a_mistake_in_the_data_is_not_trusted(calset, mistake: Callable[[CalibrationSet], CalibrationSet]):
    found, says = refit(mistake(calset)), MISTAKES[mistake]
    assert found.converged
    assert not found.trusted
    assert says in "; ".join(found.warnings)
    verdict = Calibration.from_fit(found).verdict
    assert not verdict.trusted
    assert verdict.warnings == found.warnings
    if says != "does not explain the data":
        assert Quality.DOUBTED in Quality(verdict.quality)


def test_chi2_a_few_per_cent_too_large_is_trusted_only_without_doubts(clean):
    """10⁴ degrees of freedom: χ²/dof = 1.1 is 7 standard deviations, 1.2 more than errors are put down to."""

    def found(ratio: float, *doubts: str) -> FitResult:
        data = 1e4 * ratio - (clean.chi2 - clean.expansion.data)
        expansion = dataclasses.replace(clean.expansion, data=data, dof=10_000)
        return dataclasses.replace(clean, expansion=expansion).with_verdict(doubts)

    assert found(1.1).chi2 == pytest.approx(11_000)
    cases = [
        (found(1.0), (True, True)),
        (found(1.1), (False, True)),
        (found(1.1, "a camera"), (False, False)),
        (found(1.2), (False, False)),
    ]
    for one, expected in cases:
        assert (one.explains_data, one.trusted) == expected


def test_a_fit_that_nobody_examined_has_no_verdict(clean):
    """It can neither be asked for trust nor written; a fit with other errors is to be examined anew."""
    unexamined = dataclasses.replace(clean, verdict=None)
    assert "not examined" in repr(unexamined)
    for ask in (
        lambda: unexamined.trusted,
        lambda: Calibration.from_fit(unexamined),
        lambda: sample(unexamined),
    ):
        with pytest.raises(RuntimeError, match=r"call walop_jax\.diagnosis\.trust\.examined"):
            ask()


@given(st.lists(st.builds(Doubt, st.sampled_from(Quality), st.text(max_size=5), st.booleans())), st.data())
def test_adding_a_doubt_never_makes_trusted(doubts, data):
    """Bits and sentences only grow, a verdict that is not trusted stays so, and a file gives the same."""
    verdict = Verdict(1.0, 1, 16, 1.0, converged=True, doubts=tuple(doubts))
    more = data.draw(st.builds(Doubt, st.sampled_from(Quality), st.text(max_size=5), st.booleans()))
    worse = dataclasses.replace(verdict, doubts=(*doubts, more))
    assert worse.trusted <= verdict.trusted
    assert worse.trusted == (verdict.trusted and not more.blocking)
    assert worse.quality == verdict.quality | more.bit
    assert set(verdict.warnings) <= set(worse.warnings)
    again = Verdict.recorded(
        chi2=1.0,
        dof=1,
        n_data=16,
        noise_scale=1.0,
        converged=True,
        trusted=worse.trusted,
        quality=int(worse.quality),
        warnings=worse.warnings,
    )
    assert (again.trusted, again.quality, again.warnings) == (worse.trusted, worse.quality, worse.warnings)


@pytest.mark.long
def test_errors_a_few_per_cent_off_are_no_matter_of_the_model():
    """On a set so large that χ² shows it."""
    calset = simulate(ObservingPlan(grid=8), seed=7).calset
    clean = refit(calset)
    found = refit(with_block(calset, sigma=0.93 * block_of(calset).sigma))
    assert not found.explains_data
    assert found.trusted
    assert found.verdict.residual_doubts == ()
    assert "% too small" in found.warnings[0]
    ratio = np.median(found.sigma[found.sigma > 0] / clean.sigma[clean.sigma > 0])
    assert 1.0 < ratio < 1.5


def test_structure_finer_than_the_cells_of_frames_is_told_and_in_the_errors_of_stars(calset, clean):
    """A wave of a few pixels, 0.08 % everywhere, is in no field point: only the set says so."""
    gain = 8e-4
    fine = FineStructure(np.zeros(9), np.arange(9.0), np.full((9, 4), gain**2), np.full((9, 4), 1e-8))
    found = refit(dataclasses.replace(calset, fine=fine))
    assert clean.trusted
    assert not found.trusted
    told = "residuals of the same pixel agree between exposures: structure of 0.0008, finer than the cells"
    assert any(text.startswith(told) for text in found.verdict.residual_doubts)
    assert found.verdict.structure.gain == pytest.approx(gain)
    made = Calibration.from_fit(found).matrix(np.array([0.1]), np.array([0.1]))[1]
    assert np.sqrt(made[0, 0, 0]) > 0.6 * gain  # (N₁ − N₂)/(N₁ + N₂) of gains that differ by √2 of it


def test_squares_of_groups_follow_their_distribution(south_set, south_fit):
    """Over draws of noise the p of every group is uniform: its moments are those of projected noise."""
    design = Design.of(south_fit(south_set("a")))
    rng, p = np.random.default_rng(3), []
    used = design.measured.used
    unit = design.measured.model[used]
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    for _ in range(40):
        noise = rng.normal(size=unit.shape)
        noise -= np.sum(noise * unit, axis=1, keepdims=True) * unit
        rows = design.residual.copy()
        rows[: design.rows] = noise.reshape(-1)
        rows[design.rows :] = rng.normal(size=len(rows) - design.rows)
        p += [(s.name, s.p_value) for s in group_scores(dataclasses.replace(design, residual=rows))]
    for kind in ("camera", "exposure"):
        assert stats.kstest([v for name, v in p if name.startswith(kind)], "uniform").pvalue > 1e-3
    # One that scatters less than the rest is as improbable as one that scatters more.
    for factor in (0.5, 2.0):
        rows[: design.rows] = (noise * np.where(np.arange(noise.shape[1]) == 0, factor, 1.0)).reshape(-1)
        first = group_scores(dataclasses.replace(design, residual=rows))[0]
        assert first.name.startswith("camera")
        assert first.p_value < 1e-9
        assert (first.ratio < 1.0) is (factor < 1.0)


def test_squares_of_an_exposure_are_compared_with_the_rest_as_in_an_f_test(plain):
    """Four cameras with one flux leave three independent data: the ratio of variances then follows F (scipy)."""
    design = Design.of(plain)
    nothing = Projector(np.zeros((len(design.residual), 0)))  # no parameter was fitted
    used, cameras = design.measured.used, design.measured.cameras
    unit = design.measured.model[used]
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    noise = np.random.default_rng(5).normal(size=unit.shape)
    noise -= np.sum(noise * unit, axis=1, keepdims=True) * unit
    exposure = np.nonzero(used)[1]
    count = (cameras - 1) * np.array([np.sum(exposure == 0), np.sum(exposure != 0)])
    square = [np.sum(noise[exposure == 0] ** 2), np.sum(noise[exposure != 0] ** 2)]
    for ratio in (0.75, 0.9, 1.1, 1.3):
        factor = np.sqrt(ratio * square[1] / square[0] * count[0] / count[1])
        rows = np.zeros_like(design.residual)
        rows[: design.rows] = (noise * np.where(exposure == 0, factor, 1.0)[:, None]).reshape(-1)
        drawn = dataclasses.replace(design, residual=rows)
        vars(drawn)["projector"] = nothing
        found = {score.name: score for score in group_scores(drawn)}
        score = found[f"exposure {plain.calset.exposures.exposure[0]}"]
        assert score.ratio == pytest.approx(ratio)
        above = stats.f(*count).sf(ratio)
        assert score.p_value == pytest.approx(2.0 * min(above, 1.0 - above), abs=0.01)


def test_an_examination_changes_no_value(plain, clean):
    np.testing.assert_array_equal(clean.values, plain.values)
    np.testing.assert_array_equal(clean.covariance, plain.covariance)


def test_a_plan_without_noise_is_not_held_against_its_errors(clean):
    found = refit(simulate(SMALL, seed=7, noiseless=True).calset)
    assert (found.trusted, found.warnings) == (True, ())
    np.testing.assert_allclose(found.sigma[found.sigma > 0], clean.sigma[clean.sigma > 0], rtol=0.1)


def test_fitted_errors_that_take_a_misfit_for_noise_are_not_trusted():
    """Light of a camera in another one, ten times the usual share: the errors are fitted as tens of N_ERR."""
    calset = simulate(
        SMALL, seed=6001, effects=[effect_from_text("camera_leakage=0.02", SMALL.context())]
    ).calset
    found = examined(fitting.refit(calset, with_noise(base_model(calset), scale="all")))
    assert not found.trusted
    said = str(found.verdict)
    assert re.search(r"the errors are fitted as \d{2}(\.\d)? times N_ERR \(noise\.scale\)", said)

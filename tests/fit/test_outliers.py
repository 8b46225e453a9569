"""Outliers that are put in by hand come out, and nothing else does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from quick import quick
from small_run import SEED, SMALL, small_fit

from walop_jax.commands.clip import clip
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import CalibrationSet, DataFlag
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.misfit import describe
from walop_jax.fit.outliers import clipped, outlying
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate


@pytest.fixture(scope="module")
def clean() -> CalibrationSet:
    return simulate(SMALL, seed=SEED).calset


def with_hits(calset: CalibrationSet, share: float, size: float) -> tuple[CalibrationSet, np.ndarray]:
    """The set with light of up to `size` standard errors in one camera of so many rows, and which."""
    table, rng = TableIntensities.of(calset.intensities, calset.points), np.random.default_rng(11)
    hit = rng.permutation(len(table.used)) < round(share * len(table.used))
    counts = table.counts.copy()
    camera = rng.integers(0, 4, hit.sum())
    counts[hit, camera] += rng.uniform(12.0, size, hit.sum()) * table.sigma[hit, camera]
    spoilt = TableIntensities.dense(calset.points, calset.intensities.block(0, len(calset.points)))
    spoilt.counts[:] = counts
    return dataclasses.replace(calset, intensities=spoilt), hit


@pytest.mark.parametrize("size", quick([20.0, 2000.0], [2000.0]))
def test_cosmic_rays_are_flagged_and_nothing_else(clean, size):
    """Also where they are so many standard errors large that the first fit is bent by them beyond recognition."""
    calset, hit = with_hits(clean, 0.02, size)
    found = clipped(calset)
    flagged = found.calset.intensities.flag
    np.testing.assert_array_equal(flagged, np.where(hit, int(DataFlag.BAD_PIXEL), 0))
    assert (found.rows, found.too_many) == (hit.sum(), False)
    assert found.result.converged
    assert found.result.explains_data
    # What is left is the fit of the good rows alone, by hand.
    rows = found.calset.intensities
    alone = fit(Likelihood.of(dataclasses.replace(calset, intensities=rows.using(~hit)), found.result.model))
    np.testing.assert_allclose(found.result.values, alone.values, rtol=0, atol=1e-3 * np.max(alone.sigma))


def test_nothing_of_noise_is_flagged():
    result = small_fit()
    assert not outlying(result.likelihood, result.likelihood.residuals(result.values)[1]).any()
    with pytest.raises(ValueError, match="at least 3"):
        clipped(small_fit().calset, beyond=2.5)


def test_many_are_no_outliers(clean):
    calset, _ = with_hits(clean, 0.15, 60.0)
    assert clipped(calset).too_many


def test_cameras_that_are_exchanged_are_no_outliers(clean):
    """All rows lie off alike: nothing is flagged for ever, and the fit says that it explains nothing."""
    table = TableIntensities.of(clean.intensities, clean.points)
    order = [1, 0, 2, 3]
    swapped = TableIntensities.dense(clean.points, clean.intensities.block(0, len(clean.points)))
    swapped.counts[:], swapped.sigma[:] = table.counts[:, order], table.sigma[:, order]
    found = clipped(dataclasses.replace(clean, intensities=swapped))
    verdict = found.result.judged().verdict
    assert not verdict.trusted
    assert any("the fit is poor" in text for text in verdict.warnings)


def test_a_fit_tells_that_there_are_some(clean):
    calset, hit = with_hits(clean, 0.02, 30.0)
    misfit = describe(fit(Likelihood.of(calset, small_fit().model)))
    assert misfit.outliers == pytest.approx(hit.mean(), rel=0.2)
    assert "walop-jax clip flags them" in misfit.sentences()[0]


def test_the_file_holds_the_same_rows_and_the_flags(clean, tmp_path):
    calset, hit = with_hits(clean, 0.01, 50.0)
    write_calibration_set(tmp_path / "set.fits", calset)
    found = clip(tmp_path / "set.fits", output=tmp_path / "clean.fits")
    with fits.open(tmp_path / "set.fits") as before, fits.open(tmp_path / "clean.fits") as after:
        one, other = before["INTENSITIES"].data, after["INTENSITIES"].data
        for name in one.names:
            if name != "FLAG":
                np.testing.assert_array_equal(one[name], other[name])
        np.testing.assert_array_equal(other["FLAG"] == DataFlag.BAD_PIXEL, hit)
    assert (
        read_calibration_set(tmp_path / "clean.fits").intensities.rows
        == (~hit).sum()
        == found.used - found.rows
    )
    with pytest.raises(DataError, match="exists already"):
        clip(tmp_path / "set.fits", output=tmp_path / "clean.fits")

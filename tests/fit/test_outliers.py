"""Outliers that are put in by hand come out, and nothing else does."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from astropy.table import Table
from quick import quick
from small_run import SEED, SMALL, small_fit

import walop_jax as walop
from walop_jax.data.clipped import Clipped, read_clipped
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
    assert found.converged
    assert found.explains_data
    # What is left is the fit of the good rows alone, by hand.
    rows = found.calset.intensities
    alone = fit(Likelihood.of(dataclasses.replace(calset, intensities=rows.using(~hit)), found.model))
    np.testing.assert_allclose(found.values, alone.values, rtol=0, atol=1e-3 * np.max(alone.sigma))


def test_rows_that_are_left_out_are_listed_with_camera_and_distance(clean):
    """Light of known size in a known camera: it is that far from the fit, in standard errors of that intensity."""
    table = TableIntensities.of(clean.intensities, clean.points)
    row, camera, size = 7, 2, 40.0
    table = dataclasses.replace(table, counts=table.counts.copy())
    table.counts[row, camera] += size * table.sigma[row, camera]
    found = clipped(dataclasses.replace(clean, intensities=table))
    listed = found.clipped
    assert listed is not None
    assert (len(listed), listed.used, listed.sigma) == (1, int(table.used.sum()), 5.0)
    assert listed.exposure.tolist() == [clean.exposures.exposure[table.exposure[row]]]
    assert listed.point.tolist() == [clean.points.point[table.point[row]]]
    assert listed.camera.tolist() == [camera]
    # The flux takes up a share of the hit, that of (N/σ)² of its camera; √(3/4) is the standard deviation of a residual
    # of noise. The noise of the intensity itself adds to it.
    light = (clean.intensities.counts[row] / table.sigma[row]) ** 2
    expected = size * (1.0 - light[camera] / light.sum()) / 0.75**0.5
    assert listed.distance[0] == pytest.approx(expected, abs=3.0)
    assert "1 of " in str(listed)
    assert "more than 5 standard errors off, are left out" in found.display().text()


def test_nothing_of_noise_is_flagged():
    result = small_fit()
    assert not outlying(result.likelihood, result.likelihood.residuals(result.values)[1]).any()
    with pytest.raises(ValueError, match="at least 3"):
        clipped(small_fit().calset, beyond=2.5)


def test_many_are_no_outliers(clean):
    calset, _ = with_hits(clean, 0.15, 60.0)
    with pytest.raises(
        DataError, match=r"in memory: more than 5 % of the rows .*walop-jax diagnose looks for it"
    ):
        clipped(calset)


def test_cameras_that_are_exchanged_are_no_outliers(clean):
    """All rows lie off alike: nothing is flagged for ever, and the fit says that it explains nothing."""
    table = TableIntensities.of(clean.intensities, clean.points)
    order = [1, 0, 2, 3]
    swapped = TableIntensities.dense(clean.points, clean.intensities.block(0, len(clean.points)))
    swapped.counts[:], swapped.sigma[:] = table.counts[:, order], table.sigma[:, order]
    found = clipped(dataclasses.replace(clean, intensities=swapped))
    verdict = found.with_verdict().verdict
    assert not verdict.trusted
    assert any("the fit is poor" in text for text in verdict.warnings)


def test_a_fit_tells_that_there_are_some(clean):
    calset, hit = with_hits(clean, 0.02, 30.0)
    misfit = describe(fit(Likelihood.of(calset, small_fit().model)))
    assert misfit.outliers == pytest.approx(hit.mean(), rel=0.2)
    assert "% of the rows lie more than 5 standard errors off" in misfit.sentences()[-1]


@pytest.fixture(scope="module")
def spoilt_run(clean, tmp_path_factory):
    """A set with hits, and the run of its fit without them."""
    folder = tmp_path_factory.mktemp("clipped")
    calset, hit = with_hits(clean, 0.01, 50.0)
    write_calibration_set(folder / "set.fits", calset)
    result = walop.refit(folder / "set.fits", clip=5.0, output=folder / "RUN")
    return folder, calset, hit, result


def test_a_run_lists_the_rows_and_is_read_without_them(spoilt_run):
    folder, calset, hit, result = spoilt_run
    table = TableIntensities.of(calset.intensities, calset.points)
    asked = np.stack([calset.exposures.exposure[table.exposure], calset.points.point[table.point]], axis=1)[
        hit
    ]
    listed = Table.read(folder / "RUN" / "clipped.ecsv")
    assert sorted(zip(listed["EXPOSURE"], listed["POINT"], strict=True)) == sorted(map(tuple, asked.tolist()))
    assert set(listed["KIND"]) <= set(calset.exposures.kind)
    assert set(listed["CAMERA"]) <= {"O1", "E1", "O2", "E2"}
    assert listed["DISTANCE"].min() > 5.0
    document = json.loads((folder / "RUN" / "summary.json").read_text(encoding="utf-8"))
    assert document["clipped"] == {"sigma": 5.0, "rows": int(hit.sum()), "used": len(hit)}
    assert document["n_data"] == result.n_data == 4 * (~hit).sum()
    # Whoever asks the run for its data gets those of the fit.
    run = walop.read(folder / "RUN")
    np.testing.assert_array_equal(run.calset.intensities.used, ~hit)
    np.testing.assert_allclose(run.fit().values, result.values, rtol=0, atol=0.05 * np.max(result.sigma))


def test_a_run_that_is_made_anew_without_clipping_forgets_the_rows(spoilt_run, tmp_path):
    """Of the program and of `save`: an old list would be taken for that of the new fit."""
    _, _, _, result = spoilt_run
    result.save(tmp_path / "RUN")
    assert len(Table.read(tmp_path / "RUN" / "clipped.ecsv")) == len(result.clipped)
    small_fit().with_verdict().save(tmp_path / "RUN", overwrite=True)
    assert not (tmp_path / "RUN" / "clipped.ecsv").exists()


def test_a_list_by_hand_is_read_back_and_flags_its_rows(clean, tmp_path):
    """Two rows of the first field point; one that the set lacks, and a file that is no list, are refused."""
    table = TableIntensities.of(clean.intensities, clean.points)
    rows = np.flatnonzero(table.point == 0)[[1, 2]]
    exposures = clean.exposures.exposure[table.exposure[rows]]
    point = np.repeat(clean.points.point[0], 2)
    made = Clipped(4.5, len(table.used), exposures, point, np.array([3, 0]), np.array([9.5, 7.25]))
    made.write(tmp_path / "clipped.ecsv", clean, ("O1", "E1", "O2", "E2"))
    listed = Table.read(tmp_path / "clipped.ecsv")
    assert listed["CAMERA"].tolist() == ["E2", "O1"]
    assert listed["X"].tolist() == [clean.points.x[0]] * 2
    assert listed["X"].unit == "deg"
    again = read_clipped(tmp_path / "clipped.ecsv")
    assert again.document() == {"sigma": 4.5, "rows": 2, "used": len(table.used)}
    flags = again.taken_from(clean).intensities.flag
    assert np.flatnonzero(flags).tolist() == rows.tolist()
    with pytest.raises(ValueError, match=r"^1 of 2 rows are not in the calibration set$"):
        dataclasses.replace(again, point=np.array([point[0], 9999])).taken_from(clean)
    (tmp_path / "clipped.ecsv").write_text("EXPOSURE,POINT\n1,2\n")
    with pytest.raises(DataError, match=r"clipped\.ecsv: cannot be read as a list of rows.*--clip again"):
        read_clipped(tmp_path / "clipped.ecsv")

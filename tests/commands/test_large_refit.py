"""`refit` of whole frames, read as cells: residual map, number of cells; and what a large set is refused for."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from frame_run import frame_run, raster
from frames_file import write_frames

import walop_jax as walop
from walop_jax.calibration.matrix import residual_names
from walop_jax.likelihood import limits
from walop_jax.simulation.simulate import simulate

SIDE = 72
RUN = frame_run(SIDE)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Frames in cells of 24 × 24, fitted, and the folder of the run."""
    folder = tmp_path_factory.mktemp("runs")
    write_frames(folder / "frames.fits", simulate(RUN, seed=6).calset, raster(RUN, SIDE), dtype="f8")
    return walop.refit(folder / "frames.fits", cells=24, output=folder / "whole"), folder / "whole"


def test_the_calibration_carries_a_residual_map(finished):
    """One cell for each block of 4 × 4 field points: 24 × 24 of them are 6 × 6."""
    result, folder = finished
    assert sorted(entry.name for entry in folder.iterdir()) == ["calibration.fits", "summary.json"]
    assert len(result.calset.points) == 24**2
    assert result.trusted
    residuals = walop.read(folder / "calibration.fits").residuals
    assert residuals.values.shape == (len(residual_names(2)), 6, 6)
    # Nothing is hidden in this set.
    assert abs(residuals.significance()) < 5
    np.testing.assert_allclose(residuals.chi2, 1.0, atol=6 * np.sqrt(2 / (16 * 8 * 3)))
    with fits.open(folder / "calibration.fits") as hdus:
        header = hdus["RESIDUAL"].header
        assert [header[f"PLANE{n}"] for n in range(1, 8)] == list(residual_names(2))
        assert header["CTYPE1"] == "X"


@pytest.mark.long
def test_sampling_so_many_points_is_refused_with_advice(call, finished, monkeypatch):
    monkeypatch.setattr(limits, "LARGE_ABOVE", 0)
    monkeypatch.setattr(limits, "INTERPOLATE_ABOVE", 0)
    result = call("sample", finished[1])
    assert result.exit_code == 1
    assert "calibration.fits holds its covariance" in result.stderr

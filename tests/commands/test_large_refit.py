"""`refit` of frames that are handled like those of whole detectors: residual map, memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits
from frame_run import raster
from frames_file import write_frames

from walop_jax.calibration.matrix import residual_names
from walop_jax.calibration.product import read_calibration
from walop_jax.likelihood import limits
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

SIDE = 72
RUN = ObservingPlan(
    grid=SIDE, standard_grid=1, standards=0, unpolarised=0, moon_patches=3, polariser_angles=polariser_turn(6)
)  # fmt: skip
# A command in another process, with sets large from the first point on and slabs of 256 points.
LARGE = """
import sys
from walop_jax.likelihood import limits
limits.LARGE_ABOVE, limits.LARGE_BATCH, limits.SAMPLE = 0, 256, 1024
from walop_jax.commands import main
main()
"""


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "frames.fits"
    write_frames(path, simulate(RUN, seed=6).calset, raster(RUN, SIDE), dtype="f8")
    return path


@pytest.fixture(scope="module")
def finished(frames, tmp_path_factory):
    """A run in a process of its own."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    command = [sys.executable, "-c", LARGE, "refit", str(frames), "-o", str(folder), "--json"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


@pytest.mark.long
def test_the_calibration_carries_a_residual_map(finished):
    folder, summary = finished
    assert sorted(entry.name for entry in folder.iterdir()) == ["calibration.fits", "summary.json"]
    assert summary["converged"]
    residuals = read_calibration(folder / "calibration.fits", any_model=True).residuals
    assert summary["residual_map"]["cells"] == [9, 9]
    assert residuals.values.shape == (len(residual_names(2)), 9, 9)
    # Nothing is hidden in this set.
    assert abs(summary["residual_map"]["significance"]) < 5
    assert summary["residual_map"]["significance"] == pytest.approx(residuals.significance())
    np.testing.assert_allclose(residuals.chi2, 1.0, atol=6 * np.sqrt(2 / (64 * 9 * 3)))
    with fits.open(folder / "calibration.fits") as hdus:
        header = hdus["RESIDUAL"].header
        assert [header[f"PLANE{n}"] for n in range(1, 8)] == list(residual_names(2))
        assert header["CTYPE1"] == "X"
        # The centre of the first cell of eight pixels, by the coordinates of the header.
        first = header["CRVAL1"] + (1 - header["CRPIX1"]) * header["CD1_1"]
        assert first == pytest.approx(-RUN.field + 3.5 * 2 * RUN.field / (SIDE - 1))
    # Passes over all pixels: from the minimum of a sample, and another where that led.
    assert summary["steps"] <= 3


@pytest.mark.long
def test_sampling_so_many_points_is_refused_with_advice(call, finished, monkeypatch):
    monkeypatch.setattr(limits, "LARGE_ABOVE", 0)
    monkeypatch.setattr(limits, "INTERPOLATE_ABOVE", 0)
    result = call("sample", finished[0])
    assert result.exit_code == 1
    assert "calibration.fits holds its covariance" in result.stderr

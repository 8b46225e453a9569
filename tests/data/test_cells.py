"""Whole frames as cells: values and errors of their points, bad pixels, structure that is finer."""

from __future__ import annotations

import dataclasses
import json
import tracemalloc

import numpy as np
import pytest
from astropy.io import fits
from changed_sets import with_block
from frame_run import frame_run, raster
from frames_file import write_frames

import walop_jax as walop
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import write_calibration
from walop_jax.calibration.summary import summary
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.cells import ORDER
from walop_jax.data.grid import Grid
from walop_jax.data.records import FineStructure
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate

WIDTH, HEIGHT = 90, 60
GRID = Grid(WIDTH, HEIGHT, (45.0, 30.0), (0.0, 0.0), ((0.005, 0.0), (0.0, 0.005)))
CELLS = 40
ANGLES = np.linspace(0.0, 162.0, 10).tolist()


def shares(x, y, degree=3):
    """Shares of the light (point, exposure, camera) in four cameras, polynomials over the field, and their sum is 1."""
    angle, slope = (
        np.radians(2.0 * np.array(ANGLES)),
        1.0 + 0.3 * (3.0 * x) ** degree - 0.5 * (4.0 * y) ** degree,
    )
    first = 0.25 * (1.0 + 0.6 * np.cos(angle) * slope[:, None])
    second = 0.25 * (1.0 + 0.6 * np.sin(angle) * (1.0 + x - y)[:, None])
    return np.stack([first, 0.5 - first, second, 0.5 - second], axis=-1)


def light(rng=None):
    """Light of the pixels in each exposure, with a gradient, and rough from pixel to pixel where there is an `rng`."""
    x, y = GRID.xy(0, GRID.pixels)
    rough = 1.0 if rng is None else rng.uniform(0.5, 1.5, (GRID.pixels, 1))
    return 1e5 * (1.0 + x - y)[:, None] * rough * np.linspace(0.7, 1.0, len(ANGLES))


def written(path, counts, errors=None, change=None):
    """Frames of counts (pixel, exposure, camera), read back."""
    errors = np.sqrt(np.abs(counts) + 1.0) if errors is None else errors
    calset = walop.from_arrays(counts, errors, *GRID.xy(0, GRID.pixels), ANGLES)
    write_frames(path, calset, GRID, dtype="f8")
    if change is not None:
        with fits.open(path, memmap=False) as hdus:
            change(hdus)
            for hdu in hdus:
                for key in ("DATASUM", "CHECKSUM"):
                    hdu.header.remove(key, ignore_missing=True)
            hdus.writeto(path, overwrite=True)
    return path


def in_cells(path):
    """Frames in so few cells that each has some pixels."""
    return read_calibration_set(path, cells=CELLS)


def block_of(calset):
    return calset.intensities.block(0, len(calset.points))


def shares_of(block):
    return block.counts / block.counts.sum(axis=-1, keepdims=True)


def test_points_are_the_polynomials_of_the_pixels_however_rough_the_light(tmp_path):
    counts = light(np.random.default_rng(1))[..., None] * shares(*GRID.xy(0, GRID.pixels))
    calset = in_cells(written(tmp_path / "frames.fits", counts))
    assert len(calset.points) == CELLS * round(CELLS * HEIGHT / WIDTH / ORDER + 0.2) * ORDER
    block = block_of(calset)
    assert block.used.all()
    np.testing.assert_allclose(shares_of(block), shares(block.x, block.y), rtol=1e-9)
    assert any(f"have become {len(calset.points)} field points" in remark for remark in calset.remarks)


def test_errors_hold_the_information_of_all_pixels(tmp_path):
    """Each pixel has the error 7: Σ 1/σ² over the points is that of the pixels, and errors are those of noise."""
    rng, expected = np.random.default_rng(2), np.full((GRID.pixels, len(ANGLES), 4), 2.5e4)
    expected *= np.linspace(0.9, 1.1, len(ANGLES))[:, None]
    errors = np.full(expected.shape, 7.0)
    block = block_of(
        read_calibration_set(
            written(tmp_path / "f.fits", expected + 7.0 * rng.standard_normal(expected.shape), errors)
        )
    )
    np.testing.assert_allclose((1.0 / block.sigma**2).sum(axis=0), GRID.pixels / 49.0, rtol=1e-3)
    deviates = (block.counts - expected[0]) / block.sigma
    # The light is the sum of the cameras, so that each keeps its own noise.
    assert deviates.std() == pytest.approx(1.0, abs=6 / np.sqrt(2 * deviates.size / 4))
    neighbours = np.corrcoef(deviates[:-1, :, 0].ravel(), deviates[1:, :, 0].ravel())[0, 1]
    assert abs(neighbours) < 6 / np.sqrt(deviates[:, :, 0].size)


def test_errors_that_know_the_noise_bias_nothing(tmp_path):
    """100 electrons with errors √N: weights 1/σ² would give 99. The mean of all is right to 0.025."""
    rng = np.random.default_rng(3)
    counts = rng.poisson(100.0, (GRID.pixels, len(ANGLES), 4)).astype(float)
    block = block_of(in_cells(written(tmp_path / "frames.fits", counts, np.sqrt(np.maximum(counts, 1.0)))))
    mean = np.sum(block.counts / block.sigma**2) / np.sum(1.0 / block.sigma**2)
    assert mean == pytest.approx(100.0, abs=0.2)


@pytest.mark.parametrize("cells", [20, 60])
def test_the_user_says_how_many(tmp_path, cells):
    path = written(tmp_path / "frames.fits", light()[..., None] * shares(*GRID.xy(0, GRID.pixels)))
    calset = walop.read(path, cells=cells)
    assert len(np.unique(calset.points.x)) == cells


def test_bad_pixels_leave_the_others_as_they_are(tmp_path):
    """NaN, saturated with a flag, far below zero, and marked by a huge error: in one camera, of a few exposures."""

    def spoil(hdus):
        hdus["N0"].data[1, 3, 4:9] = np.nan
        hdus["N2"].data[0, 10:13, 50] = 6e4
        hdus["FLAG"].data[0, 10:13, 50] = 1
        hdus["N3"].data[2, 40, 40] = -1e6
        hdus["N1"].data[3, 20:22, 20:22], hdus["E1"].data[3, 20:22, 20:22] = 0.0, 1e9
        hdus["N1"].data[4, 30], hdus["E1"].data[4, 30] = 1.0, np.inf

    counts = light()[..., None] * shares(*GRID.xy(0, GRID.pixels))
    path = written(tmp_path / "frames.fits", counts, change=spoil)
    calset = in_cells(path)
    block = block_of(calset)
    assert block.used.all()
    np.testing.assert_allclose(shares_of(block), shares(block.x, block.y), rtol=1e-9)
    clean = block_of(in_cells(written(tmp_path / "clean.fits", counts)))
    worse = block.sigma / clean.sigma
    assert worse.min() > 1.0 - 1e-9
    assert worse[:, 4].max() > 1.02
    told = " ".join(calset.remarks)
    for text in (
        "in 96 pixel(s), not used; the first: plane 1, row 3, column 4",
        "a mark of bad pixels",
        "[FLAG]",
    ):
        assert text in told


def test_a_round_field_keeps_points_where_there_are_pixels(tmp_path):
    x, y = GRID.xy(0, GRID.pixels)
    outside = np.hypot(x / 0.22, y / 0.14).reshape(HEIGHT, WIDTH) > 1.0

    def vignetted(hdus):
        hdus["FLAG"].data[:, outside] = 4
        hdus["N0"].data[:, outside] = 0.0

    counts = light()[..., None] * shares(x, y, degree=1)
    path = written(tmp_path / "frames.fits", counts, change=vignetted)
    block = block_of(in_cells(path))
    assert 300 < len(block.x) < CELLS**2 * HEIGHT / WIDTH
    assert block.used.all()
    assert np.hypot(block.x / 0.22, block.y / 0.14).max() < 1.05
    np.testing.assert_allclose(shares_of(block), shares(block.x, block.y, degree=1), rtol=1e-9)
    used = int((~outside).sum())
    information = (block.counts / block.sigma**2).sum(axis=0) / (1e5 * 0.25 * used / 2.5e4)
    assert 0.7 < information.min() < information.max() < 1.15


# ---------------------------------------------------------------------------------------------- structure within


def small():
    """Two points in ten exposures."""
    counts = np.arange(80.0).reshape(2, 10, 4) + 9.0
    return walop.from_arrays(counts, np.full(counts.shape, 3.0), [0, 0.1], [0, 0], ANGLES)


def noisy(rng, gains):
    counts = light()[..., None] * shares(*GRID.xy(0, GRID.pixels), degree=1)
    return rng.normal(counts * gains[:, None], np.sqrt(counts))


def test_noise_has_no_structure(tmp_path):
    counts = noisy(np.random.default_rng(4), np.ones((GRID.pixels, 4)))
    fine = in_cells(written(tmp_path / "frames.fits", counts, 0.8 * np.sqrt(counts))).fine
    deviates = fine.gain / fine.error
    assert np.std(deviates) == pytest.approx(1.0, abs=0.15)
    assert fine.everywhere == 0.0
    assert len(fine.spots) == 0


def test_a_wave_of_five_pixels_is_found_with_its_size(tmp_path):
    """Gains of 0.5 % sin(2π column/5), 0.35 % rms, half of the noise of the means of all exposures."""
    phase = 2 * np.pi * (np.arange(GRID.pixels) % WIDTH)[:, None] / 5 + np.arange(4)
    counts = noisy(np.random.default_rng(5), 1.0 + 5e-3 * np.sin(phase))
    fine = in_cells(written(tmp_path / "frames.fits", counts)).fine
    assert fine.everywhere == pytest.approx(5e-3 / np.sqrt(2.0), rel=0.15)


def test_a_spot_of_dust_is_named_with_its_place_and_camera(tmp_path):
    """Six per cent less in nine pixels of camera 2: lost in the mean of a cell, and not all over the field."""
    gains = np.ones((HEIGHT, WIDTH, 4))
    gains[20:23, 61:64, 2] = 0.94
    path = written(tmp_path / "frames.fits", noisy(np.random.default_rng(6), gains.reshape(-1, 4)))
    calset = in_cells(path)
    patch, camera = calset.fine.spots[0]
    x, y = GRID.at(np.array([62.0]), np.array([21.0]))
    assert camera == 2
    assert np.hypot(calset.fine.x[patch] - x, calset.fine.y[patch] - y)[0] < 0.02
    assert calset.fine.everywhere == 0.0
    (told,) = (remark for remark in calset.remarks if "their surroundings" in remark)
    assert f"[N2]: pixels near X = {calset.fine.x[patch]:.4f}" in told
    # Its pixels are left out: what the points say is noise about the truth, also beside the spot.
    block = block_of(calset)
    expected = shares(block.x, block.y, degree=1) * block.counts.sum(axis=-1, keepdims=True)
    assert np.abs((block.counts - expected) / block.sigma).max() < 6.0
    assert any("lie in spots of the field" in remark for remark in calset.remarks)
    # Written as a set of its own it says so again, and errors of many pixels are no fault of it.
    walop.write_calibration_set(tmp_path / "cells.fits", calset)
    again = read_calibration_set(tmp_path / "cells.fits")
    np.testing.assert_array_equal(block_of(again).counts, block_of(calset).counts)
    np.testing.assert_array_equal(again.fine.gain, calset.fine.gain)
    assert [remark.partition("]")[2] for remark in again.remarks] == [told.partition("]")[2]]
    assert "times the photon noise" not in str(walop.inspect(again).document())


@pytest.mark.parametrize("lacking", ["GAIN2_ERR", "X"])
def test_a_structure_that_lacks_something_is_refused(tmp_path, lacking):
    fine = FineStructure(np.zeros(3), np.zeros(3), np.full((3, 4), 1e-6), np.full((3, 4), 1e-7))
    made = walop.from_arrays(
        np.arange(80.0).reshape(2, 10, 4) + 9.0, np.full((2, 10, 4), 3.0), [0, 0.1], [0, 0], ANGLES
    )
    walop.write_calibration_set(tmp_path / "set.fits", dataclasses.replace(made, fine=fine))
    with fits.open(tmp_path / "set.fits") as hdus:
        hdus["STRUCTURE"].columns.change_name(lacking, "OTHER")
        for hdu in hdus:
            hdu.add_checksum()
        hdus.writeto(tmp_path / "changed.fits")
    with pytest.raises(DataError, match=f"STRUCTURE.*has no column {lacking}; write the set again"):
        read_calibration_set(tmp_path / "changed.fits")


def test_sets_that_stood_for_pixels_are_refused_with_advice(tmp_path):
    made = walop.from_arrays(
        np.arange(80.0).reshape(2, 10, 4) + 9.0, np.full((2, 10, 4), 3.0), [0, 0.1], [0, 0], ANGLES
    )
    walop.write_calibration_set(tmp_path / "set.fits", made)
    with fits.open(tmp_path / "set.fits") as hdus:
        table = fits.BinTableHDU.from_columns([fits.Column("VALUE", "D", array=[1.0])], name="COMPRESSION")
        fits.HDUList([*hdus, table]).writeto(tmp_path / "compressed.fits")
    with pytest.raises(
        DataError, match=r"\[COMPRESSION\].*no longer read; give the frames of which it was made"
    ):
        read_calibration_set(tmp_path / "compressed.fits")


# ------------------------------------------------------------------------------------------------- beside pixels

SIDE = 72
RUN = frame_run(SIDE)


def test_a_fit_of_the_cells_is_that_of_all_pixels(tmp_path):
    """Values as far from each other as the noise of 0.3 % of the data, errors within 1 %, of smooth light."""
    # Errors without the noise of the counts, which weights 1/σ² of single pixels would take up.
    errors = block_of(simulate(RUN, seed=12, steady=True, noiseless=True).calset).sigma
    made = with_block(simulate(RUN, seed=12, steady=True).calset, sigma=errors)
    write_frames(tmp_path / "frames.fits", made, raster(RUN, SIDE), dtype="f8")
    model = base_model(made, throughput_degree=2)
    cells = in_cells(tmp_path / "frames.fits")
    assert isinstance(cells.intensities, TableIntensities)
    ours, pixels = fit(Likelihood.of(cells, model)), fit(Likelihood.of(made, model, interpolate=True))
    free = pixels.sigma > 0
    moved = (ours.values - pixels.values)[free] / pixels.sigma[free]
    assert np.sqrt(np.mean(moved**2)) < 0.06
    assert np.abs(moved).max() < 0.3
    np.testing.assert_allclose(ours.sigma[free] / pixels.sigma[free], 1.0, atol=0.03)
    assert abs(ours.chi2 - ours.dof) < 5 * np.sqrt(2 * ours.dof)


def test_pixels_are_read_piece_by_piece(tmp_path):
    """Frames of 640 x 480 pixels in float64, 200 MB of them: less than a quarter is in memory at any time."""
    grid = Grid(640, 480, (320.5, 240.5), (0.0, 0.0), ((0.0008, 0.0), (0.0, 0.0008)))
    x, y = grid.xy(0, grid.pixels)
    counts = 1e4 * shares(x, y) * (1.0 + x[:, None, None])
    calset = walop.from_arrays(counts, np.sqrt(counts), x, y, ANGLES)
    write_frames(tmp_path / "frames.fits", calset, grid, dtype="f8")
    of_images = 2 * counts.nbytes
    del counts, calset
    tracemalloc.start()
    cells = read_calibration_set(tmp_path / "frames.fits")
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(cells.points) > 4000
    assert most < 0.25 * of_images


def test_a_run_reads_its_frames_in_the_cells_of_its_fit(tmp_path):
    """Twenty cells, told in summary.json: that many along a side when a later command asks for the data."""
    path, folder = tmp_path / "frames.fits", tmp_path / "run"
    write_frames(path, simulate(RUN, seed=12).calset, raster(RUN, SIDE))
    calset = read_calibration_set(path, cells=20)
    result = fit(Likelihood.of(calset, base_model(calset, throughput_degree=2))).with_verdict()
    folder.mkdir()
    write_calibration(folder / "calibration.fits", Calibration.from_fit(result))
    assert len(walop.read(folder).calset.points) == SIDE**2  # fewer pixels than the usual cells: each stays
    (folder / "summary.json").write_text(json.dumps(summary(result, seconds=1.0), default=float))
    again = walop.read(folder).calset
    assert again.cells == 20
    np.testing.assert_array_equal(block_of(again).counts, block_of(calset).counts)

"""Whole frames by the sums of one pass: what they give pixel by pixel, and the set for them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from changed_sets import block_of, with_block
from frame_run import frame_run, raster
from frames_file import write_frames

from walop_jax.calibration import residual_map
from walop_jax.calibration.residual_map import residual_map_of_pixels
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.frames import RowReader, float64
from walop_jax.data.grid import Grid
from walop_jax.data.merge import merge_calibration_sets, without_frames
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.diagnosis.trust import examined, pixel_structure
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit, with_honest_errors
from walop_jax.fit.stand_in import FARTHEST, moved, on_field_points, with_pixel_structure
from walop_jax.io.errors import DataError
from walop_jax.likelihood import limits
from walop_jax.likelihood.compressed import compressed
from walop_jax.likelihood.frames import Cells, PixelExpansion, expand_pixels, stands_for_pixels
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.blemish import Blemish
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.simulation.simulate import simulate

SIDE = 72
RUN = frame_run(SIDE)


def frames_of(calset, path, *, dtype="f4"):
    write_frames(path, calset, raster(RUN, SIDE), dtype=dtype)
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return frames_of(simulate(RUN, seed=12).calset, tmp_path_factory.mktemp("frames") / "frames.fits")


@pytest.fixture(scope="module")
def likelihood(path):
    calset = read_calibration_set(path)
    return Likelihood.of(calset, base_model(calset, throughput_degree=2), interpolate=True)


@pytest.fixture(scope="module")
def usual(likelihood):
    """The fit that goes pixel by pixel."""
    return fit(likelihood)


@pytest.fixture(scope="module")
def truth_values(usual):
    """A place some standard errors from the minimum."""
    return usual.values + 2.0 * usual.sigma


@pytest.fixture(scope="module")
def both(likelihood, truth_values):
    return expand_pixels(likelihood, truth_values), likelihood.expand(truth_values)


def assert_same(ours, reference):
    """Equal χ², counts, gradient (in standard errors) and standard errors."""
    assert ours.data == pytest.approx(reference.data, rel=1e-10)
    np.testing.assert_array_equal(ours.census.rows, reference.census.rows)
    np.testing.assert_allclose(ours.census.field, reference.census.field, atol=1e-12)
    covariance = np.linalg.inv(reference.matrix)
    sigma = np.sqrt(np.diag(covariance))
    step = covariance @ (ours.gradient - reference.gradient)
    np.testing.assert_allclose(step / sigma, 0.0, atol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(ours.matrix))) / sigma, 1.0, atol=1e-3)


def test_one_pass_is_the_expansion_of_all_pixels(both):
    assert_same(*both)


def test_a_strip_in_two_is_some_of_the_pixels(likelihood, truth_values, monkeypatch):
    monkeypatch.setattr(limits, "STRIP_ROWS", 8)
    some = expand_pixels(likelihood, truth_values, every=2)
    assert some.census.n_data == likelihood.census.n_data * 5 / 9


def test_flagged_pixels_and_other_types_are_as_before(path, likelihood, truth_values, tmp_path):
    """A corner and a speckle of pixels flagged, one camera of half the exposures 0.1 % brighter, in float64."""
    with fits.open(path) as hdus:
        flag = np.array(hdus["FLAG"].data)
        flag[:, :10, :14] = 2
        flag[3, 20:60:7, 5::9] = 1
        hdus["FLAG"].data = flag
        for name in ("N0", "N1", "N2", "N3", "E0", "E1", "E2", "E3"):
            hdus[name].data = hdus[name].data.astype(">f8")
        hdus["N2"].data[::2] *= 1.001
        hdus.writeto(tmp_path / "flagged.fits", checksum=True)
    calset = read_calibration_set(tmp_path / "flagged.fits")
    other = Likelihood.of(calset, likelihood.model, interpolate=True)
    assert_same(expand_pixels(other, truth_values), other.expand(truth_values))


def test_the_floor_of_the_errors_counts_for_pixels_as_for_points_of_a_table(likelihood, truth_values):
    """With a floor of 1 % of the light, ten times the noise of photons, in cameras of whole frames and of a table."""
    template = likelihood.model.template
    cameras = dataclasses.replace(template.cameras, floor=0.01)
    model = dataclasses.replace(likelihood.model, template=dataclasses.replace(template, cameras=cameras))
    calset = likelihood.calset
    of_table = dataclasses.replace(calset, intensities=TableIntensities.of(calset.intensities, calset.points))
    reference = Likelihood.of(of_table, model, interpolate=True).expand(truth_values)
    ours = expand_pixels(Likelihood.of(calset, model, interpolate=True), truth_values)
    assert_same(ours, reference)
    assert reference.data < 0.1 * expand_pixels(likelihood, truth_values).data
    standing = compressed(
        ours
    )  # whose points stand for many pixels, each with its floor: none is added to their sum
    again = Likelihood.of(standing, model, interpolate=False).expand(truth_values)
    np.testing.assert_allclose(np.diag(again.matrix), np.diag(ours.matrix), rtol=0.02)


def test_the_words_of_a_file_are_its_numbers(path, likelihood):
    intensities = likelihood.calset.intensities
    rows = RowReader(intensities, 8, SIDE + 8)(3, 9)
    block = intensities.block(3 * SIDE, 9 * SIDE)
    values = np.asarray(float64(rows.counts))[:, :, :6, :SIDE]
    np.testing.assert_array_equal(
        values.reshape(4, -1, 6 * SIDE).T.swapaxes(0, 1).swapaxes(0, 1), block.counts
    )
    assert not rows.open[:, 6:].any()
    assert not rows.open[:, :, SIDE:].any()


def test_an_error_that_is_not_positive_is_told_with_its_place(path, likelihood, truth_values, tmp_path):
    with fits.open(path) as hdus:
        hdus["E1"].data[4, 47, 17] = -1.0
        hdus.writeto(tmp_path / "bad.fits", checksum=True)
    calset = read_calibration_set(tmp_path / "bad.fits")
    with pytest.raises(DataError, match=r"E1.*plane 4, row 47, column 17"):
        expand_pixels(Likelihood.of(calset, likelihood.model, interpolate=True), truth_values)


def test_the_residual_map_of_the_sums_is_that_of_the_pixels(likelihood, both, truth_values, monkeypatch):
    ours = residual_map_of_pixels(both[0].sums)
    step, low = 2 * RUN.field / (SIDE - 1), -RUN.field - RUN.field / (SIDE - 1)
    same = Grid(9, 9, (0.5, 0.5), (low, low), ((8 * step, 0.0), (0.0, 8 * step)))
    monkeypatch.setattr(residual_map, "cells_for", lambda *_: same)
    theirs = residual_map.residual_map_at(likelihood, truth_values, both[1])
    assert ours.values.shape == theirs.values.shape
    np.testing.assert_allclose((ours.values - theirs.values) / theirs.errors, 0.0, atol=0.1)
    np.testing.assert_allclose(ours.errors / theirs.errors, 1.0, atol=1e-3)
    np.testing.assert_allclose(ours.chi2, theirs.chi2, rtol=1e-8)
    x, y = ours.grid.points.x, ours.grid.points.y
    np.testing.assert_allclose([x, y], [same.points.x, same.points.y], atol=1e-12)


def test_what_is_not_smooth_or_not_linear_goes_pixel_by_pixel(likelihood):
    assert stands_for_pixels(likelihood, likelihood.model.start)
    context = effect_context(likelihood.model.template, likelihood.calset.exposures)
    for effect in (effect_by_name("nonlinearity"), Blemish.of(context, depth=0.01, size=0.003)):
        model = with_effects(likelihood.model, [effect], context)
        other = Likelihood.of(likelihood.calset, model, interpolate=True)
        assert not stands_for_pixels(other, model.start)
    table = dataclasses.replace(likelihood.calset, intensities=simulate(RUN, seed=12).calset.intensities)
    assert not stands_for_pixels(
        Likelihood.of(table, likelihood.model, interpolate=True), likelihood.model.start
    )


# --------------------------------------------------------------------------------------- a table beside the frames


@pytest.fixture(scope="module")
def with_stars(path):
    """Frames, and standard stars in a table; the table first, so that exposures of frames are not the first ones."""
    plan = dataclasses.replace(RUN, grid=3, standards=2, unpolarised=1, standard_grid=3, moon_patches=0)
    stars = simulate(plan, seed=12).calset
    calset = merge_calibration_sets(stars, read_calibration_set(path))
    assert 0 < np.sum(calset.exposures.kind == "standard") < len(stars.exposures)
    return Likelihood.of(calset, base_model(calset, throughput_degree=2), interpolate=True)


@pytest.mark.long
def test_frames_and_a_table_are_gone_through_each_in_its_way(with_stars):
    model = with_stars.model
    assert stands_for_pixels(with_stars, model.start)
    sigma = np.array([p.prior[1] if p.prior else p.scale for p in model.parameters])
    values = model.start + 0.1 * sigma * np.random.default_rng(2).standard_normal(
        len(sigma)
    ) * model.selection().any(1)
    assert_same(expand_pixels(with_stars, values), with_stars.expand(values))


@pytest.mark.parametrize("most", [100, 17, 12])
def test_a_sample_of_frames_and_a_table_has_points_of_both(with_stars, most):
    calset = with_stars.calset
    table = without_frames(calset).points
    sample = thinned(calset, most, neighbours=1)
    assert most // 2 < len(sample.points) <= most
    ids, count = sample.points.point, SIDE**2
    assert len(set(ids.tolist())) == len(ids)
    of_table = np.isin(ids, calset.points.point[count:])
    assert of_table.sum() == min(len(table), most // 2)
    block = sample.intensities.block(0, len(ids))
    np.testing.assert_array_equal([block.x, block.y], [sample.points.x, sample.points.y])
    stars = calset.exposures.kind == "standard"
    assert block.used[of_table][:, stars].any()
    assert not block.used[~of_table][:, stars].any()


@pytest.mark.long
def test_the_set_that_stands_for_frames_keeps_the_table_beside_them(with_stars, monkeypatch):
    monkeypatch.setattr(limits, "LARGE_ABOVE", 0)
    calset = with_stars.calset
    found = fit(Likelihood.of(calset, with_stars.model, interpolate=True))
    assert isinstance(found.expansion, PixelExpansion)
    small = compressed(found.expansion)
    assert small.compression.pixels == SIDE**2
    table = without_frames(calset)
    last = small.intensities.block(len(small.points) - len(table.points), len(small.points))
    own = table.intensities.block(0, len(table.points))
    for name in ("x", "y", "used", "source"):
        np.testing.assert_array_equal(getattr(last, name), getattr(own, name))
    np.testing.assert_array_equal(last.counts[own.used], own.counts[own.used])
    again = fit(Likelihood.of(small, with_stars.model, interpolate=False))
    free = found.sigma > 0
    np.testing.assert_allclose((again.values - found.values)[free] / found.sigma[free], 0.0, atol=2e-3)
    np.testing.assert_allclose(again.sigma[free] / found.sigma[free], 1.0, atol=5e-3)
    ours = residual_map_of_pixels(found.expansion.sums)
    assert np.isfinite(ours.values).all()


def test_cells_cover_frames_of_any_shape():
    cells = Cells.of(Grid(300, 71, (1.0, 1.0), (0.0, 0.0), ((1e-3, 0.0), (0.0, 1e-3))))
    assert (cells.side, cells.shape) == (3, (24, 100))
    s, t = cells.edges()
    assert (s[0], s[-1], t[0], t[-1]) == (-1.0, 1.0, -1.0, 1.0)
    # The middle of the first pixel.
    assert cells.field(s[0] + 1 / 300, t[0] + 1 / 71) == pytest.approx((0.0, 0.0))
    assert cells.place(*cells.field(0.3, -0.7)) == pytest.approx((0.3, -0.7))


# ------------------------------------------------------------------------------------ the set that stands for them


@pytest.fixture(scope="module")
def fitted(path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "LARGE_ABOVE", 0)
        calset = read_calibration_set(path)
        return fit(Likelihood.of(calset, base_model(calset, throughput_degree=2), interpolate=True))


@pytest.fixture(scope="module")
def stand_in(fitted):
    assert isinstance(fitted.expansion, PixelExpansion)
    return compressed(fitted.expansion)


def test_the_fit_of_the_sums_ends_where_the_usual_one_ends(fitted, usual):
    free = usual.sigma > 0
    np.testing.assert_allclose((fitted.values - usual.values)[free] / usual.sigma[free], 0, atol=1e-3)
    assert fitted.chi2 == pytest.approx(usual.chi2, abs=1e-3)
    assert fitted.dof == usual.dof


@pytest.mark.long
def test_a_wave_of_five_pixels_is_told_of_frames_and_of_the_set_that_stands_for_them(path, fitted, tmp_path):
    """Gains of 0.1 % sin(2π column/5): 0.071 % rms, which no field point and no cell holds; errors are the same."""
    calset = read_calibration_set(path)
    phase = 2 * np.pi * (np.arange(SIDE**2) % SIDE)[:, None] / 5 + np.arange(4)
    waved = with_block(calset, counts=block_of(calset).counts * (1 + 1e-3 * np.sin(phase))[:, None])
    rough = frames_of(waved, tmp_path / "rough.fits", dtype="f8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "LARGE_ABOVE", 0)
        likelihood = Likelihood.of(read_calibration_set(rough), fitted.model, interpolate=True)
        of_pixels = with_honest_errors(fit(likelihood, start=fitted.values))
        small = with_pixel_structure(compressed(of_pixels.expansion), pixel_structure(of_pixels))
        of_points = with_honest_errors(fit(Likelihood.of(small, fitted.model, interpolate=False)))
        seen = [examined(one, as_written=True) for one in (of_pixels, of_points)]
    for one in seen:
        assert not one.trusted
        assert one.verdict.structure.gain == pytest.approx(1e-3 / np.sqrt(2.0), rel=0.15)
    assert "residuals of the same pixel agree between exposures" in seen[0].verdict.doubts[-1]
    assert "residuals of the same pixel agreed between exposures" in seen[1].verdict.doubts[-1]
    free = of_pixels.sigma > 0
    np.testing.assert_allclose(seen[1].sigma[free] / seen[0].sigma[free], 1.0, atol=0.05)


def as_it_was(model, result):
    return model


def changed_prior(model, result):
    first = next(p for p in model.parameters if p.free and p.prior is not None)
    mean, width = first.prior
    return model.change(first.name, prior=(mean + 0.3 * width, 0.5 * width))


def frozen(model, result):
    """Two standard errors from where it was."""
    first = next(p for p in model.parameters if p.free and p.prior is not None)
    value, sigma = result.value(first.name)
    return model.change(first.name, free=False, start=value + 2.0 * sigma)


@pytest.mark.long
@pytest.mark.parametrize("change", [as_it_was, changed_prior, frozen])
def test_other_fits_of_it_are_those_of_the_pixels(fitted, stand_in, likelihood, change):
    model = change(likelihood.model, fitted)
    ours = fit(Likelihood.of(stand_in, model, interpolate=False))
    theirs = fit(Likelihood.of(likelihood.calset, model, interpolate=True))
    free = theirs.sigma > 0
    np.testing.assert_allclose((ours.values - theirs.values)[free] / theirs.sigma[free], 0.0, atol=2e-3)
    np.testing.assert_allclose(ours.sigma[free] / theirs.sigma[free], 1.0, atol=5e-3)


def test_it_comes_back_from_its_file(stand_in, fitted, tmp_path):
    write_calibration_set(tmp_path / "set.fits", stand_in)
    assert (tmp_path / "set.fits").stat().st_size < 2e6
    again = read_calibration_set(tmp_path / "set.fits")
    record = again.compression
    assert record is not None
    assert record.pixels == SIDE**2
    assert record.chi2 == fitted.expansion.data
    assert record.frames[0].sha256 == fitted.calset.inputs[0].sha256
    assert any("stand for" in text for text in again.remarks)
    block, other = (one.intensities.block(0, len(one.points)) for one in (stand_in, again))
    np.testing.assert_array_equal(block.counts, other.counts)


@pytest.mark.parametrize("name", ["NPIXELS", "CHI2", "DOF"])
def test_a_record_that_lacks_something_is_refused(stand_in, tmp_path, name):
    write_calibration_set(tmp_path / "set.fits", stand_in)
    with fits.open(tmp_path / "set.fits") as hdus:
        del hdus["COMPRESSION"].header[name]
        for hdu in hdus:
            hdu.add_checksum()
        hdus.writeto(tmp_path / "short.fits")
    with pytest.raises(DataError, match=f"COMPRESSION.*{name}.*compress the frames again"):
        read_calibration_set(tmp_path / "short.fits")


def test_a_fit_that_has_left_the_place_is_told(fitted, stand_in):
    near = on_field_points(fitted)
    assert moved(near) < 0.1
    far = {
        name: value + 100.0 * sigma
        for (name, value), sigma in zip(stand_in.compression.values.items(), fitted.sigma, strict=True)
    }
    record = dataclasses.replace(stand_in.compression, values=far)
    likelihood = Likelihood.of(
        dataclasses.replace(stand_in, compression=record), fitted.model, interpolate=False
    )
    assert moved(dataclasses.replace(near, likelihood=likelihood)) > FARTHEST

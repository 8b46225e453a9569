"""Figures show what they say: numbers behind them are checked, they are drawn without a screen."""

from __future__ import annotations

import dataclasses
import io
import threading

import numpy as np
import pytest
from matplotlib import pyplot
from small_run import small_fit

import walop_jax as walop
from walop_jax.calibration.calibration import Calibration
from walop_jax.diagnosis.figure_data import figure_data
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.cameras import Cameras
from walop_jax.reports import figures
from walop_jax.reports.diagnosis_figures import signature_figure


@pytest.fixture(scope="module")
def fitted():
    result = small_fit()
    return result, Calibration.from_fit(result)


def drawn(figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def test_residuals_of_points_are_noise_after_a_fit(fitted):
    result, _ = fitted
    after = figures.point_residuals(result.likelihood, result.values)
    assert after.shape == (25 + 4,)
    assert np.sqrt(np.nanmean(after**2)) == pytest.approx(1.0, abs=0.15)
    assert figures.point_residuals(result.likelihood, result.model.start).min() > 5.0


def test_the_histogram_is_as_high_as_its_bars(fitted, monkeypatch):
    """Of residuals far smaller than noise: errors that were stated too large."""
    result, whole = fitted[0], Likelihood.residuals
    monkeypatch.setattr(Likelihood, "residuals", lambda self, v: (None, 0.1 * whole(self, v)[1]))
    figure = figures.residuals_figure(result.likelihood, result.values, result.model.start)
    (axis,) = (axis for axis in figure.axes if axis.get_ylabel() == "density")
    assert axis.get_ylim()[1] > max(bar.get_height() for bar in axis.patches) > 1.0


def test_every_figure_can_be_drawn(fitted):
    result, calibration = fitted
    made = {
        "calibration": result.plot("calibration"),
        "matrix": figures.matrix_maps_figure(calibration.maps),
        "residuals": result.plot("residuals"),
        "modulation": figures.modulation_figure(result.calset, [0, 5]),
    }
    for name, figure in made.items():
        assert drawn(figure).startswith(b"\x89PNG"), name
    assert pyplot.get_fignums() == []  # nothing was registered with the global state


def test_a_change_is_shown_in_per_cent(fitted):
    maps = fitted[1].maps
    step = np.array([0.001, 0.0, 0.0, 0.0, -0.0035, 0.0])[:, None, None]
    figure = figures.matrix_change_figure(maps, dataclasses.replace(maps, values=maps.values + step))
    images = [axis.images[0] for axis in figure.axes[:6]]
    for image, change, far in zip(
        images, (0.1, 0.0, 0.0, 0.0, -0.35, 0.0), (0.1, 1.0, 1.0, 1.0, 0.5, 1.0), strict=True
    ):
        np.testing.assert_allclose(image.get_array(), change, atol=1e-10)
        assert image.get_clim() == (-far, far)
    small = np.array([0.001, 2e-5, 4e-5, 0.0, -0.0035, 0.006])[
        :, None, None
    ]  # beside large ones of their names
    figure = figures.matrix_change_figure(maps, dataclasses.replace(maps, values=maps.values + small))
    assert [figure.axes[k].images[0].get_clim()[1] for k in (1, 2)] == pytest.approx([0.002, 0.005])
    noise = np.array([0.001, 1e-15, 0.0, 0.0, 0.0, 0.0])[:, None, None]
    figure = figures.matrix_change_figure(maps, dataclasses.replace(maps, values=maps.values + noise))
    assert figure.axes[1].images[0].get_clim()[1] == pytest.approx(1e-5)  # not blown up to a pattern
    half = dataclasses.replace(maps.grid, matrix=((0.01, 0.0), (0.0, 0.01)))
    with pytest.raises(ValueError, match="different places"):
        figures.matrix_change_figure(maps, dataclasses.replace(maps, grid=half))


def test_maps_show_the_matrix(fitted):
    _, calibration = fitted
    figure = figures.matrix_maps_figure(calibration.maps)
    points = calibration.maps.grid.points
    low_x, high_x, low_y, high_y = points.x.min(), points.x.max(), points.y.min(), points.y.max()
    corner, _ = calibration.matrix(np.array([low_x, high_x]), np.array([low_y, high_y]))
    for k, axis in enumerate(figure.axes[:6]):
        image = np.asarray(axis.images[0].get_array())
        np.testing.assert_allclose([image[0, 0], image[-1, -1]], 100.0 * corner[:, k], rtol=1e-9, atol=1e-9)
    # Colours by kind, not by sign; ends of the scales that other runs have as well.
    scales = [(axis.images[0].cmap.name, *axis.images[0].get_clim()) for axis in figure.axes[:6]]
    assert scales[0] == scales[3]
    assert [name for name, *_ in scales[:3]] == ["RdBu_r", "viridis", "RdBu_r"]
    assert scales[1][2] == 100.0
    for name, low, high in scales:
        assert low == -high or name == "viridis"
        assert f"{high - low:e}"[0] in "124"  # ends go in steps of 1, 2, 5
    for axis in figure.axes[:6]:
        assert axis.get_xlim() == pytest.approx((-0.35, 0.35))  # as all maps of a run


def test_figures_go_into_axes_and_hold_fonts_that_journals_take(fitted):
    _, calibration = fitted
    whole = pyplot.figure(layout="constrained")
    _, right = whole.subplots(1, 2)
    inside = walop.plot(calibration, "efficiency", ax=right)
    assert inside in whole.subfigs
    assert len([axis for axis in inside.axes if axis.images]) == 2
    assert len(walop.plot(fitted[0], "modulation", ax=whole.subplots()).axes) == 2
    pyplot.close(whole)
    figure = walop.plot(calibration, "matrix", figsize=(3.5, 2.6))
    assert tuple(figure.get_size_inches()) == (3.5, 2.6)
    stream = io.BytesIO()
    figure.savefig(stream, format="pdf")
    assert b"/Type3" not in stream.getvalue()
    assert b"/CIDFontType2" in stream.getvalue()
    with pytest.raises(TypeError, match="colour"):
        walop.plot(calibration, "matrix", colour="red")
    with pytest.raises(TypeError, match=r"\bax\b"):
        walop.plot(calibration, "matrix", ax=np.array([right, right]))


def test_modulation_is_that_of_the_data(fitted):
    calset = fitted[0].calset
    figure = figures.modulation_figure(calset, [3])
    block = calset.intensities.block(3, 4)
    clp = calset.exposures.clp_in
    n = block.counts[0, clp]
    for axis, pair in zip(figure.axes, (0, 2), strict=True):
        shown = axis.lines[1].get_ydata()
        np.testing.assert_allclose(shown, (n[:, pair] - n[:, pair + 1]) / (n[:, pair] + n[:, pair + 1]))


def test_modulation_is_that_of_the_cameras_of_an_arm(fitted):
    """Whatever their order in the set; a single camera has none."""
    calset = fitted[0].calset
    names = ("a", "b", "c", "d")
    figure = figures.modulation_figure(calset, [3], cameras=Cameras(names, arms=((2, 0), (1, 3))))
    n = calset.intensities.block(3, 4).counts[0, calset.exposures.clp_in]
    for axis, (i, j) in zip(figure.axes, ((2, 0), (1, 3)), strict=True):
        np.testing.assert_allclose(axis.lines[1].get_ydata(), (n[:, i] - n[:, j]) / (n[:, i] + n[:, j]))
    one_arm = figures.modulation_figure(calset, [3], cameras=Cameras(names, arms=((2, 0), (1,), (3,))))
    assert [axis.get_ylabel() for axis in one_arm.axes] == ["(c − a) / (c + a)"]
    with pytest.raises(DataError, match="no arm has two cameras"):
        figures.modulation_figure(calset, [3], cameras=Cameras(names, arms=((0,), (1,), (2,), (3,))))


def test_a_calibration_in_memory_lists_what_can_be_drawn_without_its_data(fitted):
    result, calibration = fitted
    of_data = {"calibration", "coefficients", "transmission", "modulation", "residuals"}
    assert {*walop.plot(result)} - {*walop.plot(calibration)} == of_data
    assert "residual-map" not in walop.plot(calibration)


def test_figures_of_a_diagnosis_hold_its_residuals(fitted):
    result, _ = fitted
    likelihood, start = result.likelihood, dataclasses.replace(result, values=result.model.start)
    found = Diagnosis(
        verdict="consistent", steps=(), candidates=(), limits=(), untestable=(), unexplained=None, p_value=0.5,
        remaining_p=0.5, before=start, after=result, seconds=0.0, points=29,
    )  # fmt: skip
    made = figure_data(found)
    before, after = (likelihood.residuals(values)[1] for values in (likelihood.model.start, result.values))
    for group in ("camera", "kind", "filter", "exposure"):
        rows = made.shares["GROUP"] == group
        assert made.shares["BEFORE"][rows].sum() == pytest.approx((before**2).sum())
        assert made.shares["AFTER"][rows].sum() == pytest.approx((after**2).sum())
        assert made.shares["EXPECTED"][rows].sum() == pytest.approx(3.0 * likelihood.used.sum())
    assert made.ladder["CHI2"].tolist() == [result.chi2]
    (whole,) = made.comparisons
    rows = likelihood.used.sum(axis=1)[:, None]
    np.testing.assert_allclose(whole.field["RMS_AFTER"] ** 2 * rows, (after**2).sum(axis=1), rtol=1e-9)
    assert drawn(signature_figure(whole, made.exposures, made.cameras)).startswith(b"\x89PNG")


def test_figures_may_be_made_in_threads(fitted):
    calset = fitted[0].calset
    made: list[bytes] = []
    threads = [
        threading.Thread(target=lambda: made.append(drawn(figures.modulation_figure(calset, [0]))))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 2
    assert made[0] == made[1]

"""Figures of a diagnosis show what they say: one symmetric scale, the dots and lines of the arrays."""

from __future__ import annotations

import dataclasses

import handmade_run
import numpy as np
import pytest
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from walop_jax.calibration.matrix import ResidualMap
from walop_jax.io.errors import DataError
from walop_jax.model.cameras import Cameras
from walop_jax.reports import diagnosis_figures as figures
from walop_jax.reports import figures as of_calibrations
from walop_jax.reports.style import pixel_map, plain_ticks, point_map
from walop_jax.science.field_accuracy import FieldAccuracy


def tiles(figure) -> list[PatchCollection]:
    return [c for axis in figure.axes for c in axis.collections if isinstance(c, PatchCollection)]


def test_residual_maps_share_one_symmetric_scale():
    data = handmade_run.figure_data()
    one = data.comparisons[1]
    figure = figures.residual_maps(
        data.points, {"before": one.field["BEFORE"], "after": one.field["AFTER"]}, data.cameras
    )
    maps = tiles(figure)
    assert len(maps) == 8
    # The largest residual by hand: −6 in camera E2, without the effect.
    assert {shown.get_clim() for shown in maps} == {(-6.0, 6.0)}
    for k in range(4):
        np.testing.assert_array_equal(maps[k].get_array(), one.field["BEFORE"][:, k])
        np.testing.assert_array_equal(maps[4 + k].get_array(), one.field["AFTER"][:, k])
    signs = [
        [text.get_text() for text in axis.texts if len(text.get_text()) == 1] for axis in figure.axes[:8]
    ]
    assert signs == [[], [], ["+"], ["−"], [], [], [], []]  # 1.5, 3.0, 4.5 and −6.0 σ at one corner


def test_points_without_data_are_left_out():
    data = handmade_run.figure_data()
    before = data.comparisons[1].field["BEFORE"].copy()
    before[4] = np.nan
    shown = tiles(figures.residual_maps(data.points, {"": before}, data.cameras))[0]
    assert len(shown.get_array()) == 8
    figures.residual_maps(data.points, {"": np.full((9, 4), np.nan)}, data.cameras)


@pytest.mark.parametrize(
    ("harmonic", "abscissa"), [(3, "polariser angle (deg)"), (-1, "time since the first exposure (h)")]
)
def test_signature_lies_beside_the_data(harmonic, abscissa):
    data = handmade_run.figure_data()
    out = {**data.exposures, "CLP_ANGLE": np.full(8, np.nan)}
    one = dataclasses.replace(data.comparisons[1], harmonic=harmonic)
    figure = figures.signature_figure(one, data.exposures if harmonic > 0 else out, data.cameras)
    assert figure.axes[4].get_xlabel() == abscissa
    for k, axis in enumerate(figure.axes[:4]):
        effect = next(line for line in axis.lines if line.get_label() == "effect")
        np.testing.assert_allclose(effect.get_ydata(), one.curves["EXPLAINED"][:, k])
        dots = axis.containers[0].lines[0]
        np.testing.assert_allclose(dots.get_ydata(), one.curves["BEFORE"][:, k])
        x = 22.5 * np.arange(8) if harmonic > 0 else 0.24 * np.arange(8)
        np.testing.assert_allclose(dots.get_xdata(), x, atol=1e-6)


def test_nothing_explained_is_no_line():
    """A diagnosis that found nothing drew a line at 0 and called it the effect."""
    data = handmade_run.figure_data()
    nothing = dict(data.comparisons[0].curves) | {"EXPLAINED": np.zeros((8, 4))}
    one = dataclasses.replace(data.comparisons[0], curves=nothing)
    figure = figures.signature_figure(one, data.exposures, data.cameras)
    assert [line for axis in figure.axes for line in axis.lines if line.get_label() == "effect"] == []


def test_exposures_at_one_angle_are_averaged():
    data = handmade_run.figure_data()
    angle = np.repeat([0.0, 45.0, 90.0, 135.0], 2)
    figure = figures.signature_figure(
        data.comparisons[1], {**data.exposures, "CLP_ANGLE": angle}, data.cameras
    )
    dots = figure.axes[0].containers[0].lines[0]
    np.testing.assert_allclose(
        dots.get_ydata(), data.comparisons[1].curves["BEFORE"][:, 0].reshape(4, 2).mean(axis=1)
    )


def test_two_cameras_fill_two_columns():
    data = handmade_run.figure_data()
    one = data.comparisons[1]
    figure = figures.residual_maps(
        data.points, {"before": one.field["BEFORE"][:, :2]}, ("ordinary", "extraordinary")
    )
    assert [axis.get_title() for axis in figure.axes[:2]] == ["ordinary", "extraordinary"]
    assert len(tiles(figure)) == 2
    assert len(figures.signature_figure(one, data.exposures, data.cameras[:2]).axes) == 4


def test_ladder_shows_chi2_per_degree_of_freedom():
    figure = figures.ladder_figure(handmade_run.figure_data().ladder)
    axis = figure.axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["starting model", "+ clp_wobble"]
    assert [text.get_text() for text in axis.texts] == ["1.625", "1.029"]


def test_ladder_of_a_fit_with_few_degrees_of_freedom():
    """5 √(2/20) > 1: the band has no lower end on a logarithmic axis."""
    ladder = handmade_run.figure_data().ladder
    figure = figures.ladder_figure({**ladder, "CHI2": np.array([40.0, 19.0]), "DOF": np.array([21, 20])})
    figure.draw_without_rendering()
    low, high = figure.axes[0].get_xlim()
    assert 0.05 < low < 0.95
    assert 2.5 < high < 10.0


def test_shares_of_a_single_camera():
    shares = handmade_run.figure_data().shares
    rows = shares["GROUP"] != "camera"
    figure = figures.shares_figure({name: values[rows] for name, values in shares.items()})
    assert [axis.get_xlabel() for axis in figure.axes] == ["exposure"]


def test_protection_levels_are_shown_where_they_are_known():
    """A tile for each, a cross for none; of points along a line there was no map."""
    line = np.linspace(-0.2, 0.2, 5)
    levels = np.array([0.001, 0.002, np.nan, 0.004, 0.005])
    causes = ("ghost",) * 5
    found = dataclasses.replace(
        handmade_run.limits(), x=line, y=0.0 * line, protection=levels, caused_by=causes
    )
    figure = figures.protection_figure(found)
    np.testing.assert_allclose(tiles(figure)[0].get_array(), [0.1, 0.2, 0.4, 0.5])
    (crosses,) = figure.axes[0].lines
    assert crosses.get_xydata().tolist() == [[0.0, 0.0]]


def test_maps_of_a_product_are_those_of_the_file():
    maps = handmade_run.product().maps
    figure = of_calibrations.matrix_maps_figure(maps)
    first = figure.axes[0].images[0]
    np.testing.assert_allclose(first.get_array(), 100.0 * maps.values[0])
    assert first.get_clim() == pytest.approx((-500.0, 500.0))  # that of m31 as well, which reaches 500 %
    assert first.get_extent() == pytest.approx((-0.25, 0.25, -0.25, 0.25))
    one_arm = dataclasses.replace(maps, values=maps.values[:3], errors=maps.errors[:3])
    assert len([a for a in of_calibrations.matrix_maps_figure(one_arm).axes if a.get_title()]) == 3
    errors = of_calibrations.matrix_errors_figure(maps)
    np.testing.assert_allclose(errors.axes[5].images[0].get_array(), 0.02)
    assert errors.axes[5].images[0].get_clim() == pytest.approx((0.01, 0.1))  # decades around all errors
    with pytest.raises(DataError, match="no element of the matrix of 1 arms is cross-talk"):
        of_calibrations.matrix_maps_figure(one_arm, 2)


def test_maps_of_residuals_name_the_cameras_of_each_arm():
    """Also where no cell has enough data."""
    grid, nothing = handmade_run.product().maps.grid, np.full((7, 5, 5), np.nan)
    cameras = Cameras(("a", "b", "c", "d"), arms=((0, 2), (1, 3)))
    figure = of_calibrations.residual_map_figure(
        ResidualMap(grid, "band", nothing, nothing, nothing[0]), cameras
    )
    figure.draw_without_rendering()
    assert [axis.get_title() for axis in figure.axes[:8]][3] == "b, d / a, c (%)"


def test_the_error_of_p_of_any_goal_and_of_nothing_before():
    accuracy = FieldAccuracy(
        np.linspace(0.001, 0.01, 25).reshape(5, 5), (-0.2, 0.2, -0.2, 0.2), "r", goal=1e-5
    )
    right = of_calibrations.accuracy_figure(accuracy).axes[1]
    low, high = right.get_xlim()
    assert low < 0.001 < high  # the goal, in per cent
    left = of_calibrations.accuracy_figure(dataclasses.replace(accuracy, goal=0.005)).axes[0]
    (line,) = left.collections
    assert line.get_linestyle() == [(0.0, None)]  # that of the goal is whole
    field = {"x": [0.0, 0.1], "y": [0.0, 0.0], "before": [None, None], "p_error": [0.001, None]}
    figure = of_calibrations.planned_figure(field)
    assert [shown.get_array().tolist() for shown in tiles(figure)] == [[], [0.1]]


def test_tiles_of_two_rasters_do_not_overlap():
    """9 × 9 field points, and 3 × 3 of standards between them: tiles of one size lay over each other."""
    sides = (np.linspace(-0.29, 0.29, 9), np.linspace(-0.232, 0.232, 3))
    x, y = (
        np.concatenate([grid.ravel() for grid in axis])
        for axis in zip(*(np.meshgrid(s, s) for s in sides), strict=True)
    )
    figure = Figure()
    drawn = point_map(figure.subplots(), "", x, y, np.arange(90.0), Normalize(0.0, 1.0), "viridis")
    boxes = np.array([path.get_extents().extents for path in drawn.get_paths()])
    low, high = boxes[:, None, :2], boxes[:, None, 2:]
    overlap = np.minimum(high, high.swapaxes(0, 1)) - np.maximum(low, low.swapaxes(0, 1))
    lies_over = (overlap > 1e-9).all(axis=2)
    # The centre is a point of both rasters: one place, one value.
    assert [pair.tolist() for pair in np.argwhere(np.triu(lies_over, 1))] == [[40, 85]]
    size = boxes[:, 2] - boxes[:, 0]
    assert size.max() == pytest.approx(0.0725)  # where no standard is near neighbours touch
    assert np.sum(size > 0.0724) > 50


def test_a_single_point_has_a_tile():
    axis = Figure().subplots()
    zero = np.zeros(1)
    point_map(axis, "", zero, zero, zero, Normalize(0.0, 1.0), "viridis")
    assert axis.get_xlim() == pytest.approx((-0.03, 0.03), abs=0.006)
    image = pixel_map(axis, "", np.zeros((1, 1)), (0.0, 0.0, 0.0, 0.0), Normalize(0.0, 1.0), "viridis")
    assert image.get_extent() == pytest.approx((-0.025, 0.025, -0.025, 0.025))


@pytest.mark.parametrize("ends", [(0.1, 0.4), (1.0, 4.0), (0.001, 10.0)])
def test_ticks_are_labelled_with_their_numbers(ends):
    axis = Figure().subplots()
    axis.set(xscale="log", xlim=ends)
    plain_ticks(axis.xaxis)
    ticks = axis.get_xticks()
    assert len(ticks) >= 4
    assert [float(text.get_text()) for text in axis.get_xticklabels()] == pytest.approx(ticks)

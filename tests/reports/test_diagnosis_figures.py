"""Figures of a diagnosis show what they say: one symmetric scale, the dots and lines of the arrays."""

from __future__ import annotations

import dataclasses

import handmade_run
import numpy as np
import pytest
from matplotlib.collections import PatchCollection

from walop_jax.reports import diagnosis_figures as figures
from walop_jax.reports import figures as of_calibrations


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

"""Figures of the comparison with Paper II: that they show what they say, drawn without a screen."""

from __future__ import annotations

import io

import numpy as np
import pytest
from small_run import small_fit

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.commands.plot import plot
from walop_jax.data.settings import Settings
from walop_jax.paper.comparison import compare
from walop_jax.reports import paper_figures as figures
from walop_jax.science.star_errors import plate_errors


@pytest.fixture(scope="module")
def calibration_and_set():
    result = small_fit()
    return Calibration.from_fit(result), result.calset


@pytest.fixture(scope="module")
def comparison(calibration_and_set):
    calibration, calset = calibration_and_set
    return compare(calset, calibration, count=60)


@pytest.mark.parametrize(("name", "panels"), [("histogram", 6), ("map", 9), ("offset", 3), ("spectral", 2)])
def test_figures_are_drawn(comparison, name, panels):
    figure = comparison.plot(name)
    assert len(figure.axes) == panels
    figure.savefig(io.BytesIO(), format="png")


def test_figures_in_memory_are_listed_and_of_one_size(comparison):
    assert [*plot(comparison)] == ["histogram", "map", "offset", "spectral"]
    with pytest.raises(ValueError, match="a size of its own"):
        comparison.plot("map", width="column")


def test_modulation_of_a_set_at_several_points(calibration_and_set):
    _, calset = calibration_and_set
    points = calset.points
    figure = plot(calset, "modulation", x=points.x[[3, 8]], y=points.y[[3, 8]])
    labels = [line.get_label() for line in figure.axes[0].lines if line.get_label() != "ideal"]
    assert labels == [
        f"X {x:+.2f}°, Y {y:+.2f}°".replace("-", "−")
        for x, y in zip(points.x[[3, 8]], points.y[[3, 8]], strict=True)
    ]


def test_histograms_count_every_point(comparison):
    figure = figures.histogram_figure(comparison)
    for axis, count in ((figure.axes[0], 25), (figure.axes[3], 60)):
        for patch in axis.patches:
            heights = patch.get_xy()[:, 1]
            assert heights[1::2].sum() == pytest.approx(count, abs=0.5) or heights.sum() / 2 == pytest.approx(
                count
            )


def test_sets_without_what_the_scheme_needs_say_so(comparison):
    told = comparison.document()["full_moon"]
    assert told["scheme"] is None
    assert "5 × 5 boxes" in told["why_not"]
    assert comparison.document()["joint_errors_from"] == "covariance"


@pytest.mark.long
def test_plates_and_the_strip(calibration_and_set):
    """Near the lower left corner the instrument is nearly ideal; in the strip only 22.5° helps."""
    calibration, _ = calibration_and_set
    analysis = AnalysisVectors(calibration)
    out, zero, exchange, quarter = (Settings.default(1).at(CHWP=plate) for plate in (None, 0.0, 22.5, 45.0))
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-0.28, 0.28, 15)]))
    alone = plate_errors(analysis, [out], x, y)
    assert alone.min() == pytest.approx(1.0, abs=0.05)
    assert alone.max() > 20
    assert plate_errors(analysis, [zero, quarter], x, y).max() > 20
    assert plate_errors(analysis, [out, exchange], x, y).max() < 3
    figure = figures.plate_figure(calibration, [[None], [None, 22.5]])
    assert [axis.get_title() for axis in figure.axes[:2]] == ["plate out", "plate out and 22.5°"]

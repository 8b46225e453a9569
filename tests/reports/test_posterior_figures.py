"""Corner plots: what the contours hold, which panel shows what."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib import pyplot

from walop_jax.reports.posterior_figures import (
    MOST_IN_CORNER,
    SHARES,
    corner_figure,
    correlated,
    label,
    trace_figure,
)

NAMES, UNITS = ("half1.wedge", "sky.depolarisation", "noise.scale"), ("deg", "", "")


@pytest.fixture(scope="module")
def draws() -> np.ndarray:
    covariance = np.array([[4.0, -1.2, 0.0], [-1.2, 1.0, 0.0], [0.0, 0.0, 0.01]])
    return np.random.default_rng(1).multivariate_normal((13.0, 0.8, 0.0), covariance, 40_000)


def test_shares_are_those_of_one_and_two_sigma():
    np.testing.assert_allclose(SHARES, 1.0 - np.exp(-0.5 * np.array([1.0, 2.0]) ** 2), atol=6e-4)


def test_contours_hold_their_share_of_the_draws(draws: np.ndarray):
    figure = corner_figure(draws, NAMES, UNITS)
    panels = np.array(figure.axes).reshape(3, 3)
    for i, j in ((1, 0), (2, 0), (2, 1)):
        lines = panels[i, j].collections[-1].get_paths()
        inside = [path.contains_points(draws[:, [j, i]]).mean() for path in lines]
        # Smoothing widens them a little.
        np.testing.assert_allclose(inside, SHARES[::-1], atol=0.05)
        assert np.all(inside > np.array(SHARES[::-1]) - 0.01)


def test_symbols_have_a_key():
    """Every symbol of a figure is explained by the name that the tables print beside the numbers."""
    names, units = ("sky.depolarisation", "half2.wedge", "own.number"), ("", "deg", "")
    chains = np.random.default_rng(0).standard_normal((2, 20, 4, 3))
    keys = [f"{label(name)}: {name}" for name in names[:2]]
    trace = trace_figure(chains, names, units, 2, np.full(3, 5.0))
    assert [text.get_text() for axes in trace.axes for text in axes.texts[-1:]] == [*keys, ""]
    corner = corner_figure(chains.reshape(-1, 3), names, units)
    (key,) = corner.texts
    assert key.get_text().splitlines() == keys
    corner.draw_without_rendering()
    box = key.get_window_extent()
    drawn = [axes.get_window_extent() for axes in corner.axes if axes.get_frame_on()]
    assert not any(box.overlaps(other) for other in drawn)


def test_every_panel_shows_its_coefficients(draws: np.ndarray):
    figure = corner_figure(draws, NAMES, UNITS, reference=dict(zip(NAMES, (13.5, 0.9, 0.0), strict=True)))
    panels = np.array(figure.axes).reshape(3, 3)
    assert [[axes.get_frame_on() for axes in row] for row in panels] == np.tri(3, dtype=bool).tolist()
    for i in range(3):
        for j in range(i + 1):
            low, high = panels[i, j].get_xlim()
            assert low < draws[:, j].min() < draws[:, j].max() < high
            if i > j:
                low, high = panels[i, j].get_ylim()
                assert low < draws[:, i].min() < draws[:, i].max() < high
    counts = panels[0, 0].patches[0].get_xy()[:, 1]
    assert (
        counts.max() == np.histogram(draws[:, 0], np.unique(panels[0, 0].patches[0].get_xy()[:, 0]))[0].max()
    )
    assert panels[0, 0].get_title(loc="left") == "$w_1$\n13.0 ± 2.0 deg"
    assert [line.get_xdata()[0] for line in panels[2, 1].lines[1:2]] == [0.9]
    assert panels[2, 0].get_xlabel() == "$w_1$ (deg)"
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    assert stream.getvalue().startswith(b"\x89PNG")
    assert pyplot.get_fignums() == []


def test_one_coefficient_and_one_that_never_moved(draws: np.ndarray):
    assert len(corner_figure(draws[:, :1], NAMES, UNITS, reference={NAMES[0]: 13.0}).axes) == 1
    still = draws[:100].copy()
    still[:, 1] = 0.8
    corner_figure(still, NAMES, UNITS).savefig(io.BytesIO(), format="png")


def test_a_corner_plot_shows_what_is_correlated():
    """Ten independent coefficients, two pairs of them replaced by correlated ones."""
    rng = np.random.default_rng(1)
    draws = rng.normal(size=(4000, 10))
    draws[:, 7] = 0.9 * draws[:, 2] + 0.4 * draws[:, 7]
    draws[:, 9] = 0.6 * draws[:, 7] + 0.8 * draws[:, 9]
    names = [f"p{k}" for k in range(10)]
    shown = correlated(draws, names, {})
    assert len(shown) == MOST_IN_CORNER
    assert {"p2", "p7", "p9"} < set(shown)
    assert list(shown) == sorted(shown)
    # That of one which never moved is no correlation.
    draws[:, 4] = 0.0
    assert "p4" not in correlated(draws, names, {})
    # Pictures of a prior are left out, however correlated they are.
    assert "p2" not in correlated(draws, names, {"p2": 1.0})

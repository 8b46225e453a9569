"""Figures of a calibration product: the maps that the file holds, without computing anything anew."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from walop_jax.calibration.records import MatrixMaps, ResidualMap
from walop_jax.io.rounding import two_digits
from walop_jax.reports.matrix_panels import (
    element_kind,
    element_panel,
    element_symbols,
    matrix_panels,
)
from walop_jax.reports.style import (
    DIVERGING,
    SMALL,
    empty_figure,
    field_axes,
    largest_size,
    outer_labels,
)


def matrix_maps_figure(maps: MatrixMaps) -> Figure:
    """The elements of the instrument matrix over the field as `matrix_panels` draws them."""
    figure, axes = _by_arm(maps.values, 8.6, 2.65)
    matrix_panels(figure, axes, maps.values, extent(maps), "nearest")
    return figure


def element_maps_figure(maps: MatrixMaps, kind: int) -> Figure:
    """The elements that Paper II calls by one name (`PAPER_NAMES`): zero offsets, efficiencies or cross-talk."""
    arms = len(maps.values) // 3
    chosen = [i for i in range(len(maps.values)) if element_kind(i, arms) == kind]
    figure = empty_figure(4.0 * max(len(chosen), 1), 3.4)
    axes = figure.subplots(1, max(len(chosen), 1), squeeze=False)
    symbols = element_symbols(arms)
    for axis, i in zip(axes[0], chosen, strict=True):
        element_panel(figure, axis, i, maps.values, extent(maps), "nearest", symbols[i])
    outer_labels(axes)
    return figure


def matrix_errors_figure(maps: MatrixMaps) -> Figure:
    """The standard errors of the elements of the instrument matrix over the field, in per cent, one scale.

    The scale is logarithmic over at most three decades: errors grow steeply at the edge of the field.
    """
    figure, axes = _by_arm(maps.errors, 8.6, 2.3)
    high = 100.0 * largest_size(maps.errors)
    norm = LogNorm(min(max(100.0 * float(maps.errors.min()), 1e-3 * high), 0.5 * high), high, clip=True)
    image = None
    for axis, errors, name in zip(axes.ravel(), maps.errors, element_symbols(len(axes)), strict=True):
        low, most = (two_digits(100.0 * float(value)) for value in (errors.min(), errors.max()))
        field_axes(axis, f"error of {name} (%)\n{low} … {most}")
        image = axis.imshow(
            100.0 * errors,
            origin="lower",
            extent=extent(maps),
            norm=norm,
            cmap="viridis",
            interpolation="nearest",
        )
    assert image is not None
    bar = figure.colorbar(image, ax=axes, pad=0.02)
    bar.set_label("standard error (%)", fontsize=SMALL + 1)
    bar.ax.tick_params(labelsize=SMALL)
    outer_labels(axes)
    return figure


def residual_map_figure(residuals: ResidualMap) -> Figure:
    """What the smooth model leaves of the matrix and of the ratios of the arms (%), and χ²/dof before that correction.

    A row for each arm. The elements share one scale, which the largest corrections but one in a hundred set.
    """
    arms = (len(residuals.values) + 1) // 4
    elements, ratios = residuals.values[: 3 * arms], residuals.values[3 * arms :]
    figure = empty_figure(9.4, 2.0 * arms)
    axes = figure.subplots(arms, 4, sharex=True, sharey=True, squeeze=False)

    def draw(axis: Axes, title: str, values: Float[np.ndarray, "y x"], norm: Normalize, colours: str) -> None:
        field_axes(axis, title)
        image = axis.imshow(
            values, origin="lower", extent=extent(residuals), norm=norm, cmap=colours, interpolation="nearest"
        )
        figure.colorbar(image, ax=axis, pad=0.03, shrink=0.8).ax.tick_params(labelsize=SMALL)

    far = 100.0 * _almost_largest(elements)
    for axis, values, name in zip(axes[:, :3].ravel(), elements, element_symbols(arms), strict=True):
        draw(axis, f"$\\delta${name} (%)", 100.0 * values, Normalize(-far, far), DIVERGING)
    low, high = float(np.nanmin(residuals.chi2)), _almost_largest(residuals.chi2)
    draw(axes[-1, 3], "χ²/dof", residuals.chi2, Normalize(low, high), "viridis")
    # The panels above that of χ² are free for the arms after the first.
    for arm, (axis, ratio) in enumerate(zip(axes[:-1, 3], ratios, strict=True), start=1):
        far = 100.0 * _almost_largest(ratio)
        title = f"N{2 * arm}, N{2 * arm + 1} / N0, N1 (%)"
        draw(axis, title, 100.0 * ratio, Normalize(-far, far), DIVERGING)
    outer_labels(axes)
    return figure


def _almost_largest(values: Float[np.ndarray, ...]) -> float:
    """The size that one value in a hundred exceeds."""
    return max(float(np.nanpercentile(np.abs(values), 99)), 1e-14) if np.isfinite(values).any() else 1.0


def _by_arm(values: Float[np.ndarray, "m y x"], width: float, height: float) -> tuple[Figure, Any]:
    """A blank figure with a row of three panels for each arm; width, and height of a row, in inches."""
    arms = len(values) // 3
    figure = empty_figure(width, height * arms)
    return figure, figure.subplots(arms, 3, sharex=True, sharey=True, squeeze=False)


def extent(maps: MatrixMaps | ResidualMap) -> tuple[float, float, float, float]:
    """Outer edges of the pixels, degrees: left, right, bottom, top."""
    points, grid = maps.grid.points, maps.grid
    half_x, half_y = 0.5 * abs(grid.matrix[0][0]), 0.5 * abs(grid.matrix[1][1])
    x, y = points.x, points.y
    return (
        float(x.min() - half_x), float(x.max() + half_x), float(y.min() - half_y), float(y.max() + half_y),
    )  # fmt: skip

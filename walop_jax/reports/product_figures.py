"""Figures of a calibration product: the maps that the file holds, without computing anything anew."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from walop_jax.calibration.records import SMALLEST_DETERMINANT, MatrixMaps, ResidualMap
from walop_jax.reports.style import (
    DIVERGING,
    FROM_MINUS_ONE_TO_ONE,
    MATRIX_SYMBOLS,
    OFFSETS,
    SMALL,
    empty_figure,
    field_axes,
    largest_size,
    outer_labels,
)


def matrix_maps_figure(maps: MatrixMaps) -> Figure:
    """The six elements of the instrument matrix over the field, offsets in per cent.

    Lines bound the zone where |m22 m33 − m23 m32| < 0.1: a single exposure holds hardly any u there.
    """
    figure = empty_figure(8.6, 4.9)
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    weak = np.abs(maps.values[1] * maps.values[5] - maps.values[2] * maps.values[4])
    for i, axis in enumerate(axes.ravel()):
        values = maps.values[i] * (100.0 if i in OFFSETS else 1.0)
        far = 1.0 if i in FROM_MINUS_ONE_TO_ONE else largest_size(values)
        norm, colours = Normalize(-far, far), DIVERGING
        if i == 1:
            norm, colours = Normalize(float(values.min()), float(values.max())), "viridis"
        field_axes(axis, MATRIX_SYMBOLS[i] + (" (%)" if i in OFFSETS else ""))
        image = axis.imshow(
            values, origin="lower", extent=extent(maps), norm=norm, cmap=colours, interpolation="nearest"
        )
        if i in FROM_MINUS_ONE_TO_ONE and weak.min() < SMALLEST_DETERMINANT < weak.max():
            axis.contour(
                weak, levels=[SMALLEST_DETERMINANT], extent=extent(maps), colors="0.15", linewidths=0.7
            )
        figure.colorbar(image, ax=axis, pad=0.03).ax.tick_params(labelsize=SMALL)
    outer_labels(axes)
    return figure


def matrix_errors_figure(maps: MatrixMaps) -> Figure:
    """The standard errors of the six elements of the instrument matrix over the field, in per cent, one scale.

    The scale is logarithmic over at most three decades: errors grow steeply at the edge of the field.
    """
    figure = empty_figure(8.6, 4.6)
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    high = 100.0 * largest_size(maps.errors)
    norm = LogNorm(min(max(100.0 * float(maps.errors.min()), 1e-3 * high), 0.5 * high), high, clip=True)
    image = None
    for axis, errors, name in zip(axes.ravel(), maps.errors, MATRIX_SYMBOLS, strict=True):
        field_axes(axis, f"error of {name}")
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
    """What the smooth model leaves of the matrix and of the ratio of the pairs (%), and χ²/dof before that correction.

    The six elements share one scale, which the median error and the largest corrections but one in a hundred set.
    """
    figure = empty_figure(9.4, 4.0)
    axes = figure.subplots(2, 4, sharex=True, sharey=True)
    titles = (*(f"$\\delta${name} (%)" for name in MATRIX_SYMBOLS), "N2, N3 / N0, N1 (%)", "χ²/dof")
    # Row by row: the three elements of a pair, then the other quantity.
    order = (0, 1, 2, 6, 3, 4, 5, 7)
    matrix = 100.0 * np.abs(residuals.values[:6])
    for axis, i in zip(axes.ravel(), order, strict=True):
        values = residuals.chi2 if i == 7 else 100.0 * residuals.values[i]
        shown = matrix if i < 6 else np.abs(values)
        far = max(float(np.nanpercentile(shown, 99)), 1e-12) if np.isfinite(shown).any() else 1.0
        norm, colours = Normalize(-far, far), DIVERGING
        if i == 7:
            norm, colours = Normalize(float(np.nanmin(values)), far), "viridis"
        field_axes(axis, titles[i])
        image = axis.imshow(
            values, origin="lower", extent=extent(residuals), norm=norm, cmap=colours, interpolation="nearest"
        )
        figure.colorbar(image, ax=axis, pad=0.03, shrink=0.8).ax.tick_params(labelsize=SMALL)
    outer_labels(axes)
    return figure


def extent(maps: MatrixMaps | ResidualMap) -> tuple[float, float, float, float]:
    """Outer edges of the pixels, degrees: left, right, bottom, top."""
    points, grid = maps.grid.points, maps.grid
    half_x, half_y = 0.5 * abs(grid.matrix[0][0]), 0.5 * abs(grid.matrix[1][1])
    x, y = points.x, points.y
    return (
        float(x.min() - half_x), float(x.max() + half_x), float(y.min() - half_y), float(y.max() + half_y),
    )  # fmt: skip

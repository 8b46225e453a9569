"""Figures of a calibration and of a fit: plain `matplotlib` figures, to show in a notebook or to `savefig`.

No figure touches the global state of matplotlib, so they may be made in threads and without a screen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import MatrixMaps, ResidualMap
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.refit import FitResult
from walop_jax.io.text import two_digits, with_minus_sign
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.reports.style import (
    AFTER,
    DIVERGING,
    FONT,
    SMALL,
    element_kind,
    element_panel,
    element_symbols,
    empty_figure,
    field_axes,
    largest_size,
    matrix_panels,
    outer_labels,
    plain_numbers,
)
from walop_jax.science.field_accuracy import FieldAccuracy
from walop_jax.science.star_errors import GOAL

PIXELS = 61  # along each axis of a map


def matrix_figure(calibration: Calibration, settings: Settings | None = None) -> Figure:
    """Maps of the elements of the instrument matrix over the calibrated field, as `matrix_panels` draws them.

    `settings` has one row (default: SDSS-r, flat spectrum, calibration plate out).
    """
    arms = len(calibration.model.template.arms)
    figure = empty_figure(7.4, 2.3 * arms)
    axes = figure.subplots(arms, 3, sharex=True, sharey=True, squeeze=False)
    _matrix_maps(figure, axes, calibration, settings)
    return figure


def residual_figure(result: FitResult, before: Float[np.ndarray, " n"] | None = None) -> Figure:
    """`residuals_figure` of a fit in memory; `before` defaults to the start values of its model."""
    start = result.model.start if before is None else before
    return residuals_figure(result.likelihood, result.values, start)


def residuals_figure(
    likelihood: Likelihood, values: Float[np.ndarray, " n"], before: Float[np.ndarray, " n"]
) -> Figure:
    """Residuals of every field point before and after a fit, full vectors of parameters; a histogram of the latter."""
    figure = empty_figure(9.6, 3.2)
    left, middle, right = figure.subplots(1, 3)
    maps = [point_residuals(likelihood, one) for one in (before, values)]
    norm = LogNorm(0.7, max(2.0, float(np.nanmax(maps[0]))))
    field_axes(left, "before the fit")
    field_axes(middle, "after the fit")
    _tiles(left, likelihood, maps[0], norm)
    bar = figure.colorbar(_tiles(middle, likelihood, maps[1], norm), ax=[left, middle], pad=0.02)
    bar.set_label("rms residual (σ)", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    middle.set_ylabel("")
    _histogram(right, likelihood, values)
    return figure


def calibration_figure(
    result: FitResult,
    before: Float[np.ndarray, " n"] | None = None,
    settings: Settings | None = None,
) -> Figure:
    """A calibration on one page: maps of the matrix, and what the fit has left of the residuals.

    `before` is a full vector of parameter values to compare with (default: the start values of the model).
    """
    calibration, arms = Calibration.from_fit(result), len(result.model.template.arms)
    figure = empty_figure(10.2, 4.7)
    grid = figure.add_gridspec(max(2, arms), 4)
    panels = [figure.add_subplot(grid[i, j]) for i in range(arms) for j in range(3)]
    _matrix_maps(figure, panels, calibration, settings)
    right = [figure.add_subplot(grid[i, 3]) for i in range(2)]
    start = result.model.start if before is None else before
    for axis, values, title in zip(
        right,
        (start, result.values),
        ("residuals, as designed", "residuals, as fitted"),
        strict=True,
    ):
        residual = point_residuals(result.likelihood, values)
        far = float(np.nanmax(residual)) > 3.0
        low, high = (float(edge(residual)) for edge in (np.nanmin, np.nanmax))
        field_axes(axis, title)
        shown = _tiles(
            axis, result.likelihood, residual, Normalize(low, high) if far else Normalize(0.7, 1.3)
        )
        bar = figure.colorbar(shown, ax=axis, pad=0.03, extend="neither" if far else "both")
        bar.set_label("rms residual (σ)", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    outer_labels(right)
    return figure


def point_residuals(likelihood: Likelihood, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " p"]:
    """Rms normalised residual of each field point; 1 is what noise alone gives (the flux took one in four).

    NaN where a point has no data.
    """
    _, residual = likelihood.residuals(values)
    freedom = (likelihood.used * likelihood.data_per_row).sum(axis=1)
    square = (residual**2).sum(axis=(1, 2))
    return np.sqrt(np.where(freedom > 0, square / np.maximum(freedom, 1.0), np.nan))


def _matrix_maps(figure: Figure, axes: Any, calibration: Calibration, settings: Settings | None) -> None:
    low_x, high_x, low_y, high_y = calibration.field
    x, y = np.meshgrid(np.linspace(low_x, high_x, PIXELS), np.linspace(low_y, high_y, PIXELS))
    one = settings or calibration.usual_settings()
    matrix, _ = calibration.matrix(x.ravel(), y.ravel(), one[np.zeros(x.size, int)])
    matrix_panels(figure, axes, matrix.T.reshape(-1, *x.shape), calibration.field, "bilinear")


def _tiles(axis: Axes, likelihood: Likelihood, values: Float[np.ndarray, " p"], norm: Normalize) -> Any:
    """Field points as tiles; the places of the standards, which lie between the others, are left out."""
    points, extended = likelihood.calset.points, likelihood.calset.exposures.kind != "standard"
    tiles = likelihood.used[:, extended].any(axis=1)
    tiles = tiles if tiles.any() else np.ones(len(points), bool)
    x, y = points.x[tiles], points.y[tiles]
    tile = max(float(np.ptp(x)), float(np.ptp(y)), 1e-3) / max(np.sqrt(tiles.sum()) - 1.0, 1.0)
    corners = [(a - 0.5 * tile, b - 0.5 * tile) for a, b in zip(x, y, strict=True)]
    shown = PatchCollection([Rectangle(corner, tile, tile) for corner in corners], cmap="magma_r", norm=norm)
    shown.set_array(values[tiles])
    axis.add_collection(shown)
    axis.set_xlim(x.min() - tile, x.max() + tile)
    axis.set_ylim(y.min() - tile, y.max() + tile)
    return shown


def _histogram(axis: Axes, likelihood: Likelihood, values: Float[np.ndarray, " n"]) -> None:
    """All residuals of a fit beside what noise alone would give."""
    _, residual = likelihood.residuals(values)
    used = residual[likelihood.used].ravel()
    width = np.sqrt(np.mean(likelihood.data_per_row[np.nonzero(likelihood.used)[1]]) / likelihood.cameras)
    edges = np.linspace(-4.0, 4.0, 41)
    each = np.full(
        used.size, 1.0 / (used.size * (edges[1] - edges[0]))
    )  # those beyond the axis count as well
    axis.hist(used / width, bins=edges.tolist(), weights=each, color="0.75", label="residuals")
    beyond = float(np.mean(np.abs(used / width) > edges[-1]))
    if beyond > 0:
        said = f"{two_digits(100.0 * beyond)} % beyond ±{edges[-1]:g}"
        axis.text(0.03, 0.97, said, transform=axis.transAxes, va="top", fontsize=7)
    t = np.linspace(-4.0, 4.0, 201)
    axis.plot(t, np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi), color="C3", lw=1.2, label="noise alone")
    axis.set_xlabel("residual / its expected width", fontsize=FONT)
    axis.set_ylabel("density", fontsize=FONT)
    axis.tick_params(labelsize=7)
    axis.legend(frameon=False, fontsize=8)


def modulation_figure(calset: CalibrationSet, points: Sequence[int]) -> Figure:
    """Signals of the arms behind the calibration polariser against its angle, at some field points.

    `points` are rows of `calset.points`. Only exposures with the polariser in and the calibration plate out are shown.
    Two arms measure q_m and u_m; an ideal instrument would follow cos 2θ and sin 2θ, the grey lines.
    """
    e = calset.exposures
    shown = np.flatnonzero(e.clp_in & ~e.chwp_in)
    block = calset.intensities.block(0, len(calset.points))
    arms = block.counts.shape[-1] // 2
    figure = empty_figure(4.1 * arms, 3.2)
    angle = np.linspace(0.0, 360.0, 181)
    row = figure.subplots(1, arms, sharex=True, sharey=True, squeeze=False)[0]
    for arm, axis in enumerate(row):
        pair, name = 2 * arm, f"(N{2 * arm} − N{2 * arm + 1}) / (N{2 * arm} + N{2 * arm + 1})"
        if arms == 2:
            name, ideal = (("$q_m$", np.cos), ("$u_m$", np.sin))[arm]
            axis.plot(angle, ideal(2 * np.deg2rad(angle)), color="0.8", lw=1.0, zorder=0)
        for k, point in enumerate(points):
            rows = shown[block.used[point, shown]]
            first, second = block.counts[point, rows, pair], block.counts[point, rows, pair + 1]
            where = with_minus_sign(f"({block.x[point]:+.2f}°, {block.y[point]:+.2f}°)")
            axis.plot(
                e.clp_angle[rows], (first - second) / (first + second), "os^Dv"[k % 5], ms=4, label=where
            )
        axis.set_xlabel("polariser angle (deg)", fontsize=FONT)
        axis.set_ylabel(name, fontsize=FONT)
        axis.set_xticks(np.arange(0, 361, 90))
        axis.tick_params(labelsize=7)
    figure.axes[0].legend(frameon=False, fontsize=7, title="(X, Y)", title_fontsize=7)
    return figure


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
    """Residuals of the matrix and of the ratios of the arms (%), and χ²/dof before that correction.

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


_RANGE = (1e-4, 3.0)  # per cent


def accuracy_figure(accuracy: FieldAccuracy) -> Figure:
    """The error of p over the field (%, logarithmic; a line at 0.1 %), and its histogram."""
    percent = np.clip(100.0 * np.nan_to_num(accuracy.error, nan=np.inf), *_RANGE)
    figure = empty_figure(8.2, 3.4)
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    low, high = float(percent.min()), float(percent.max())
    norm = LogNorm(low, max(high, 1.5 * low))
    field_axes(left, f"error of p, {accuracy.filter}")
    image = left.imshow(
        percent, origin="lower", extent=accuracy.extent, norm=norm, cmap="viridis", interpolation="nearest"
    )
    if low < 100.0 * GOAL < high:
        left.contour(percent, [100.0 * GOAL], extent=accuracy.extent, colors="w", linewidths=1.2)
    bar = figure.colorbar(image, ax=left, pad=0.03)
    bar.set_label("standard error (%)", fontsize=SMALL + 1)
    bar.ax.tick_params(labelsize=SMALL, which="both")
    edges = np.geomspace(0.8 * low, 1.25 * high, 37)
    right.hist(percent.ravel(), edges.tolist(), color=AFTER, alpha=0.75)
    right.axvline(100.0 * GOAL, color="0.3", lw=1.0, ls="--")
    right.text(
        100.0 * GOAL, 1.01, " goal 0.1 %", fontsize=SMALL, transform=right.get_xaxis_transform(), va="bottom"
    )
    right.set_xscale("log")
    for scale in (bar.ax.yaxis, right.xaxis):
        scale.set_major_formatter(plain_numbers())
    right.set_xlim(edges[0], max(edges[-1], 150.0 * GOAL))
    right.set_xlabel("standard error of p (%)", fontsize=FONT)
    right.set_ylabel("points of the map", fontsize=FONT)
    right.tick_params(labelsize=SMALL)
    return figure

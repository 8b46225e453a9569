"""Figures of a calibration. They are plain `matplotlib` figures: show them in a notebook, or `savefig` them.

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
from walop_jax.calibration.records import SMALLEST_DETERMINANT
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.refit import FitResult
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.reports.style import (
    FONT,
    FROM_MINUS_ONE_TO_ONE,
    MATRIX_SYMBOLS,
    OFFSETS,
    empty_figure,
    field_axes,
    outer_labels,
)

Map = Float[np.ndarray, "y x"]

PIXELS = 61  # along each axis of a map


def matrix_figure(calibration: Calibration, settings: Settings | None = None) -> Figure:
    """Maps of the six elements of the instrument matrix over the calibrated field.

    `settings` has one row (default: SDSS-r, flat spectrum, calibration plate out). Lines in m32 and m33 bound
    the zone where |m22 m33 − m23 m32| < 0.1: a single exposure holds hardly any u there.
    """
    figure = empty_figure(7.4, 4.6)
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    _matrix_maps(figure, axes, calibration, settings)
    return figure


def residual_figure(result: FitResult, before: Float[np.ndarray, " n"] | None = None) -> Figure:
    """Residuals of every field point before and after a fit; a histogram of the latter.

    `before` is a full vector of parameter values (default: the start values of the model).
    """
    likelihood = result.likelihood
    start = result.model.start if before is None else before
    figure = empty_figure(9.6, 3.2)
    left, middle, right = figure.subplots(1, 3)
    maps = [point_residuals(likelihood, values) for values in (start, result.values)]
    norm = LogNorm(0.7, max(2.0, float(np.nanmax(maps[0]))))
    field_axes(left, "before the fit")
    field_axes(middle, "after the fit")
    _tiles(left, likelihood, maps[0], norm)
    bar = figure.colorbar(_tiles(middle, likelihood, maps[1], norm), ax=[left, middle], pad=0.02)
    bar.set_label("rms residual (σ)", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    middle.set_ylabel("")
    _histogram(right, likelihood, result.values)
    return figure


def calibration_figure(
    result: FitResult,
    before: Float[np.ndarray, " n"] | None = None,
    settings: Settings | None = None,
) -> Figure:
    """A calibration on one page: maps of the matrix, and what the fit has left of the residuals.

    `before` is a full vector of parameter values to compare with (default: the start values of the model).
    """
    figure = empty_figure(10.2, 4.7)
    grid = figure.subplots(2, 4)
    _matrix_maps(figure, grid[:, :3], Calibration.from_fit(result), settings)
    start = result.model.start if before is None else before
    for axis, values, title in zip(
        grid[:, 3],
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
    outer_labels(grid)
    return figure


def point_residuals(likelihood: Likelihood, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " p"]:
    """Rms normalised residual of each field point; 1 is what noise alone gives (the flux took one in four).

    NaN where a point has no data.
    """
    _, residual = likelihood.residuals(values)
    freedom = (likelihood.used * np.where(likelihood.flux_known, 4.0, 3.0)).sum(axis=1)
    square = (residual**2).sum(axis=(1, 2))
    return np.sqrt(np.where(freedom > 0, square / np.maximum(freedom, 1.0), np.nan))


def _matrix_maps(figure: Figure, axes: Any, calibration: Calibration, settings: Settings | None) -> None:
    low_x, high_x, low_y, high_y = calibration.field
    x, y = np.meshgrid(np.linspace(low_x, high_x, PIXELS), np.linspace(low_y, high_y, PIXELS))
    one = settings or calibration.usual_settings()
    rows = one[np.zeros(x.size, int)]
    matrix, _ = calibration.matrix(x.ravel(), y.ravel(), rows)
    maps = matrix.T.reshape(6, *x.shape)
    weak = np.abs(maps[1] * maps[5] - maps[2] * maps[4])
    for i, axis in enumerate(np.ravel(axes)):
        shown = maps[i] * (100.0 if i in OFFSETS else 1.0)
        name = MATRIX_SYMBOLS[i] + (" (%)" if i in OFFSETS else "")
        field_axes(axis, name)
        image = _image(axis, shown, calibration.field, i)
        if i >= 4:
            axis.contour(x, y, weak, levels=[SMALLEST_DETERMINANT], colors="0.15", linewidths=0.7)
        figure.colorbar(image, ax=axis, pad=0.03).ax.tick_params(labelsize=7)
    outer_labels(axes)


def _image(axis: Axes, values: Map, field: tuple[float, float, float, float], element: int) -> Any:
    if element == 1:
        norm, colours = Normalize(float(values.min()), float(values.max())), "viridis"
    else:
        far = 1.0 if element in FROM_MINUS_ONE_TO_ONE else float(np.abs(values).max())
        norm, colours = Normalize(-far, far), "RdBu_r"
    return axis.imshow(
        values,
        origin="lower",
        extent=field,
        norm=norm,
        cmap=colours,
        interpolation="bilinear",
        aspect="equal",
    )


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
    width = np.sqrt(np.mean(np.where(likelihood.flux_known, 1.0, 0.75)[np.nonzero(likelihood.used)[1]]))
    edges = np.linspace(-4.0, 4.0, 41)
    axis.hist(
        np.clip(used / width, -4.0, 4.0), bins=edges.tolist(), density=True, color="0.75", label="residuals"
    )
    t = np.linspace(-4.0, 4.0, 201)
    axis.plot(t, np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi), color="C3", lw=1.2, label="noise alone")
    axis.set_xlabel("residual / its expected width", fontsize=FONT)
    axis.set_ylabel("density", fontsize=FONT)
    axis.tick_params(labelsize=7)
    axis.legend(frameon=False, fontsize=8)


def modulation_figure(calset: CalibrationSet, points: Sequence[int]) -> Figure:
    """Measured q_m and u_m behind the calibration polariser against its angle, at some field points.

    `points` are rows of `calset.points`. Only exposures with the polariser in and the calibration plate out
    are shown; an ideal instrument would follow cos 2θ and sin 2θ, the grey lines.
    """
    e = calset.exposures
    shown = np.flatnonzero(e.clp_in & ~e.chwp_in)
    block = calset.intensities.block(0, len(calset.points))
    figure = empty_figure(8.2, 3.2)
    angle = np.linspace(0.0, 360.0, 181)
    for axis, pair, name, ideal in zip(
        figure.subplots(1, 2, sharex=True, sharey=True), (0, 2), "qu", (np.cos, np.sin), strict=True
    ):
        axis.plot(angle, ideal(2 * np.deg2rad(angle)), color="0.8", lw=1.0, zorder=0)
        for k, point in enumerate(points):
            rows = shown[block.used[point, shown]]
            first, second = block.counts[point, rows, pair], block.counts[point, rows, pair + 1]
            where = f"({block.x[point]:+.2f}°, {block.y[point]:+.2f}°)"
            axis.plot(
                e.clp_angle[rows], (first - second) / (first + second), "os^Dv"[k % 5], ms=4, label=where
            )
        axis.set_xlabel("polariser angle (deg)", fontsize=FONT)
        axis.set_ylabel(f"${name}_m$", fontsize=FONT)
        axis.set_xticks(np.arange(0, 361, 90))
        axis.tick_params(labelsize=7)
    figure.axes[0].legend(frameon=False, fontsize=7, title="(X, Y)", title_fontsize=7)
    return figure

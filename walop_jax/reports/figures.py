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
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.refit import FitResult
from walop_jax.io.rounding import two_digits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.reports.matrix_panels import matrix_panels
from walop_jax.reports.style import (
    FONT,
    empty_figure,
    field_axes,
    outer_labels,
)

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
    """What the arms measure behind the calibration polariser against its angle, at some field points.

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
            where = f"({block.x[point]:+.2f}°, {block.y[point]:+.2f}°)"
            axis.plot(
                e.clp_angle[rows], (first - second) / (first + second), "os^Dv"[k % 5], ms=4, label=where
            )
        axis.set_xlabel("polariser angle (deg)", fontsize=FONT)
        axis.set_ylabel(name, fontsize=FONT)
        axis.set_xticks(np.arange(0, 361, 90))
        axis.tick_params(labelsize=7)
    figure.axes[0].legend(frameon=False, fontsize=7, title="(X, Y)", title_fontsize=7)
    return figure

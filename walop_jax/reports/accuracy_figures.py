"""Figures of how well p is known over the field."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from walop_jax.reports.style import AFTER, FONT, SMALL, empty_figure, field_axes, plain_numbers
from walop_jax.science.field_accuracy import FieldAccuracy
from walop_jax.science.star_errors import GOAL

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

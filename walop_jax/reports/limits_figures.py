"""Figures of what a set can show: what goes unnoticed over the field, and which effects look alike."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import BoundaryNorm, LogNorm
from matplotlib.figure import Figure

from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.diagnosis.policy import POLICY
from walop_jax.reports.style import FONT, QUIET, SMALL, empty_figure, field_axes, plain_numbers

_STEPS = (0.0, 1.0, 2.0, POLICY.separation, 4.0, 5.0, 6.0)


def protection_figure(found: DetectionLimits) -> Figure:
    """Largest error of q and u over the field that a single effect can make without being detected."""
    figure = empty_figure(5.0, 3.8)
    axis = figure.subplots()
    good = np.isfinite(found.protection)
    if not good.any():
        axis.text(0.5, 0.5, "one exposure does not give q and u", ha="center", transform=axis.transAxes)
        axis.set_axis_off()
        return figure
    field_axes(axis, "largest error that goes undetected")
    percent = 100 * found.protection[good]
    norm = LogNorm(percent.min(), max(percent.max(), 1.2 * percent.min()))
    side = 100.0 / np.sqrt(max(len(found.x), 16))
    shown = axis.scatter(
        found.x[good], found.y[good], c=percent, s=side**2, marker="s", cmap="viridis", norm=norm
    )
    bar = figure.colorbar(shown, ax=axis, pad=0.03)
    bar.set_label("error of q, u (%)", fontsize=SMALL + 1)
    for which in (bar.ax.yaxis.set_major_formatter, bar.ax.yaxis.set_minor_formatter):
        which(plain_numbers())
    bar.ax.tick_params(labelsize=SMALL, which="both")
    if (~good).any():
        axis.plot(found.x[~good], found.y[~good], "x", color=QUIET, ms=4)
        axis.set_xlabel("X (deg); crosses: one exposure does not give q and u", fontsize=FONT)
    return figure


def separation_figure(found: DetectionLimits) -> Figure:
    """How far each effect (column) stays from each other one (row) when that is just detected, in σ."""
    count = len(found.effects)
    size = max(3.0, 0.17 * count)
    figure = empty_figure(size + 2.2, size + 1.2)
    axis = figure.subplots()
    norm = BoundaryNorm(_STEPS, 256, extend="max")
    shown = axis.imshow(found.separation, norm=norm, cmap="RdYlBu")
    axis.set_xticks(range(count), found.effects, rotation=90, fontsize=SMALL)
    axis.set_yticks(range(count), found.effects, fontsize=SMALL)
    axis.set_ylabel("just detected", fontsize=FONT)
    axis.set_xlabel("does its best to look alike", fontsize=FONT)
    bar = figure.colorbar(shown, ax=axis, shrink=0.7)
    bar.set_label(
        f"separation (σ); below {POLICY.separation:g} one may be taken for the other", fontsize=SMALL + 1
    )
    bar.ax.tick_params(labelsize=SMALL)
    return figure

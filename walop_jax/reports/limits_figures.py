"""Figures of what a set can show: what goes unnoticed over the field, and which effects look alike."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from walop_jax.diagnosis.detection_limits import DetectionLimits
from walop_jax.diagnosis.naming import SEPARATION

_STEPS = (0.0, 1.0, 2.0, SEPARATION, 4.0, 5.0, 6.0)


def protection_figure(found: DetectionLimits) -> Figure:
    """Largest error of q and u over the field that a single effect can make without being detected."""
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    axis = figure.subplots()
    good = np.isfinite(found.protection)
    if not good.any():
        axis.text(0.5, 0.5, "one exposure does not give q and u", ha="center", transform=axis.transAxes)
        axis.set_axis_off()
        return figure
    shown = axis.scatter(
        found.x[good], found.y[good], c=100 * found.protection[good], s=40, marker="s", cmap="viridis"
    )
    figure.colorbar(shown, ax=axis, label="largest undetected error of q, u (%)")
    if (~good).any():
        axis.plot(found.x[~good], found.y[~good], "x", color="0.6", ms=4)
    axis.set_aspect("equal")
    axis.set_xlabel("X (deg)")
    axis.set_ylabel("Y (deg)")
    return figure


def separation_figure(found: DetectionLimits) -> Figure:
    """How far each effect (column) stays from each other one (row) when that is just detected, in σ."""
    count = len(found.effects)
    size = max(4.0, 0.27 * count)
    figure = Figure(figsize=(size + 2.4, size + 1.6), layout="constrained")
    axis = figure.subplots()
    norm = BoundaryNorm(_STEPS, 256, extend="max")
    shown = axis.imshow(found.separation, norm=norm, cmap="RdYlBu")
    axis.set_xticks(range(count), found.effects, rotation=90, fontsize=7)
    axis.set_yticks(range(count), found.effects, fontsize=7)
    axis.set_ylabel("just detected")
    axis.set_xlabel("does its best to look alike")
    figure.colorbar(
        shown,
        ax=axis,
        label=f"separation (σ); below {SEPARATION:g} one may be taken for the other",
        shrink=0.7,
    )
    return figure

"""What all figures share: sizes, colours, blank figures and axes of the field."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter

FONT = 9
SMALL = 7
DIVERGING = "RdBu_r"
BEFORE = "#b2182b"  # dark enough to be told from AFTER in grey as well; both are ends of DIVERGING
AFTER = "#2166ac"
QUIET = "0.8"


def empty_figure(width: float, height: float) -> Figure:
    """An empty figure, sizes in inches."""
    layout = ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.05)
    return Figure(figsize=(width, height), dpi=120, layout=layout)


def field_axes(axis: Axes, title: str) -> None:
    """Make axes a map of the field."""
    axis.set_title(title, fontsize=FONT)
    axis.set_xlabel("X (deg)", fontsize=FONT)
    axis.set_ylabel("Y (deg)", fontsize=FONT)
    axis.tick_params(labelsize=SMALL)
    axis.set_aspect("equal")


def plain_numbers() -> FuncFormatter:
    """Ticks of a logarithmic scale as numbers instead of powers: 0.1, 1; a formatter serves one axis only."""
    return FuncFormatter(lambda value, _: f"{value:g}")


def outer_labels(axes: Any) -> None:
    """Keep the labels of a grid of maps on its outer edge only."""
    for axis in np.ravel(axes):
        axis.tick_params(labelsize=SMALL)
        axis.set_xlabel("X (deg)", fontsize=FONT)
        axis.set_ylabel("Y (deg)", fontsize=FONT)
        axis.label_outer()


def largest_size(*maps: Any) -> float:
    """The largest size of any finite value: the end of a symmetric scale that all of the maps share."""
    sizes = [np.abs(values[np.isfinite(values)]) for values in map(np.asarray, maps)]
    return max((float(one.max()) for one in sizes if one.size), default=0.0) or 1.0

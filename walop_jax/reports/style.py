"""Common parts of figures: sizes, colours, blank figures, axes of the field, panels of the instrument matrix."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, ScalarFormatter

from walop_jax.calibration.matrix import SMALLEST_DETERMINANT
from walop_jax.io.text import with_minus_sign

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


Map = Float[np.ndarray, "y x"]
Maps = Float[np.ndarray, "m y x"]
Extent = tuple[float, float, float, float]


def element_symbols(arms: int) -> tuple[str, ...]:
    """m21, m22, m23 of the first arm, m31, … of the second, as matplotlib writes mathematics."""
    return tuple(f"$m_{{{2 + arm}{column}}}$" for arm in range(arms) for column in (1, 2, 3))


PAPER_NAMES = ("zero offset", "efficiency", "cross-talk")
"""Names in Paper II of the elements of the arm that measures q: m21, m22, m23; those of u are m31, m33, m32."""


def element_kind(element: int, arms: int) -> int:
    """Place in `PAPER_NAMES` of an element of the matrix; with a single arm nothing is the cross-talk of another."""
    arm, column = divmod(element, 3)
    if column == 0 or arms != 2:
        return min(column, 1)
    return 1 if column == arm + 1 else 2


def matrix_panels(figure: Figure, axes: Any, maps: Maps, extent: Extent, interpolation: str) -> None:
    """Draw the elements over the field, zero offsets in per cent, each on a scale of its own that its title tells.

    Of two arms lines in the second row bound the zone where |m22 m33 − m23 m32| < 0.1: a single exposure carries
    almost no information on u there. `extent` is left, right, bottom and top in degrees.
    """
    arms = len(maps) // 3
    weak = np.abs(maps[1] * maps[5] - maps[2] * maps[4]) if arms == 2 else None
    for i, (axis, name) in enumerate(zip(np.ravel(axes), element_symbols(arms), strict=True)):
        element_panel(figure, axis, i, maps, extent, interpolation, name)
        if weak is not None and i > 3 and weak.min() < SMALLEST_DETERMINANT < weak.max():
            axis.contour(weak, levels=[SMALLEST_DETERMINANT], extent=extent, colors="0.15", linewidths=0.7)
    outer_labels(axes)


def element_panel(
    figure: Figure, axis: Axes, i: int, maps: Maps, extent: Extent, interpolation: str, name: str
) -> None:
    """One element of the matrix over the field on a scale of its own, zero offsets in per cent."""
    kind = element_kind(i, len(maps) // 3)
    values = maps[i] if kind else 100.0 * maps[i]
    low, high = float(values.min()), float(values.max())
    span = f"{_short(low, high - low)} … {_short(high, high - low)}"
    field_axes(axis, f"{PAPER_NAMES[kind]} {name}{'' if kind else ' (%)'}\n{span}")
    image = _image(axis, values, extent, interpolation)
    bar = figure.colorbar(image, ax=axis, pad=0.03)
    bar.ax.tick_params(labelsize=SMALL)
    bar.ax.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))


def _short(value: float, span: float) -> str:
    """A number to three digits of the span that it bounds."""
    places = 2 if span <= 0 else max(0, 2 - math.floor(math.log10(span)))
    return with_minus_sign(f"{value:.{min(places, 7)}f}")


def _image(axis: Axes, values: Map, extent: Extent, interpolation: str) -> Any:
    """Values of both signs on a scale with white at zero, others from the smallest to the largest."""
    low, high = float(values.min()), float(values.max())
    norm, colours = Normalize(low, high), "viridis"
    if low < 0 < high:
        far = largest_size(values)
        norm, colours = Normalize(-far, far), DIVERGING
    return axis.imshow(
        values, origin="lower", extent=extent, norm=norm, cmap=colours, interpolation=interpolation
    )

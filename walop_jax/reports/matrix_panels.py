"""Panels of the instrument matrix: a row for each arm, zero point, and response to q and to u."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from walop_jax.calibration.records import SMALLEST_DETERMINANT
from walop_jax.reports.style import DIVERGING, SMALL, field_axes, largest_size, outer_labels

Map = Float[np.ndarray, "y x"]
Maps = Float[np.ndarray, "m y x"]
Extent = tuple[float, float, float, float]


def element_symbols(arms: int) -> tuple[str, ...]:
    """m21, m22, m23 of the first arm, m31, … of the second, as matplotlib writes mathematics."""
    return tuple(f"$m_{{{2 + arm}{column}}}$" for arm in range(arms) for column in (1, 2, 3))


def matrix_panels(figure: Figure, axes: Any, maps: Maps, extent: Extent, interpolation: str) -> None:
    """Draw the elements over the field, zero points in per cent.

    Of two arms lines in the second row bound the zone where |m22 m33 − m23 m32| < 0.1: a single exposure holds hardly
    any u there. `extent` is left, right, bottom and top in degrees.
    """
    arms = len(maps) // 3
    weak = np.abs(maps[1] * maps[5] - maps[2] * maps[4]) if arms == 2 else None
    for i, (axis, name) in enumerate(zip(np.ravel(axes), element_symbols(arms), strict=True)):
        field_axes(axis, name + ("" if i % 3 else " (%)"))
        values = maps[i] if i % 3 else 100.0 * maps[i]
        image = _image(axis, values, extent, interpolation, zero_point=i % 3 == 0)
        if weak is not None and i > 3 and weak.min() < SMALLEST_DETERMINANT < weak.max():
            axis.contour(weak, levels=[SMALLEST_DETERMINANT], extent=extent, colors="0.15", linewidths=0.7)
        figure.colorbar(image, ax=axis, pad=0.03).ax.tick_params(labelsize=SMALL)
    outer_labels(axes)


def _image(axis: Axes, values: Map, extent: Extent, interpolation: str, *, zero_point: bool) -> Any:
    low, high, far = float(values.min()), float(values.max()), largest_size(values)
    norm, colours = Normalize(-far, far), DIVERGING
    if not zero_point and far > 0.5:
        # A response that changes over the field goes from −1 to 1; one that hardly does shows its own range.
        norm = Normalize(-1.0, 1.0)
        if high - low < 0.2 * far:
            norm, colours = Normalize(low, high), "viridis"
    return axis.imshow(
        values, origin="lower", extent=extent, norm=norm, cmap=colours, interpolation=interpolation
    )

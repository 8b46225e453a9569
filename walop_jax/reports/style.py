"""Common parts of figures: where they are drawn, sizes, colours, maps of the field, panels of the instrument matrix."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullLocator, ScalarFormatter

from walop_jax.calibration.thresholds import SMALLEST_DETERMINANT
from walop_jax.io.text import with_minus_sign

FONT = 9
SMALL = 7
DIVERGING = "RdBu_r"
SEQUENTIAL = "viridis"
PLATES = {"half1.plate": "HWP1", "half2.plate": "HWP2"}
BEFORE = "#b2182b"  # dark enough to be told from AFTER in grey as well; both are ends of DIVERGING
AFTER = "#2166ac"
QUIET = "0.8"
MOST_VECTOR = 2000  # points above which tiles are drawn as pixels
SETTINGS: dict[Any, Any] = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.hashsalt": "walop-jax"}
"""Beside the defaults of matplotlib; without the last no two pages of a run are the same."""

P = ParamSpec("P")
T = TypeVar("T")
Map = Float[np.ndarray, "y x"]
Maps = Float[np.ndarray, "m y x"]
Field = tuple[float, float, float, float]
AnyFigure = Any
"""A figure, or the subfigure that took the room of axes: what is drawn on a `Canvas`."""


def own_style() -> contextlib.AbstractContextManager[None]:
    """Settings of matplotlib as this package draws with, whatever a matplotlibrc or a notebook has set."""
    return matplotlib.style.context(["default", SETTINGS])


class PaperFigure(Figure):
    """A figure that is drawn in the style of the package, and written with TrueType fonts (PDF, PostScript).

    Journals refuse Type 3, matplotlib's default.
    """

    def savefig(self, *args: Any, **options: Any) -> None:
        """Write the figure, as any other."""
        with own_style():
            super().savefig(*args, **options)

    def draw(self, renderer: Any) -> None:
        """Draw the figure, as any other."""
        with own_style():
            super().draw(renderer)


@dataclasses.dataclass(frozen=True)
class Canvas:
    """Place of a figure: one of its own, of its usual size or of `figsize` (inches), or in place of `ax`.

    Figures of several panels take the room of `ax`, which goes, as a subfigure.
    """

    ax: Axes | None = None
    figsize: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.ax, Axes | None):
            kind = type(self.ax).__name__
            raise TypeError(f"ax: give one Axes of matplotlib, for instance ax=axes[0, 0], not {kind}")

    def figure(self, width: float, height: float) -> Any:
        """An empty figure; usual sizes in inches. Raises ValueError for axes that stand in no grid."""
        if self.ax is None:
            layout = ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.05)
            return PaperFigure(figsize=self.figsize or (width, height), dpi=120, layout=layout)
        place, parent = self.ax.get_subplotspec(), self.ax.get_figure()
        if place is None or not isinstance(parent, Figure | SubFigure):
            raise ValueError("ax: give axes made by subplots, so that there is a place to draw in")
        self.ax.remove()
        return parent.add_subfigure(place)

    def panels(self, width: float, height: float, *shape: int, **options: Any) -> tuple[Any, Any]:
        """A figure, and panels in it with small numbers, as `subplots` makes them."""
        figure = self.figure(width, height)
        axes = figure.subplots(*shape, **options)
        for axis in np.ravel(axes):
            axis.tick_params(labelsize=SMALL)
        return figure, axes

    def single(self, width: float, height: float) -> tuple[Any, Axes]:
        """A figure with one panel: `ax` itself where it is given."""
        return self.panels(width, height) if self.ax is None else (self.ax.get_figure(), self.ax)


PAGE = Canvas()


def styled(function: Callable[P, T]) -> Callable[P, T]:
    """A function that makes a figure, in the style of the package; in axes of the caller it is drawn in theirs."""

    @functools.wraps(function)
    def draw(*args: P.args, **options: P.kwargs) -> T:
        given = (one.ax for one in (*args, *options.values()) if isinstance(one, Canvas))
        if any(ax is not None for ax in given):
            return function(*args, **options)
        with own_style():
            return function(*args, **options)

    return draw


def field_axes(axis: Axes, title: str = "") -> None:
    """Make axes a map of the field."""
    axis.set_title(title, fontsize=FONT)
    axis.set_xlabel("X (deg)", fontsize=FONT)
    axis.set_ylabel("Y (deg)", fontsize=FONT)
    axis.tick_params(labelsize=SMALL)
    axis.set_aspect("equal")


def outer_labels(axes: Any) -> None:
    """Keep the labels of a grid of maps on its outer edge only."""
    for axis in np.ravel(axes):
        axis.label_outer()


def pixel_map(
    axis: Axes, values: Map, field: Field, norm: Normalize, colours: str, *, smooth: bool = False
) -> Any:
    """A map whose outermost pixels have their centres on the edges of `field` (left, right, bottom, top; degrees)."""
    low_x, high_x, low_y, high_y = field
    height, width = values.shape
    half_x, half_y = 0.5 * (high_x - low_x) / max(width - 1, 1), 0.5 * (high_y - low_y) / max(height - 1, 1)
    image = axis.imshow(
        values, origin="lower", extent=(low_x - half_x, high_x + half_x, low_y - half_y, high_y + half_y),
        norm=norm, cmap=colours, interpolation="bilinear" if smooth else "nearest",
    )  # fmt: skip
    axis.set(xlim=(low_x, high_x), ylim=(low_y, high_y))
    return image


def point_map(
    axis: Axes,
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
    values: Float[np.ndarray, " p"],
    norm: Normalize,
    colours: str,
    shown: Bool[np.ndarray, " p"] | None = None,
) -> Any:
    """A square tile for each field point, as wide as the distance to its neighbours; none where there is no value.

    `shown` are the points that set the distance and the edges of the map (default: all).
    """
    shown = np.ones(len(x), bool) if shown is None else shown
    size = _spacing(x[shown], y[shown])
    known = shown & np.isfinite(values)
    corners = zip(x[known] - 0.5 * size, y[known] - 0.5 * size, strict=True)
    # Edges in the colour of the tile close the seams that viewers leave between neighbours.
    tiles = PatchCollection(
        [Rectangle(corner, size, size) for corner in corners],
        cmap=colours, norm=norm, edgecolor="face", linewidth=0.3,
    )  # fmt: skip
    tiles.set_array(values[known])
    tiles.set_rasterized(bool(known.sum() > MOST_VECTOR))
    axis.add_collection(tiles)
    axis.set_facecolor("0.93")
    axis.set_xlim(x[shown].min() - size, x[shown].max() + size)
    axis.set_ylim(y[shown].min() - size, y[shown].max() + size)
    return tiles


def _spacing(x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> float:
    """Side of the tiles: the typical distance to the nearest neighbour."""
    few = slice(0, MOST_VECTOR)
    distance = np.hypot(x[few, None] - x[None, few], y[few, None] - y[None, few])
    distance[distance == 0] = np.inf
    nearest = distance.min(axis=1)
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if nearest.size else 0.05


def colour_bar(figure: Any, image: Any, axes: Any, label: str = "", **options: Any) -> Any:
    """A colour bar with small numbers, plain ones on a logarithmic scale."""
    bar = figure.colorbar(image, ax=axes, **({"pad": 0.03} | options))
    bar.set_label(label, fontsize=SMALL + 1)
    bar.ax.tick_params(labelsize=SMALL, which="both")
    if bar.ax.get_yscale() == "log":
        plain_ticks(bar.ax.yaxis)
    else:
        bar.ax.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
    return bar


def plain_ticks(axis: Axis) -> None:
    """Numbers instead of powers of ten on a logarithmic axis, few enough not to collide."""
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    steps = (1, 1.2, 1.5, 2, 3, 5, 7) if decades < 0.7 else (1, 2, 5) if decades < 2 else (1,)
    ticks = [step * 10.0**power for power in range(-9, 9) for step in steps]
    ticks = [tick for tick in ticks if 0.999 * low <= tick <= 1.001 * high]
    axis.set_ticks(ticks, labels=[plain(tick, 1 + (tick * 1.001 >= 1)) for tick in ticks])
    axis.set_minor_locator(NullLocator())


def plain(value: float, digits: int = 2) -> str:
    """A number with so many digits, never as a power of ten below a million: 0.000094."""
    if not value or not math.isfinite(value):
        return f"{value:g}"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    text = f"{value:.{places}f}"
    return with_minus_sign(text.rstrip("0").rstrip(".") if "." in text and abs(value) >= 1e-3 else text)


def largest_size(*maps: Any) -> float:
    """The largest size of any finite value: the end of a symmetric scale that all of the maps share."""
    sizes = [np.abs(values[np.isfinite(values)]) for values in map(np.asarray, maps)]
    return max((float(one.max()) for one in sizes if one.size), default=0.0) or 1.0


def rounded_up(value: float) -> float:
    """The next of …, 0.1, 0.2, 0.5, 1, 2, 5, …: scales of similar runs then are the same."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1 + 1e-9))


# ------------------------------------------------------------------------------------------ the instrument matrix

PAPER_NAMES = ("zero offset", "efficiency", "cross-talk")
"""Names in Paper II of the elements of the arm that measures q: m21, m22, m23; those of u are m31, m33, m32."""


def element_symbols(arms: int) -> tuple[str, ...]:
    """m21, m22, m23 of the first arm, m31, … of the second, as matplotlib writes mathematics."""
    return tuple(f"$m_{{{2 + arm}{column}}}$" for arm in range(arms) for column in (1, 2, 3))


def element_kind(element: int, arms: int) -> int:
    """Place in `PAPER_NAMES` of an element of the matrix; with a single arm nothing is the cross-talk of another."""
    arm, column = divmod(element, 3)
    if column == 0 or arms != 2:
        return min(column, 1)
    return 1 if column == arm + 1 else 2


def element_scale(element: int, maps: Maps) -> tuple[Normalize, str]:
    """Scale (per cent) and colours of an element of the matrix; the zero offsets of all arms have one.

    Zero offset and cross-talk are symmetric about white; an efficiency ends at 100. The far ends go in steps of 1, 2,
    5, so that runs of one instrument can be compared.
    """
    kind = element_kind(element, len(maps) // 3)
    values = 100.0 * (maps[element] if kind else maps[::3])
    if kind == 1:
        return Normalize(100.0 - rounded_up(max(100.0 - float(values.min()), 1e-3)), 100.0), SEQUENTIAL
    far = rounded_up(largest_size(values))
    return Normalize(-far, far), DIVERGING


def matrix_panels(
    figure: Any, axes: Any, maps: Maps, field: Field, elements: Sequence[int], *, smooth: bool = False
) -> None:
    """Draw elements of the instrument matrix over the field, in per cent; their ranges stand in the titles.

    Of two arms lines in the maps of u bound the zone where |m22 m33 − m23 m32| < 0.1: a single exposure carries almost
    no information on u there.
    """
    arms = len(maps) // 3
    weak = np.abs(maps[1] * maps[5] - maps[2] * maps[4]) if arms == 2 else None
    for axis, i in zip(np.ravel(axes), elements, strict=True):
        kind = element_kind(i, arms)
        low, high = (100.0 * float(edge(maps[i])) for edge in (np.min, np.max))
        span = f"{_short(low, high - low)} to {_short(high, high - low)} %"
        field_axes(axis, f"{PAPER_NAMES[kind]} {element_symbols(arms)[i]}\n{span}")
        colour_bar(
            figure, pixel_map(axis, 100.0 * maps[i], field, *element_scale(i, maps), smooth=smooth), axis
        )
        if weak is not None and i > 3 and weak.min() < SMALLEST_DETERMINANT < weak.max():
            axis.contour(weak, levels=[SMALLEST_DETERMINANT], extent=field, colors="0.15", linewidths=0.7)
    outer_labels(axes)


def _short(value: float, span: float) -> str:
    """A number to three digits of the span that it bounds."""
    places = 2 if span <= 0 else max(0, 2 - math.floor(math.log10(span)))
    return with_minus_sign(f"{value:.{min(places, 7)}f}")

"""Common parts of figures: where they are drawn, sizes, colours, maps of the field, panels of the instrument matrix."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import threading
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize, to_rgb
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullLocator, ScalarFormatter
from scipy.spatial import KDTree

from walop_jax.calibration.accuracy import SMALLEST_DETERMINANT
from walop_jax.io.shapes import OfPoints
from walop_jax.io.text import with_minus_sign
from walop_jax.sky.nights import FIRST_DATE

TEMPLATES = Path(__file__).parent / "templates"
FONT = 9
SMALL = 7
NARROW = 5.0  # inches below which a figure is one for a column of print, or half a page
PRINTED = 7  # Type (pt) of a figure of a given width: what journals ask for at least, at the size of print
WIDTHS = {"column": 89.0, "page": 183.0}  # widths (mm) of figures in journals, by name
NARROWEST = 1.3  # inches of a panel of a given width: narrower ones go below each other
NUMBER = 0.4  # inches of a number below an axis, with the gap to the next
LABELS = 0.55  # inches of a panel that its title and numbers take, at any size
DIVERGING = "RdBu_r"
SEQUENTIAL = "viridis"
PLATES = {"half1.plate": "HWP1", "half2.plate": "HWP2"}
BEFORE = "#b2182b"  # dark enough to differ from AFTER in grey as well; both are ends of DIVERGING
AFTER = "#2166ac"
QUIET = "0.8"
ABOVE: Any = "outside upper center"  # of a legend
TILE = 0.05  # deg: side of the tile of a single point
MOST_VECTOR = 2000  # points above which tiles are drawn as pixels
SIZES: dict[Any, Any] = {"axes.titlesize": FONT, "axes.labelsize": FONT, "legend.fontsize": SMALL}
SETTINGS: dict[Any, Any] = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.hashsalt": "walop-jax", **SIZES}
"""Beside the defaults of matplotlib; without the hashsalt no two pages of a run are the same."""

P = ParamSpec("P")
T = TypeVar("T")
Map = Float[np.ndarray, "y x"]
Maps = Float[np.ndarray, "m y x"]
Field = tuple[float, float, float, float]
AnyFigure = Any  # a figure on a `Canvas`, or the subfigure that took the room of axes


@functools.cache
def texts(name: str) -> Mapping[str, Any]:
    """Texts beside the templates: `captions`, `symbols` of coefficients (mathematics, text), `pages` about no fit."""
    return tomllib.loads((TEMPLATES / f"{name}.toml").read_text(encoding="utf-8"))


_ONE_AT_A_TIME = threading.RLock()  # all threads share the settings of matplotlib


@contextlib.contextmanager
def own_style() -> Iterator[None]:
    """Settings of matplotlib as this package draws with, whatever a matplotlibrc or a notebook has set."""
    with _ONE_AT_A_TIME, matplotlib.style.context(["default", SETTINGS]):
        yield


class PaperFigure(Figure):
    """A figure in the style of the package, with TrueType fonts: journals refuse Type 3, matplotlib's default."""

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
    """Place of a figure: one of its own, of its usual size, of `figsize` or of `width` (inches), or in place of `ax`.

    Figures of several panels take the room of `ax`, which goes, as a subfigure. A figure of a given width has type of
    7 pt; panels that would be too narrow go below each other.
    """

    ax: Axes | None = None
    figsize: tuple[float, float] | None = None
    width: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.ax, Axes | None):
            kind = type(self.ax).__name__
            raise TypeError(f"ax: give one Axes of matplotlib, for instance ax=axes[0, 0], not {kind}")

    def figure(self, width: float, height: float) -> Any:
        """An empty figure; usual sizes in inches. Raises ValueError for axes outside a grid."""
        if self.ax is None:
            pad = 0.05 if self.width is None else 0.02
            layout = ConstrainedLayoutEngine(h_pad=pad + 0.01, w_pad=pad)
            return PaperFigure(figsize=self.figsize or (width, height), dpi=120, layout=layout)
        place, parent = self.ax.get_subplotspec(), self.ax.get_figure()
        if place is None or not isinstance(parent, Figure | SubFigure):
            raise ValueError("ax: give axes made by subplots, so that there is a place to draw in")
        self.ax.remove()
        return parent.add_subfigure(place)

    def panels(
        self,
        width: float,
        height: float,
        rows: int = 1,
        columns: int = 1,
        *,
        least: float = NARROWEST,
        labels: float = LABELS,
        maps: bool = False,
        **options: Any,
    ) -> tuple[Any, Any]:
        """A figure, and rows of panels in it with small numbers, by the `options` of `subplots`.

        `least` is the width (inches) of the narrowest panel that can be read, `labels` the height of the labels
        around each at any size; where columns are narrower, rows become columns (of `maps`, which share their axes),
        or groups of columns go below each other.
        """
        options |= {"sharex": True, "sharey": True} if maps else {}
        usual = (width / columns, height / rows)  # of a panel
        most = columns if self.width is None else max(int(self.width / least), 1)  # side by side
        turned = maps and rows < columns and most < columns
        group = rows if turned else columns
        if not turned and most < columns and "width_ratios" not in options:
            group = next(n for n in range(most, 0, -1) if rows == 1 or columns % n == 0)
            if "height_ratios" in options:
                options["height_ratios"] = [*options["height_ratios"]] * (columns // group)
        rows, columns = (columns, rows) if turned else (rows, columns)
        groups = -(-columns // group)
        size = (width, height)
        if self.width is not None:
            lowest = 0.0 if labels < LABELS else 1.3 if rows * groups == 1 else 0.8
            scaled = self.width / group / usual[0] * (usual[1] - labels)
            size = self.width, rows * groups * (labels + max(scaled, lowest))
        figure = self.figure(*size)
        axes = figure.subplots(rows * groups, group, squeeze=False, **options)
        axes = axes.reshape(groups, rows, group).swapaxes(0, 1).reshape(rows, -1)
        for empty in axes[0, columns:]:
            empty.remove()
        if groups * group > columns:  # the last panel takes the rest of its row
            place = axes[0, columns - 1].get_subplotspec()
            rest = place.get_gridspec()[place.rowspan.start, place.colspan.start :]
            axes[0, columns - 1].set_subplotspec(rest)
        axes = axes[:, :columns]
        for axis in axes.ravel():  # now: when it is drawn, the settings may be those of the caller
            axis.tick_params(labelsize=SMALL)
        return figure, axes.T if turned else axes

    def single(self, width: float, height: float) -> tuple[Any, Axes]:
        """A figure with one panel: `ax` itself where it is given."""
        if self.ax is None:
            figure, axes = self.panels(width, height)
            return figure, axes.item()
        self.ax.tick_params(labelsize=SMALL)
        for label in (self.ax.xaxis.label, self.ax.yaxis.label):
            label.set_fontsize(FONT)
        return self.ax.get_figure(), self.ax


PAGE = Canvas()


def styled(function: Callable[P, T]) -> Callable[P, T]:
    """A function that makes a figure, in the style of the package; in axes of the caller it is drawn in theirs."""

    @functools.wraps(function)
    def draw(*args: P.args, **options: P.kwargs) -> T:
        canvases = [arg for arg in (*args, *options.values()) if isinstance(arg, Canvas)]
        if any(canvas.ax is not None for canvas in canvases):
            with _ONE_AT_A_TIME, matplotlib.rc_context(SIZES):
                return function(*args, **options)
        with own_style():
            figure: Any = function(*args, **options)
            if any(canvas.width is not None for canvas in canvases):  # all type has the size of print
                for axis in figure.axes:
                    axis.tick_params(axis="both", which="both", labelsize=PRINTED, length=2)
                for text in figure.findobj(Text):
                    if len(text.get_text()) != 1:  # but the signs of tiles
                        text.set_fontsize(PRINTED)
            return figure

    return draw


def field_limits(low: float, high: float) -> tuple[float, float]:
    """Limits of a map of the field along an axis, a little beyond it, in round steps: the same for all of a run."""
    if low == high:  # a single point, with its tile
        low, high = low - 0.5 * TILE, high + 0.5 * TILE
    step = rounded_up(max(high - low, 1e-3) / 12.0)
    margin = (high - low) / 24.0
    return math.floor((low - margin) / step + 1e-6) * step, math.ceil((high + margin) / step - 1e-6) * step


def _field_axes(axis: Axes, title: str, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Make axes a map of the field, the ends of which are given; labels stand on the outer edge of shared axes."""
    axis.set(title=title, xlabel="X (deg)", ylabel="Y (deg)", aspect="equal")
    axis.set(xlim=field_limits(*x), ylim=field_limits(*y))
    axis.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    if len(axis.get_shared_y_axes().get_siblings(axis)) > 1:
        axis.label_outer()
    if to_rgb(axis.get_facecolor()) == to_rgb("white"):  # axes of the caller keep their colour
        axis.set_facecolor("0.93")


def pixel_map(
    axis: Axes, title: str, values: Map, field: Field, norm: Normalize, colours: str, *, smooth: bool = False
) -> Any:
    """A map whose outermost pixels have their centres on the edges of `field` (left, right, bottom, top; degrees)."""
    low_x, high_x, low_y, high_y = field
    height, width = values.shape
    half_x = 0.5 * ((high_x - low_x) / max(width - 1, 1) or TILE)
    half_y = 0.5 * ((high_y - low_y) / max(height - 1, 1) or TILE)
    image = axis.imshow(
        values, origin="lower", extent=(low_x - half_x, high_x + half_x, low_y - half_y, high_y + half_y),
        norm=norm, cmap=colours, interpolation="bilinear" if smooth else "nearest",
    )  # fmt: skip
    _field_axes(axis, title, (low_x, high_x), (low_y, high_y))
    return image


def point_map(
    axis: Axes,
    title: str,
    x: OfPoints,
    y: OfPoints,
    values: OfPoints,
    norm: Normalize,
    colours: str,
    shown: Bool[np.ndarray, " p"] | None = None,
) -> Any:
    """A square tile for each point with a value, as wide as neighbours are apart; `shown` set distance and edges.

    Where points of another raster lie between them tiles are smaller: no two overlap.
    """
    shown = np.ones(len(x), bool) if shown is None else shown
    visible = shown & np.isfinite(values)
    size = np.minimum(_spacing(x[shown], y[shown]), nearest_apart(x[visible], y[visible]))
    corners = zip(x[visible] - 0.5 * size, y[visible] - 0.5 * size, size, strict=True)
    # Edges in the colour of the tile close the seams that viewers leave between neighbours.
    tiles = PatchCollection(
        [Rectangle((left, below), side, side) for left, below, side in corners],
        cmap=colours, norm=norm, edgecolor="face", linewidth=0.3,
    )  # fmt: skip
    tiles.set_array(values[visible])
    tiles.set_rasterized(bool(visible.sum() > MOST_VECTOR))
    axis.add_collection(tiles)
    _field_axes(axis, title, *((float(v[shown].min()), float(v[shown].max())) for v in (x, y)))
    return tiles


def error_map(axis: Axes, title: str, x: OfPoints, y: OfPoints, percent: OfPoints, norm: Normalize) -> Any:
    """Tiles of an error of q, u or p at field points; crosses (NaN): a single exposure does not measure u there."""
    blind = np.isnan(percent)
    axis.plot(x[blind], y[blind], "x", color="0.5", ms=4, label="u not measured in one exposure")
    return point_map(axis, title, x, y, percent, norm, SEQUENTIAL)


def nearest_apart(x: OfPoints, y: OfPoints) -> OfPoints:
    """Distance of each point from the next point at another place: the larger of the distances along X and Y.

    Squares with these sides do not overlap. Infinite for a point that is alone.
    """
    places, number = np.unique(np.stack([x, y], axis=1), axis=0, return_inverse=True)
    if len(places) < 2:
        return np.full(len(x), np.inf)
    distance, _ = KDTree(places).query(places, k=2, p=np.inf)
    return np.asarray(distance)[:, 1][number.ravel()]


def _spacing(x: OfPoints, y: OfPoints) -> float:
    """Side of the tiles: the typical distance to the nearest neighbour."""
    few = slice(0, MOST_VECTOR)
    distance = np.hypot(x[few, None] - x[None, few], y[few, None] - y[None, few])
    distance[distance == 0] = np.inf
    nearest = distance.min(axis=1)
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if nearest.size else TILE


def colour_bar(image: Any, label: str = "", axes: Any = None, **options: Any) -> Any:
    """A colour bar with small numbers, plain ones on a logarithmic scale: for all `axes`, or for one map, in its
    height.

    In a column of print the bar of one map has three numbers at most: there is no room for 99.95 beside the next.
    """
    figure = image.axes.figure
    place = (
        {"ax": axes, "pad": 0.03}
        if axes is not None
        else {"cax": image.axes.inset_axes((1.04, 0.0, 0.06, 1.0))}
    )
    bar = figure.colorbar(image, **(place | options))
    bar.set_label(label, fontsize=SMALL + 1)
    bar.ax.tick_params(labelsize=SMALL, which="both")
    if bar.ax.get_yscale() == "log":
        plain_ticks(bar.ax.yaxis)
    else:
        bar.ax.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
        if axes is None and figure.bbox.width < NARROW * figure.dpi:
            bar.ax.yaxis.set_major_locator(MaxNLocator(2, steps=[1, 2, 2.5, 5, 10]))
    return bar


def angle_ticks(axis: Axes) -> None:
    """Angles in degrees every 45° along X, or 90° or 180° where panels side by side have no room for more."""
    low, high = axis.get_xlim()
    place, figure = axis.get_subplotspec(), axis.figure
    columns = 1 if place is None else place.get_gridspec().ncols
    room = max(figure.bbox.width / figure.dpi / columns - 0.5, 0.5) / 0.32  # numbers
    step = next((s for s in (45, 90) if (high - low) / s <= room), 180)
    axis.xaxis.set_major_locator(MultipleLocator(step))


def calendar(axis: Axes, mjd: Any, counted: str = "") -> None:
    """Write dates (UTC), a day at least, along X where times are MJD; numbers have the label `counted`."""
    low, high = axis.dataLim.intervalx
    if low <= high:  # of a single date matplotlib would draw a tenth of all days since 1970
        margin = max(0.05 * (high - low), 0.5 * (1.0 - (high - low)))
        axis.set_xlim(low - margin, high + margin)
    dated = np.any(np.asarray(mjd, float) > FIRST_DATE)
    axis.set_xlabel("date (UTC)" if dated else counted)
    if dated:
        locator = AutoDateLocator(minticks=3, maxticks=7)
        axis.xaxis.set_major_locator(locator)
        axis.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        axis.xaxis.get_offset_text().set_fontsize(FONT)


def day_of(mjd: Any) -> Any:
    """Days of matplotlib (since 1970) of MJD; numbers of exposure groups stay as they are."""
    mjd = np.asarray(mjd, float)
    return np.where(mjd > FIRST_DATE, mjd - 40587.0, mjd)


def plain_ticks(axis: Axis) -> None:
    """Numbers instead of powers of ten on a logarithmic axis, few enough not to collide."""
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    width = axis.axes.get_window_extent().width / axis.axes.figure.dpi
    room = width / NUMBER if isinstance(axis, XAxis) else np.inf
    ticks, finest = [], 0 if decades < 0.7 else 1 if decades < 2 else 2
    for steps in ((1, 1.2, 1.5, 2, 3, 5, 7), (1, 2, 5), (1,))[finest:]:
        ticks = [step * 10.0**power for power in range(-9, 9) for step in steps]
        ticks = [tick for tick in ticks if 0.999 * low <= tick <= 1.001 * high]
        if len(ticks) <= room:
            break
    axis.set_ticks(ticks, labels=[plain(tick) for tick in ticks])
    axis.set_minor_locator(NullLocator())


def plain(value: float) -> str:
    """A number with two digits, never as a power of ten: 0.000094."""
    return with_minus_sign(np.format_float_positional(value, 2, fractional=False, trim="-"))


def largest_size(*maps: Any) -> float:
    """The largest size of any finite value: the end of a symmetric scale that all of the maps share."""
    sizes = [np.abs(values[np.isfinite(values)]) for values in map(np.asarray, maps)]
    return max((float(size.max()) for size in sizes if size.size), default=0.0) or 1.0


def rounded_up(value: float) -> float:
    """The next of …, 0.1, 0.2, 0.5, 1, 2, 5, …: scales of similar runs then are the same."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1 + 1e-9))


# ------------------------------------------------------------------------------------------ the instrument matrix

PAPER_NAMES = ("zero offset", "efficiency", "cross-talk")
"""Names in Paper II of the elements of the arm that measures q: m21, m22, m23; of the arm that measures u: m31, m33,
m32."""


def element_symbols(arms: int) -> tuple[str, ...]:
    """m21, m22, m23 of the first arm, m31, … of the second, as matplotlib writes mathematics."""
    return tuple(f"$m_{{{2 + arm}{column}}}$" for arm in range(arms) for column in (1, 2, 3))


def element_kind(element: int, arms: int) -> int:
    """Index in `PAPER_NAMES` of an element of the matrix; with a single arm no element is the cross-talk of another."""
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
    axes: Any, maps: Maps, field: Field, elements: Sequence[int], *, smooth: bool = False
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
        title = f"{PAPER_NAMES[kind]} {element_symbols(arms)[i]}\n{span}"
        image = pixel_map(axis, title, 100.0 * maps[i], field, *element_scale(i, maps), smooth=smooth)
        colour_bar(image)
        if weak is not None and i > 3 and weak.min() < SMALLEST_DETERMINANT < weak.max():
            axis.contour(weak, levels=[SMALLEST_DETERMINANT], extent=field, colors="0.15", linewidths=0.7)


def _short(value: float, span: float) -> str:
    """A number to three digits of the span that it bounds."""
    places = 2 if span <= 0 else max(0, 2 - math.floor(math.log10(span)))
    return with_minus_sign(f"{value:.{min(places, 7)}f}")

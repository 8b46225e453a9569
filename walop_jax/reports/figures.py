"""Figures of a calibration and of a fit: plain `matplotlib` figures, to show in a notebook or to `savefig`.

They may be made without a screen, and in threads: one at a time sets the style, and leaves the settings as they were.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize

from walop_jax.calibration.matrix import MatrixMaps, ResidualMap
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import instrument_of
from walop_jax.io.errors import fail
from walop_jax.io.text import two_digits, with_minus_sign
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.cameras import Cameras
from walop_jax.reports import style
from walop_jax.reports.style import PAGE, AnyFigure, Canvas, Field, styled
from walop_jax.science.field_accuracy import FieldAccuracy

Parameters = Float[np.ndarray, " n"]  # full vectors
FITTED = Normalize(0.7, 1.3)  # scale of rms residuals of a fit that explains its data, the same for every run
RELEVANT = 1e-4  # of the largest change of a matrix: the scale of no map is smaller


@styled
def residuals_figure(
    likelihood: Likelihood, values: Parameters, before: Parameters, on: Canvas = PAGE
) -> AnyFigure:
    """Residuals of every field point before and after a fit (full vectors of parameters), and a histogram of those
    after it.
    """
    figure, ((left, middle, right),) = on.panels(9.6, 3.0, 1, 3, least=1.6)
    _before_and_after((left, middle), likelihood, before, values)
    middle.set_ylabel("")
    _histogram(right, likelihood, values)
    return figure


@styled
def calibration_figure(
    maps: MatrixMaps, likelihood: Likelihood, values: Parameters, before: Parameters, on: Canvas = PAGE
) -> AnyFigure:
    """A calibration on one page: maps of the matrix, residuals of every field point before and after the fit."""
    rows = max(2, maps.arms)
    figure, axes = on.panels(10.2, 2.35 * rows, rows, 4, maps=True)
    elements, shown = range(3 * maps.arms), axes[: maps.arms, :3]
    style.matrix_panels(shown, maps.values, field_of(maps), elements, smooth=True)
    _before_and_after(axes[:2, 3], likelihood, before, values)
    for axis in (*axes[maps.arms :, :3].ravel(), *axes[2:, 3]):
        axis.remove()
    return figure


def _before_and_after(
    axes: Iterable[Axes], likelihood: Likelihood, before: Parameters, after: Parameters
) -> None:
    """Rms residuals of the field points, standards left out, with two vectors of parameters, each on its own scale."""
    points, extended = likelihood.calset.points, likelihood.calset.exposures.kind != "standard"
    shown = np.asarray(likelihood.used[:, extended].any(axis=1), bool)
    shown = shown if shown.any() else np.ones(len(points), bool)
    for axis, values, title in zip(axes, (before, after), ("before the fit", "after the fit"), strict=True):
        residual = point_residuals(likelihood, values)
        low, high = (float(edge(residual[shown])) for edge in (np.nanmin, np.nanmax))
        far = high > 3.0
        norm = Normalize(low, high) if far else FITTED
        image = style.point_map(axis, title, points.x, points.y, residual, norm, "magma_r", shown)
        style.colour_bar(image, "rms residual (σ)", extend="neither" if far else "both")


def point_residuals(likelihood: Likelihood, values: Parameters) -> Float[np.ndarray, " p"]:
    """Rms normalised residual of each field point, 1 by noise alone (the flux took one in four); NaN without data."""
    _, residual = likelihood.residuals(values)
    freedom = (likelihood.used * likelihood.data_per_row).sum(axis=1)
    square = (residual**2).sum(axis=(1, 2))
    return np.sqrt(np.where(freedom > 0, square / np.maximum(freedom, 1.0), np.nan))


def _histogram(axis: Axes, likelihood: Likelihood, values: Parameters) -> None:
    """All residuals of a fit, and what noise alone would give."""
    _, residual = likelihood.residuals(values)
    # A flux takes the fraction y²/Σy² of the variance of every intensity y, in units of its error.
    square = (likelihood.points.gathered("counts") * likelihood.points.gathered("weight")) ** 2
    together = likelihood.model.template.cameras.together
    power = square @ (np.ones((likelihood.cameras,) * 2) if together is None else np.asarray(together))
    flux_share = np.where(likelihood.flux_known[:, None], 0.0, square / np.where(power > 0, power, 1.0))
    width = np.sqrt(np.clip(1.0 - flux_share, 1e-3, None))[likelihood.used].ravel()
    used = residual[likelihood.used].ravel()
    edges = np.linspace(-4.0, 4.0, 41)
    # Those beyond the axis count as well.
    density = np.full(used.size, 1.0 / (used.size * (edges[1] - edges[0])))
    shown = {"bins": edges.tolist(), "weights": density, "color": "0.75", "label": "residuals"}
    heights, *_ = axis.hist(used / width, **shown)
    beyond = float(np.mean(np.abs(used / width) > edges[-1]))
    if beyond > 0:
        tail = f"{two_digits(100.0 * beyond)} % beyond ±{edges[-1]:g}"
        axis.text(0.03, 0.97, tail, transform=axis.transAxes, va="top", fontsize=style.SMALL)
    t = np.linspace(-4.0, 4.0, 201)
    axis.plot(t, np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi), color="C3", lw=1.2, label="noise alone")
    axis.set(xlabel="residual / its expected width", ylabel="density")
    axis.set_ylim(top=max(0.55, 1.1 * float(np.max(heights))))  # room for the legend above the curve
    axis.legend(frameon=False, loc="upper right")


@styled
def modulation_figure(
    calset: CalibrationSet, points: Sequence[int], on: Canvas = PAGE, cameras: Cameras | None = None
) -> AnyFigure:
    """Signals of the arms of two cameras behind the calibration polariser against its angle, at some field points.

    `points` are rows of `calset.points`, `cameras` those of the instrument where it is one's own. Only exposures with
    the polariser in and the calibration plate out are shown.
    Two arms measure q_m and u_m; an ideal instrument would follow cos 2θ and sin 2θ, the grey lines.
    """
    e = calset.exposures
    shown = np.flatnonzero(e.clp_in & ~e.position(CALIBRATION_PLATE).inside)
    block = calset.intensities.block(0, len(calset.points))
    cameras = cameras or instrument_of(calset).cameras
    arms = len(cameras.pairs)
    if not arms:
        raise fail("no arm has two cameras, whose difference would be a signal")
    figure, panels = on.panels(4.1 * arms, 3.2, 1, arms, sharex=True, sharey=True)
    turn = 180 if np.max(e.clp_angle[shown], initial=0.0) <= 180.0 else 360
    angle = np.linspace(0.0, turn, 181)
    for arm, (axis, pair) in enumerate(zip(panels[0], cameras.pairs, strict=True)):
        name = "({0} − {1}) / ({0} + {1})".format(*(cameras.names[camera] for camera in pair))
        if arms == 2:
            name, ideal = (("$q_m$", np.cos), ("$u_m$", np.sin))[arm]
            axis.plot(angle, ideal(2 * np.deg2rad(angle)), color="0.8", lw=1.0, zorder=0, label="ideal")
        for k, point in enumerate(points):
            rows = shown[block.used[point, shown]]
            first, second = (block.counts[point, rows, camera] for camera in pair)
            where = with_minus_sign(f"X {block.x[point]:+.2f}°, Y {block.y[point]:+.2f}°")
            signal = (first - second) / (first + second)
            axis.plot(e.clp_angle[rows], signal, "os^Dv"[k % 5], ms=4, label=where)
        axis.set(xlabel="polariser angle (deg)", ylabel=name)
        style.angle_ticks(axis)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), frameon=False, ncols=2, loc=style.ABOVE)
    return figure


@styled
def matrix_maps_figure(maps: MatrixMaps, kind: int | None = None, on: Canvas = PAGE) -> AnyFigure:
    """The elements of the matrix over the field; with `kind` only the elements of one name in Paper II (index in
    `PAPER_NAMES`).
    """
    chosen = [i for i in range(len(maps.values)) if kind in (None, style.element_kind(i, maps.arms))]
    if not chosen:
        what = f"no element of the matrix of {maps.arms} arms is {style.PAPER_NAMES[kind or 0]}"
        raise fail(what, advice="plot matrix")
    rows = maps.arms if kind is None else 1
    columns = len(chosen) // rows
    size = ((2.9 if rows > 1 else 4.0) * columns, 2.65 * rows + 0.7 * (rows == 1))
    figure, axes = on.panels(*size, rows, columns, maps=True)
    style.matrix_panels(axes, maps.values, field_of(maps), chosen)
    return figure


@styled
def matrix_errors_figure(maps: MatrixMaps, on: Canvas = PAGE) -> AnyFigure:
    """The standard errors of the elements of the matrix over the field (%), on a logarithmic scale of whole decades."""
    figure, axes = on.panels(8.6, 2.3 * maps.arms, maps.arms, 3, maps=True)
    percent = 100.0 * maps.errors
    high = 10.0 ** np.ceil(np.log10(np.max(percent, initial=1e-4)))
    low = 10.0 ** np.floor(np.log10(np.min(percent[percent > 0], initial=high / 10.0)))
    norm, image = LogNorm(max(low, high / 1e4), high), None
    for axis, errors, name in zip(axes.ravel(), percent, style.element_symbols(maps.arms), strict=True):
        least, highest = (style.plain(float(value)) for value in (errors.min(), errors.max()))
        title = f"error of {name}\n{least}–{highest} %"
        image = style.pixel_map(axis, title, errors, field_of(maps), norm, style.SEQUENTIAL)
    style.colour_bar(image, "standard error (%)", axes, pad=0.02, extend="min", aspect=30)
    return figure


@styled
def matrix_change_figure(old: MatrixMaps, new: MatrixMaps, on: Canvas = PAGE) -> AnyFigure:
    """Change of the matrix over the field (%), with a scale for each element.

    A scale that two elements share would show nothing of the smaller one. Raises ValueError for maps of different
    places.
    """
    if field_of(old) != field_of(new) or old.values.shape != new.values.shape:
        raise ValueError("the maps of the two calibrations are of different places")
    change = 100.0 * (new.values - old.values)
    least = RELEVANT * style.largest_size(change)
    figure, axes = on.panels(8.6, 2.3 * new.arms, new.arms, 3, maps=True)
    for axis, values, name in zip(axes.ravel(), change, style.element_symbols(new.arms), strict=True):
        far = style.rounded_up(max(style.largest_size(values), least))
        title, norm = f"change of {name}", Normalize(-far, far)
        image = style.pixel_map(axis, title, values, field_of(new), norm, style.DIVERGING)
        style.colour_bar(image, "new − old (%)" if axis in axes[:, -1] else "")
    return figure


@styled
def residual_map_figure(residuals: ResidualMap, cameras: Cameras, on: Canvas = PAGE) -> AnyFigure:
    """Residuals of the matrix and of the ratios of the arms (%), and χ²/dof before that correction.

    A row for each arm. The elements share one scale, which the largest corrections but one in a hundred set.
    """
    arms = residuals.arms
    elements, ratios = residuals.values[: 3 * arms], residuals.values[3 * arms :]
    figure, axes = on.panels(9.4, 2.0 * arms, arms, 4, maps=True)

    def draw(axis: Axes, title: str, values: Float[np.ndarray, "y x"], norm: Normalize, colours: str) -> None:
        style.colour_bar(style.pixel_map(axis, title, values, field_of(residuals), norm, colours))

    far = 100.0 * _almost_largest(elements)
    for axis, values, name in zip(axes[:, :3].ravel(), elements, style.element_symbols(arms), strict=True):
        draw(axis, f"$\\delta${name} (%)", 100.0 * values, Normalize(-far, far), style.DIVERGING)
    high = _almost_largest(residuals.chi2)
    low = float(np.nanmin(residuals.chi2, initial=high))
    draw(axes[-1, 3], "χ²/dof", residuals.chi2, Normalize(low, high), style.SEQUENTIAL)
    # The panels above that of χ² are free for the arms after the first.
    first, *others = (", ".join(cameras.names[k] for k in pair) for pair in cameras.pairs)
    for axis, ratio, names in zip(axes[:-1, 3], ratios, others, strict=True):
        far = 100.0 * _almost_largest(ratio)
        title = f"{names} / {first} (%)"
        draw(axis, title, 100.0 * ratio, Normalize(-far, far), style.DIVERGING)
    return figure


def _almost_largest(values: Float[np.ndarray, ...]) -> float:
    """The size that one value in a hundred exceeds."""
    return max(float(np.nanpercentile(np.abs(values), 99)), 1e-14) if np.isfinite(values).any() else 1.0


def field_of(maps: MatrixMaps | ResidualMap) -> Field:
    """Centres of the outermost pixels, degrees: left, right, bottom, top."""
    x, y = maps.grid.points.x, maps.grid.points.y
    return float(x.min()), float(x.max()), float(y.min()), float(y.max())


_RANGE = (1e-4, 3.0)  # per cent


@styled
def accuracy_figure(accuracy: FieldAccuracy, on: Canvas = PAGE) -> AnyFigure:
    """The error of p over the field (%, logarithmic; a line at the goal), and the fraction of the field that has it."""
    goal = 100.0 * accuracy.goal
    percent = np.clip(100.0 * np.nan_to_num(accuracy.error, nan=np.inf), *_RANGE)
    figure, ((left, right),) = on.panels(8.2, 3.4, 1, 2, width_ratios=(1.15, 1.0))
    low, high = float(percent.min()), float(percent.max())
    title, norm = f"error of p (%), {accuracy.filter}", LogNorm(0.003, _RANGE[1])
    image = style.pixel_map(left, title, percent, accuracy.extent, norm, style.SEQUENTIAL, smooth=True)
    style.colour_bar(image, extend="both")
    if low < goal < high:
        left.contour(np.log(percent / goal), [0.0], extent=accuracy.extent, colors="w", linewidths=1.2)
    edges = np.geomspace(0.8 * low, 1.25 * high, 37)
    share = np.full(percent.size, 100.0 / percent.size)
    right.hist(percent.ravel(), edges.tolist(), weights=share, color=style.AFTER)
    right.axvline(goal, color="0.3", lw=1.0, ls="--")
    right.text(
        goal, 1.01, f"goal {goal:.3g} %", fontsize=style.SMALL, transform=right.get_xaxis_transform(), ha="center",
        va="bottom",
    )  # fmt: skip
    right.set(xscale="log", xlim=(min(edges[0], goal / 1.5), max(edges[-1], 1.5 * goal)))
    style.plain_ticks(right.xaxis)
    right.set(xlabel="error of p (%)", ylabel="fraction of the field (%)")
    return figure


@styled
def planned_figure(field: Mapping[str, Sequence[float | None]], on: Canvas = PAGE) -> AnyFigure:
    """Error of p (%) over the field before a plan and after it, from `field` of plan.json; crosses: no u there."""
    x, y, before, after = (np.array(field[k], float) for k in ("x", "y", "before", "p_error"))
    places, at = np.unique(np.stack([x, y]), axis=1, return_inverse=True)
    maps, image = [], None
    for error in (before, after):
        maps.append(np.zeros(places.shape[1]))
        with np.errstate(invalid="ignore"):  # NaN where any filter or colour is
            np.maximum.at(maps[-1], at.ravel(), 100.0 * error)
    figure, (axes,) = on.panels(8.2, 3.6, 1, 2, sharey=True)
    lowest, highest = float(0.5 * np.nanmin(maps[1])), float(2.0 * np.nanmax(maps[1]))
    highest = min(max(float(np.nanmax(maps[0], initial=0.0)), highest), max(_RANGE[1], highest))
    norm = LogNorm(lowest, highest)
    for axis, values, when in zip(axes, maps, ("before", "after"), strict=True):
        title, shown = f"error of p {when}", np.minimum(values, highest)
        image = style.error_map(axis, title, places[0], places[1], shown, norm)
    style.colour_bar(image, "error of p (%)", axes, extend="max", pad=0.02)
    return figure

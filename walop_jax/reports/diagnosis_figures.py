"""Figures of a diagnosis: residuals over the field and over the exposures, what explains them, and the ladder of χ².

They are drawn from the plain arrays of `diagnosis.fits` (`read_figure_data`, or `figure_data` of a `Diagnosis`
in memory). Residuals are (data − model) in standard deviations throughout.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.colors import BoundaryNorm, LogNorm, Normalize
from matplotlib.ticker import MaxNLocator

from walop_jax.data.records import Points
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.detection_limits import NO_LEVEL, DetectionLimits
from walop_jax.diagnosis.figure_data import DiagnosisFigureData, FigureColumns, PointMap, ResidualComparison
from walop_jax.fit.verdict import SUSPECT_SIGMA
from walop_jax.reports import style
from walop_jax.reports.style import PAGE, AnyFigure, Canvas, styled

SIGN_BEYOND = 3.0  # σ beyond which a tile carries its sign
MOST_MARKED = 400  # points above which signs would run into each other
MOST_BINS = 48  # of polariser angle
_MODELS = ("starting\nmodel", "final\nmodel")


@styled
def residual_maps(
    points: Points,
    maps: Mapping[str, PointMap],
    cameras: Sequence[str],
    on: Canvas = PAGE,
    *,
    rms: bool = False,
) -> AnyFigure:
    """Residuals of every field point in the cameras of those names: a row of maps for each entry, one colour scale.

    `maps` are (point, camera) by title, NaN where there is nothing. The scale is symmetric about 0; tiles beyond
    3 σ carry their sign, so that the maps can be read without colours. Of `rms` residuals it begins at 0.5 σ.
    """
    shown = np.any([np.isfinite(values).any(axis=1) for values in maps.values()], axis=0)
    shown = shown if shown.any() else np.ones(len(points), bool)
    far = max(style.largest_size(*maps.values()), 1.5 if rms else SIGN_BEYOND)
    norm, colours = (Normalize(0.5, far), "magma_r") if rms else (Normalize(-far, far), style.DIVERGING)
    signs = not rms and len(points) <= MOST_MARKED
    size, grid = (0.6 + 2.0 * len(cameras), 0.55 + 1.75 * len(maps)), (len(maps), len(cameras))
    figure, axes = on.panels(*size, *grid, sharex=True, sharey=True, least=0.8, labels=0.4)
    tiles: Any = None
    for number, (name, values) in enumerate(maps.items()):
        for k, axis in enumerate(axes[number]):
            title = cameras[k] if number == 0 else ""
            tiles = style.point_map(axis, title, points.x, points.y, values[:, k], norm, colours, shown)
            if axis.get_ylabel():  # on the left edge
                axis.set_ylabel(f"{name}\n\nY (deg)")
            axis.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 4, 5, 10], prune="both"))
            if on.width is not None:
                axis.tick_params(axis="x", labelrotation=90)
            axis.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], prune="both"))
            for i in np.flatnonzero(signs & (np.abs(np.nan_to_num(values[:, k])) > SIGN_BEYOND)):
                ink = "white" if abs(norm(values[i, k]) - 0.5) > 0.35 else "0.25"
                look = {"color": ink, "fontsize": 5, "ha": "center", "va": "center"}
                axis.text(points.x[i], points.y[i], "+" if values[i, k] > 0 else "−", **look)
    label = "rms residual (σ)" if rms else "residual (σ)"
    style.colour_bar(tiles, label, axes, pad=0.015, aspect=18 * len(maps), fraction=0.03)
    return figure


@styled
def effect_figure(data: DiagnosisFigureData, number: int = 1, on: Canvas = PAGE) -> AnyFigure:
    """Residuals without and with the effect of a comparison, and its part; of 0: starting and final model."""
    c = data.comparisons[number]
    without, with_it = (f"without\n{c.effect}", f"with\n{c.effect}") if number else _MODELS
    rows = {
        without: c.field["BEFORE"],
        f"explained by\n{c.effect}" if c.effect else "explained": c.field["EXPLAINED"],
        with_it: c.field["AFTER"],
    }
    return residual_maps(data.points, rows, data.cameras, on)


@styled
def rms_figure(data: DiagnosisFigureData, on: Canvas = PAGE) -> AnyFigure:
    """Rms residuals of the starting and the final model over the field, rows and scale as in `residual_maps`.

    Several effects need not show in one combination of the exposures: the rms is over all exposures. Standards lie
    between the other points and are measured in other exposures; they are left out where there are other points. Noise
    alone gives √(1 − 1/K) with K cameras and a free flux: 0.87 for four.
    """
    overall = data.comparisons[0].field
    measured = np.isfinite(overall["BEFORE"])
    rms = (np.where(measured, values, np.nan) for values in (overall["RMS_BEFORE"], overall["RMS_AFTER"]))
    return residual_maps(data.points, dict(zip(_MODELS, rms, strict=True)), data.cameras, on, rms=True)


@styled
def signature_figure(
    comparison: ResidualComparison, exposures: FigureColumns, cameras: Sequence[str], on: Canvas = PAGE
) -> AnyFigure:
    """Residuals averaged over the field, camera by camera: data as dots, the part of the effect (if any) as a line.

    Against the polariser angle where the comparison shows a harmonic of it, or most of its signal is behind the
    polariser; against time otherwise. Exposures at one angle are averaged. The lower panels hold the remaining
    residuals.
    """
    angular, position, label = _abscissa(comparison, exposures)
    changed = bool(np.nan_to_num(comparison.curves["EXPLAINED"]).any())
    grid = {"sharex": True, "sharey": "row", "height_ratios": (2.2, 1)}
    figure, (upper, lower) = on.panels(0.6 + 2.0 * len(cameras), 3.5, 2, len(cameras), **grid)
    for k, camera in enumerate(cameras):
        finite = np.isfinite(position) & np.isfinite(comparison.curves["BEFORE"][:, k])
        columns = (comparison.curves[name] for name in ("BEFORE", "ERROR", "EXPLAINED", "AFTER"))
        shown = (column[finite, k] for column in columns)
        x, before, error, explained, after = _binned(position[finite], *shown)
        for axis, dots in ((upper[k], before), (lower[k], after)):
            axis.axhline(0.0, color=style.QUIET, lw=0.8, zorder=0)
            axis.errorbar(x, dots, error, fmt="o", ms=3, lw=0.8, color="0.15", label="data", zorder=3)
        if changed:
            upper[k].plot(x, explained, color=style.BEFORE, lw=1.4, label="effect", zorder=2)
        upper[k].set_title(camera)
        lower[k].set_xlabel(label)
        if angular:
            style.angle_ticks(lower[k])
    upper[0].set_ylabel("residual (σ)")
    lower[0].set_ylabel("remaining (σ)")
    figure.legend(*upper[0].get_legend_handles_labels(), frameon=False, ncols=2, loc=style.ABOVE)
    return figure


def _abscissa(
    comparison: ResidualComparison, exposures: FigureColumns
) -> tuple[bool, Float[np.ndarray, " e"], str]:
    """True for polariser angles, positions along the axis, its label."""
    behind, mjd = np.isfinite(exposures["CLP_ANGLE"]), exposures["MJD"]
    explained = comparison.curves["EXPLAINED"]
    power = np.nansum(np.where(explained != 0, explained, comparison.curves["BEFORE"]) ** 2, axis=1)
    if comparison.harmonic >= 0 or power[behind].sum() > 0.5 * power.sum():
        return True, exposures["CLP_ANGLE"], "polariser angle (deg)"
    if np.isfinite(mjd).all() and np.ptp(mjd) > 0:
        return False, 24.0 * (mjd - mjd.min()), "time since the first exposure (h)"
    return False, exposures["EXPOSURE"].astype(float), "exposure"


def _binned(x: Float[np.ndarray, " e"], *columns: Float[np.ndarray, " e"]) -> list[Float[np.ndarray, " b"]]:
    """Means over exposures at the same place, in at most `MOST_BINS` bins; the second column holds errors."""
    places, bin_of = np.unique(np.round(x, 3), return_inverse=True)
    if len(places) > MOST_BINS:
        edges = np.linspace(x.min(), x.max(), MOST_BINS + 1)
        _, bin_of = np.unique(np.clip(np.digitize(x, edges) - 1, 0, MOST_BINS - 1), return_inverse=True)
    count = np.bincount(bin_of)
    means = [np.bincount(bin_of, weights=values) / count for values in (x, *columns)]
    means[2] = np.sqrt(np.bincount(bin_of, weights=columns[1] ** 2)) / count
    return means


@styled
def ladder_figure(ladder: FigureColumns, on: Canvas = PAGE) -> AnyFigure:
    """χ²/dof of the starting model and all after it, logarithmic; in the band (5 σ) a model explains the data."""
    names = [*ladder["MODEL"]]
    names = [names[0], *(name if name == "final fit" else f"+ {name}" for name in names[1:])]
    ratio = ladder["CHI2"] / np.maximum(ladder["DOF"], 1)
    place = np.arange(len(ratio))
    width = SUSPECT_SIGMA * np.sqrt(2.0 / max(int(ladder["DOF"][-1]), 1))
    figure, axis = on.single(7.0, 0.8 + 0.38 * len(ratio))
    axis.axvspan(max(1.0 - width, 1e-3), 1.0 + width, color="0.88", lw=0, zorder=0)
    axis.axvline(1.0, color="0.5", lw=0.8, zorder=1)
    axis.plot(ratio, place, color="0.6", lw=1.0, zorder=2)
    explains = ratio < 1.0 + width
    for chosen, marker, colour in ((~explains, "o", style.BEFORE), (explains, "s", style.AFTER)):
        axis.plot(ratio[chosen], place[chosen], marker, color=colour, ms=7, lw=0, zorder=3)
    low, high = min(float(ratio.min()), max(1.0 - width, 0.1)), max(float(ratio.max()), 1.0 + width)
    margin = (high / low) ** 0.12
    axis.set(xscale="log", xlim=(low / margin, high * margin**2), xlabel="χ² per degree of freedom")
    for y, value in zip(place, ratio, strict=True):
        place_of_text = {"xytext": (9, -8), "textcoords": "offset points", "va": "center"}
        axis.annotate(f"{value:.4g}", (value, y), fontsize=8, **place_of_text)
    axis.set_yticks(place, names)
    axis.set_ylim(len(ratio) - 0.5, -0.5)
    style.plain_ticks(axis.xaxis)
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)
    axis.tick_params(axis="y", length=0, labelsize=style.FONT)
    return figure


@styled
def shares_figure(shares: FigureColumns, on: Canvas = PAGE) -> AnyFigure:
    """Mean squared residual by camera, kind, filter and exposure, over what noise alone gives: before and after."""
    groups = [g for g in ("camera", "kind", "filter") if np.count_nonzero(shares["GROUP"] == g) > 1]
    widths = [float(np.count_nonzero(shares["GROUP"] == g) + 1) for g in groups]
    widths.append(max(12.0, sum(widths)))
    figure, (axes,) = on.panels(8.6, 2.7, 1, len(widths), width_ratios=widths, sharey=True)
    before, after = (shares[when] / np.maximum(shares["EXPECTED"], 1e-300) for when in ("BEFORE", "AFTER"))
    for axis, group in zip(axes, [*groups, "exposure"], strict=True):
        rows = np.flatnonzero(shares["GROUP"] == group)
        place = np.arange(len(rows))
        if group == "exposure":
            # Members are texts; the exposures follow each other by their number.
            rows = rows[np.argsort(shares["MEMBER"][rows].astype(int), kind="stable")]
            place = shares["MEMBER"][rows].astype(int)
        else:
            axis.set_xticks(place, shares["MEMBER"][rows], rotation=90 if group == "kind" else 0)
            axis.set_xlim(-0.6, len(rows) - 0.4)
        axis.axhline(1.0, color="0.5", lw=0.8, zorder=0)
        size = 5 if group != "exposure" else 3.5
        axis.vlines(place, before[rows], after[rows], color=style.QUIET, lw=1, zorder=1)
        axis.plot(place, before[rows], "o", color=style.BEFORE, ms=size, mfc="white", label="starting model")
        axis.plot(place, after[rows], "s", color=style.AFTER, ms=size - 0.5, label="final model")
        axis.set_xlabel(group)
    top = float(np.max(before, initial=1.0))
    if top > 5.0:
        axes[0].set_yscale("log")
        style.plain_ticks(axes[0].yaxis)
    axes[0].set_ylabel("mean squared residual /\nwhat noise alone gives")
    axes[-1].legend(frameon=False, loc="best")
    return figure


_STEPS = (0.0, 1.0, 2.0, thresholds.SEPARATION, 4.0, 5.0, 6.0)


@styled
def protection_figure(limits: DetectionLimits, on: Canvas = PAGE) -> AnyFigure:
    """Largest error of q and u by a single effect that goes undetected; crosses: not both in one exposure."""
    figure, axis = on.single(5.0, 3.8)
    percent = 100.0 * limits.protection
    if limits.worst is None:
        axis.text(0.5, 0.5, NO_LEVEL, ha="center", transform=axis.transAxes)
        axis.set_axis_off()
        return figure
    least, largest = float(np.nanmin(percent)), float(np.nanmax(percent))
    norm = LogNorm(least, max(largest, 1.2 * least))
    shown = style.error_map(axis, "largest error that goes undetected", limits.x, limits.y, percent, norm)
    style.colour_bar(shown, "error of q, u (%)")
    if np.isnan(percent).any():
        figure.legend(frameon=False, loc=style.ABOVE)
    return figure


@styled
def separation_figure(limits: DetectionLimits, on: Canvas = PAGE) -> AnyFigure:
    """Separation (σ) of effects (columns) from each one at its detection limit (rows); far ones are counted."""
    alike = limits.separation + np.where(np.eye(len(limits.effects), dtype=bool), np.inf, 0.0) < _STEPS[-1]
    confusable = np.flatnonzero((alike | alike.T).any(axis=0))
    confusable = confusable if confusable.size else np.arange(len(limits.effects))
    count, names = len(confusable), [limits.effects[i] for i in confusable]
    separation = limits.separation[np.ix_(confusable, confusable)]
    width = on.width or np.inf
    narrow = width < style.NARROW
    size = max(1.5, 0.17 * count)
    figure, axis = on.single(*((width, 0.13 * count + 1.5) if narrow else (size + 3.2, size + 2.0)))
    norm, aspect = BoundaryNorm(_STEPS, 256, extend="max"), "auto" if narrow else "equal"
    shown = axis.imshow(separation, norm=norm, cmap="RdYlBu", aspect=aspect)
    gap = "\n" if narrow else " "
    numbers = [str(k + 1) for k in range(count)]  # below a narrow figure, where names would take half of it
    rows = [f"{name}  {number}" for name, number in zip(names, numbers, strict=True)] if narrow else names
    axis.set_xticks(range(count), numbers if narrow else names, rotation=90, fontsize=style.SMALL)
    axis.set_yticks(range(count), rows, fontsize=style.SMALL)
    axis.set(xlabel="could be mistaken for", ylabel="effect present\n(at its detection limit)")
    if omitted := len(limits.effects) - count:
        axis.set_title(f"{omitted} other effects:{gap}more than {_STEPS[-1]:g} σ from all")
    label = f"separation (σ),{gap}below {thresholds.SEPARATION:g}: can be mistaken"
    if narrow:
        style.colour_bar(shown, label, axis, location="bottom", aspect=30)
    else:
        style.colour_bar(shown, label)
    return figure

"""Figures of Paper II, from a calibration and its data, and of the comparison with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.io.errors import DataError
from walop_jax.io.text import with_minus_sign
from walop_jax.paper.comparison import Comparison
from walop_jax.paper.polynomial import fit_paper, fit_transmissions, polariser_states
from walop_jax.paper.wavelength import plate_names, plate_retardances
from walop_jax.reports.style import DIVERGING, FONT, SMALL, empty_figure, field_axes, outer_labels
from walop_jax.science.star_errors import GOAL, QUANTITIES, MethodErrors, plate_errors

_PIXELS, _LINES = 31, 41
COEFFICIENTS = ("$1$", "$q_m$", "$u_m$", "$q_m^2$", "$u_m^2$")


def retardance_figure(calibration: Calibration, wavelength: float = 0.62) -> Figure:
    """Maps of the retardance of every half-wave plate over the field at one wavelength (µm), in degrees modulo 360."""
    instrument = calibration.model.instrument(calibration.values)
    names = plate_names(instrument)
    low_x, high_x, low_y, high_y = calibration.field
    x, y = np.meshgrid(np.linspace(low_x, high_x, _PIXELS), np.linspace(low_y, high_y, _PIXELS))
    found = plate_retardances(instrument, np.array([wavelength]), x.ravel(), y.ravel())[..., 0]
    figure = empty_figure(3.9 * len(names), 3.3)
    axes = figure.subplots(1, len(names), squeeze=False)
    for k, (axis, values) in enumerate(zip(axes[0], found, strict=True), start=1):
        # Unwrapped: a map that jumps by 360° would show the jump and nothing else.
        whole = np.unwrap(np.unwrap(values.reshape(x.shape), axis=1, period=360.0), axis=0, period=360.0)
        field_axes(axis, f"retardance of HWP{k} at {1e3 * wavelength:.0f} nm (deg)")
        image = axis.imshow(whole, origin="lower", extent=calibration.field, cmap="viridis")
        lines = axis.contour(
            whole, extent=calibration.field, levels=8, colors="w", linewidths=0.5, negative_linestyles="solid"
        )
        axis.clabel(lines, fontsize=5, fmt="%.0f")
        figure.colorbar(image, ax=axis, pad=0.03).ax.tick_params(labelsize=SMALL)
    outer_labels(axes)
    return figure


def retardance_wavelength_figure(
    calibration: Calibration, wavelengths: tuple[float, float] = (0.5, 0.75)
) -> Figure:
    """Retardance of every half-wave plate against wavelength (µm) at the centre and at the edges of the field."""
    instrument = calibration.model.instrument(calibration.values)
    names = plate_names(instrument)
    line = np.linspace(*wavelengths, _LINES)
    low_x, high_x, low_y, high_y = calibration.field
    places = {"centre": (0.5 * (low_x + high_x), 0.5 * (low_y + high_y))}
    places |= {with_minus_sign(f"X = {x:+.2f}°"): (x, 0.0) for x in (low_x, high_x)}
    places |= {with_minus_sign(f"Y = {y:+.2f}°"): (0.0, y) for y in (low_y, high_y)}
    x, y = (np.array(values) for values in zip(*places.values(), strict=True))
    found = plate_retardances(instrument, line, x, y)
    figure = empty_figure(3.9 * len(names), 3.1)
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    for k, (axis, curves) in enumerate(zip(axes, found, strict=True), start=1):
        for n, (place, curve) in enumerate(zip(places, curves, strict=True)):
            shown = np.unwrap(curve, period=360.0)
            style = ("-", "--", "-.", ":", (0, (5, 1)))[n]
            axis.plot(1e3 * line, shown, linestyle=style, color=f"C{n}", lw=1.3, label=place)
        axis.set_title(f"HWP{k}", fontsize=FONT)
        axis.set_xlabel("wavelength (nm)", fontsize=FONT)
        axis.tick_params(labelsize=SMALL)
    axes[0].set_ylabel("retardance (deg, modulo 360)", fontsize=FONT)
    axes[0].legend(frameon=False, fontsize=SMALL)
    return figure


def coefficients_figure(calset: CalibrationSet, filter_name: str) -> Figure:
    """Maps of the ten coefficients of the method of Paper II, a row for q and one for u."""
    found = fit_paper(calset, filter_name)
    figure = empty_figure(10.6, 4.3)
    axes = figure.subplots(2, 5, sharex=True, sharey=True)
    for row, quantity, coefficients in zip(axes, "qu", np.moveaxis(found.coefficients, 1, 0), strict=True):
        for axis, name, values in zip(row, COEFFICIENTS, coefficients.T, strict=True):
            field_axes(axis, f"{quantity}: {name}")
            low, high = _most(values)  # where an exposure holds no u a few are larger by orders of magnitude
            whole = low < 0 < high
            if whole:
                low, high = -max(-low, high), max(-low, high)
            shown = axis.scatter(
                found.x, found.y, c=values, s=18, marker="s", vmin=low, vmax=high,
                cmap=DIVERGING if whole else "viridis", linewidths=0,
            )  # fmt: skip
            figure.colorbar(shown, ax=axis, pad=0.03, extend="both").ax.tick_params(labelsize=SMALL - 1)
    outer_labels(axes)
    return figure


def _most(values: Float[np.ndarray, " p"]) -> tuple[float, float]:
    """The range of the values without those more than five (robust) standard deviations from their median."""
    median = float(np.median(values))
    spread = 5.0 * 1.4826 * float(np.median(np.abs(values - median))) or 1.0
    return max(float(values.min()), median - spread), min(float(values.max()), median + spread)


def transmission_figure(
    calset: CalibrationSet, filter_name: str, place: tuple[float, float] = (0.0, 0.0)
) -> Figure:
    """Share of the light in each camera against the polariser angle at the field point nearest to `place` (deg).

    With the model of Paper II, a constant plus terms in q and u of the polariser, and what it leaves below.
    """
    e = calset.exposures
    rows = np.flatnonzero(e.clp_in & ~e.chwp_in & (e.filter == filter_name))
    if len(np.unique(np.mod(e.clp_angle[rows], 180.0))) < 3:
        raise DataError(
            f"EXPOSURES: fewer than 3 polariser angles in {filter_name}: nothing to draw a curve through"
        )
    block = calset.intensities.block(0, len(calset.points))
    whole = np.flatnonzero(block.used[:, rows].all(axis=1))
    point = whole[np.argmin(np.hypot(block.x[whole] - place[0], block.y[whole] - place[1]))]
    angle, counts, sigma = (
        calset.exposures.clp_angle[rows],
        block.counts[point][rows],
        block.sigma[point][rows],
    )
    total = counts.sum(axis=1, keepdims=True)
    states = polariser_states(angle)
    terms = np.concatenate([np.ones((len(states), 1)), states], axis=1)
    model = fit_transmissions(counts[None], states)[0]
    fitted = terms @ model.T
    fine = np.linspace(angle.min(), angle.max(), 181)
    curve = np.concatenate([np.ones((181, 1)), polariser_states(fine)], axis=1) @ model.T
    figure = empty_figure(6.6, 4.2)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    for k in range(counts.shape[1]):
        above.plot(fine, curve[:, k] / curve.sum(axis=1), color=f"C{k}", lw=1.0)
        above.plot(angle, counts[:, k] / total[:, 0], "osD^"[k % 4], color=f"C{k}", ms=4, label=f"N{k}")
        residual = 100.0 * (counts[:, k] / total[:, 0] - fitted[:, k] / fitted.sum(axis=1))
        below.errorbar(
            angle, residual, 100.0 * sigma[:, k] / total[:, 0], fmt="osD^"[k % 4], ms=3, color=f"C{k}", lw=0.8
        )
    below.axhline(0.0, color="0.6", lw=0.8)
    where = with_minus_sign(f"({block.x[point]:+.2f}°, {block.y[point]:+.2f}°)")
    above.set_title(f"{where}, {filter_name}", fontsize=FONT)
    above.set_ylabel("share of the light", fontsize=FONT)
    below.set_ylabel("residual (%)", fontsize=FONT)
    below.set_xlabel("polariser angle (deg)", fontsize=FONT)
    above.legend(frameon=False, fontsize=SMALL, ncols=counts.shape[1])
    for axis in (above, below):
        axis.tick_params(labelsize=SMALL)
    return figure


_COLOURS = {"paper": "tab:orange", "joint": "tab:blue"}
_NAMES = {"paper": "Paper II, point by point", "joint": "joint model"}
_RANGE = (1e-3, 10.0)  # per cent
_PLATE_PIXELS = 49


def histogram_figure(comparison: Comparison) -> Figure:
    """Distribution over the field of the errors of q, u and p: on the grid points above, between them below."""
    figure = Figure(figsize=(9.6, 4.8), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True, sharey="row")
    bins = np.geomspace(*_RANGE, 33)
    for row, (place, title) in zip(
        axes, ((comparison.grid, "on grid points"), (comparison.between, "between them")), strict=True
    ):
        for axis, k in zip(row, range(3), strict=True):
            for method in ("paper", "joint"):
                values = np.clip(100 * getattr(place, method)[:, k], *_RANGE)
                axis.hist(values, bins, histtype="step", color=_COLOURS[method], label=_NAMES[method], lw=1.5)
            axis.axvline(100 * GOAL, color="0.5", lw=0.8, ls=":")
            axis.set_xscale("log")
            axis.set_title(f"{QUANTITIES[k]}, {title}", fontsize=9)
            axis.tick_params(labelsize=8)
        row[0].set_ylabel("field points", fontsize=9)
    for axis in axes[1]:
        axis.set_xlabel("rms error (%)", fontsize=9)
    axes[0, 0].legend(fontsize=7, loc="upper right")
    return figure


def map_figure(comparison: Comparison) -> Figure:
    """Maps of the errors of q and u of both methods between the grid points and on them."""
    figure = Figure(figsize=(10.4, 5.4), layout="constrained")
    axes = figure.subplots(2, 4, sharex=True, sharey=True)
    norm = LogNorm(2e-3, 2.0)
    shown = None
    for row, k in zip(axes, (0, 1), strict=True):
        panels = [(comparison.grid, m) for m in ("paper", "joint")]
        panels += [(comparison.between, m) for m in ("paper", "joint")]
        for axis, (place, method) in zip(row, panels, strict=True):
            shown = _contours(axis, place, method, k, norm)
            where = "on grid" if place is comparison.grid else "between"
            axis.set_title(f"{QUANTITIES[k]}, {method}, {where}", fontsize=9)
            axis.set_aspect("equal")
            axis.tick_params(labelsize=7)
    for axis in axes[1]:
        axis.set_xlabel("X (deg)", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("Y (deg)", fontsize=8)
    assert shown is not None
    bar = figure.colorbar(shown, ax=axes, pad=0.01, shrink=0.8)
    bar.set_ticks(
        [0.002, 0.01, 0.03, 0.1, 0.3, 1.0, 2.0], labels=["0.002", "0.01", "0.03", "0.1", "0.3", "1", "2"]
    )
    bar.set_label("rms error (%)", fontsize=9)
    return figure


def _contours(axis: Axes, place: MethodErrors, method: str, k: int, norm: LogNorm):  # type: ignore[no-untyped-def]
    values = 100 * getattr(place, method)[:, k]
    levels = np.geomspace(norm.vmin or 1e-3, norm.vmax or 1.0, 13)
    filled = axis.tricontourf(
        place.x, place.y, values, levels=levels, norm=norm, cmap="viridis", extend="both"
    )
    axis.tricontour(place.x, place.y, values, levels=[100 * GOAL], colors="white", linewidths=0.8)
    return filled


def offset_figure(comparison: Comparison) -> Figure:
    """Δq and Δu: against what the weakest direction of the design matrix predicts, and with one exposure more."""
    found = comparison.offsets
    figure = Figure(figsize=(9.6, 3.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for axis, c, name in ((left, 0, "q"), (middle, 1, "u")):
        for along, label, color in (
            (found.along, "one", "tab:orange"),
            (found.along_three, "three", "tab:blue"),
        ):
            axis.plot(
                100 * along[:, c], 100 * found.found[:, c], ".", ms=4, color=color, label=label, alpha=0.7
            )
        axis.legend(fontsize=7, title="directions", title_fontsize=7)
        edge = 105 * np.abs(found.found[:, c]).max()
        axis.plot([-edge, edge], [-edge, edge], color="0.6", lw=0.8)
        axis.set_xlabel(f"Δ{name} from the weakest directions (%)", fontsize=8)
        axis.set_ylabel(f"Δ{name} of the paper's fit (%)", fontsize=8)
    labels = ("as published", "noise-free states", "one unpolarised\nexposure added")
    for c, name, shift in ((0, "q", -0.15), (1, "u", 0.15)):
        sizes = [np.sqrt(np.mean(v[:, c] ** 2)) for v in (found.found, found.noiseless, found.anchored)]
        right.bar(np.arange(3) + shift, 100 * np.array(sizes), 0.28, label=f"Δ{name}")
    right.set_yscale("log")
    right.set_xticks(range(3), labels, fontsize=7)
    right.set_ylabel("rms over the grid (%)", fontsize=8)
    right.legend(fontsize=8)
    for axis in (left, middle, right):
        axis.tick_params(labelsize=7)
    return figure


def spectral_figure(comparison: Comparison) -> Figure:
    """Efficiencies and cross-talk across the filter at the extreme point; Δq_m, Δu_m of stars of four colours."""
    figure = Figure(figsize=(9.6, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    lines = comparison.lines
    for column, label in ((2, "$m_{22}$: q to q"), (6, "$m_{33}$: u to u"), (5, "$m_{32}$: q to u")):
        left.plot(1000 * lines[:, 0], lines[:, column], label=label, lw=1.2)
    left.set_xlabel("wavelength (nm)", fontsize=9)
    left.set_title("the extreme point of the field", fontsize=9)
    left.legend(fontsize=8)
    spread = np.clip(100 * comparison.colours, 1e-5, None)
    bins = np.geomspace(spread.min() * 0.9, spread.max() * 1.1, 30)
    for c, name in ((0, r"$\Delta q_m$"), (1, r"$\Delta u_m$")):
        right.hist(spread[:, c], bins, histtype="step", lw=1.5, label=name)
    right.axvline(0.05, color="0.5", ls=":", lw=0.8)
    right.set_xscale("log")
    right.set_xlabel("difference between four colours, p = 1 % (%)", fontsize=9)
    right.set_ylabel("grid points", fontsize=9)
    right.legend(fontsize=8)
    for axis in (left, right):
        axis.tick_params(labelsize=8)
    return figure


def plate_figure(calibration: Calibration, combinations: Sequence[Sequence[float | None]]) -> Figure:
    """Maps of how much worse than an ideal instrument (q, u) are known with some settings of the calibration plate.

    Each combination is a list of angles in degrees (None: out), one exposure each, and has a map of the photon error
    in the worse direction.
    """
    analysis = AnalysisVectors(calibration)
    low_x, high_x, low_y, high_y = calibration.field
    x, y = np.meshgrid(np.linspace(low_x, high_x, _PLATE_PIXELS), np.linspace(low_y, high_y, _PLATE_PIXELS))
    figure = Figure(figsize=(2.6 * len(combinations) + 0.9, 2.9), layout="constrained")
    axes = figure.subplots(1, len(combinations), sharey=True, squeeze=False)[0]
    norm, shown = LogNorm(1.0, 100.0), None
    for axis, plates in zip(axes, combinations, strict=True):
        settings = [Settings.default(1).at(CHWP=plate) for plate in plates]
        worst = plate_errors(analysis, settings, x.ravel(), y.ravel()).reshape(x.shape)
        shown = axis.pcolormesh(x, y, np.clip(worst, 1.0, 100.0), norm=norm, cmap="magma_r", rasterized=True)
        names = ["out" if plate is None else f"{plate:g}°" for plate in plates]
        axis.set_title("plate " + " and ".join(names), fontsize=9)
        axis.set_aspect("equal")
        axis.set_xlabel("X (deg)", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0].set_ylabel("Y (deg)", fontsize=8)
    assert shown is not None
    figure.colorbar(shown, ax=axes, pad=0.02).set_label("error / ideal instrument", fontsize=8)
    return figure

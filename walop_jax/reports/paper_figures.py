"""Figures of Paper II, from a calibration and its data, and of the comparison with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from walop_jax.calibration.accuracy import GOAL
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.base_model import instrument_of
from walop_jax.io.errors import DataError
from walop_jax.io.shapes import OfPoints
from walop_jax.io.text import with_minus_sign
from walop_jax.model.cameras import Cameras
from walop_jax.model.instrument import Instrument
from walop_jax.paper.comparison import Comparison
from walop_jax.paper.polynomial import fit_paper, fit_transmissions, polariser_states
from walop_jax.paper.wavelength import plate_names, plate_retardances
from walop_jax.reports import style
from walop_jax.reports.style import PAGE, AnyFigure, Canvas, styled
from walop_jax.science.star_errors import QUANTITIES, plate_errors, transmitted

_PIXELS, _LINES = 31, 41
_STEPS = 21  # from the centre of the field to its edge
_WAVELENGTH, _WAVELENGTHS = 0.62, (0.5, 0.75)  # µm
COEFFICIENTS = ("constant", "$q_m$", "$u_m$", "$q_m^2$", "$u_m^2$")


@styled
def retardance_figure(calibration: Calibration, on: Canvas = PAGE) -> AnyFigure:
    """Maps of the retardance of every half-wave plate over the field at one wavelength, in degrees modulo 360."""
    instrument = calibration.model.instrument(calibration.values)
    names = plate_names(instrument)
    retardances = plate_retardances(instrument, np.array([_WAVELENGTH]), *calibration.raster(_PIXELS))[..., 0]
    figure, (axes,) = on.panels(3.9 * len(names), 3.3, 1, len(names), maps=True)
    for name, axis, values in zip(names, axes, retardances, strict=True):
        # Unwrapped: a map that jumps by 360° would show the jump and nothing else.
        along = np.unwrap(values.reshape(_PIXELS, _PIXELS), axis=1, period=360.0)
        smooth = np.unwrap(along, axis=0, period=360.0)
        smooth -= 360.0 * np.floor(smooth[_PIXELS // 2, _PIXELS // 2] / 360.0)
        title = f"{style.PLATES.get(name, name)} at {1e3 * _WAVELENGTH:.0f} nm"
        norm = Normalize(float(smooth.min()), float(smooth.max()))
        image = style.pixel_map(axis, title, smooth, calibration.field, norm, style.SEQUENTIAL)
        style.colour_bar(image, "retardance (deg)" if axis is axes[-1] else "")
        look = {"colors": "w", "linewidths": 0.5, "negative_linestyles": "solid"}
        lines = axis.contour(smooth, extent=calibration.field, levels=6, **look)
        axis.clabel(lines, fontsize=style.SMALL - 1, fmt=lambda value: with_minus_sign(f"{value:.0f}"))
    return figure


@styled
def retardance_wavelength_figure(calibration: Calibration, on: Canvas = PAGE) -> AnyFigure:
    """Retardance of every half-wave plate against wavelength at the centre and at the edges of the field."""
    instrument = calibration.model.instrument(calibration.values)
    names = plate_names(instrument)
    line = np.linspace(*_WAVELENGTHS, _LINES)
    low_x, high_x, low_y, high_y = calibration.field
    places = {"centre": (0.5 * (low_x + high_x), 0.5 * (low_y + high_y))}
    places |= {with_minus_sign(f"X = {x:+.2f}°"): (x, 0.0) for x in (low_x, high_x)}
    places |= {with_minus_sign(f"Y = {y:+.2f}°"): (0.0, y) for y in (low_y, high_y)}
    x, y = (np.array(values) for values in zip(*places.values(), strict=True))
    retardances = _unwrapped_retardances(instrument, line, x, y)
    figure, (axes,) = on.panels(3.9 * len(names), 3.5, 1, len(names))
    for name, axis, curves in zip(names, axes, retardances, strict=True):
        for n, (place, curve) in enumerate(zip(places, curves, strict=True)):
            dashes = ("-", "--", "-.", ":", (0, (4, 4)))[n]
            axis.plot(1e3 * line, curve, linestyle=dashes, color=f"C{n}", lw=1.3, label=place)
        axis.set(title=style.PLATES.get(name, name), xlabel="wavelength (nm)")
    axes[0].set_ylabel("retardance (deg)")
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, ncols=3, loc=style.ABOVE)
    return figure


def _unwrapped_retardances(
    instrument: Instrument, line: Float[np.ndarray, " w"], x: OfPoints, y: OfPoints
) -> Float[np.ndarray, "n p w"]:
    """Retardances (deg) of plates at places and wavelengths (µm), without jumps of 360°.

    At the wavelength of the maps they are those of the maps: between 0 and 360° at the first place, continuous from
    there along a straight line to each other.
    """
    steps = np.linspace(0.0, 1.0, _STEPS)[:, None]
    along = [(v[0] + steps * (v - v[0])).ravel() for v in (x, y)]
    lines = np.append(_WAVELENGTH, line)
    retardances = plate_retardances(instrument, lines, *along).reshape(-1, _STEPS, len(x), len(lines))
    turns = np.floor(retardances[:, :1, 0, 0] / 360.0)
    at_reference = np.unwrap(retardances[..., 0], axis=1, period=360.0)[:, -1] - 360.0 * turns
    curves = np.unwrap(retardances[:, -1, :, 1:], axis=-1, period=360.0)
    near = int(np.argmin(np.abs(line - _WAVELENGTH)))
    jump = curves[..., near] - at_reference
    return curves - 360.0 * np.round(jump / 360.0)[..., None]


@styled
def coefficients_figure(calset: CalibrationSet, filter_name: str, on: Canvas = PAGE) -> AnyFigure:
    """Maps of the ten coefficients of the method of Paper II, a row for q and one for u."""
    fits = fit_paper(calset, filter_name)
    figure, axes = on.panels(10.6, 4.3, 2, 5, maps=True)
    for row, quantity, coefficients in zip(axes, "qu", np.moveaxis(fits.coefficients, 1, 0), strict=True):
        for axis, name, values in zip(row, COEFFICIENTS, coefficients.T, strict=True):
            title = f"{quantity}, {name}{'' if name == COEFFICIENTS[0] else ' term'}"
            # Where an exposure holds no u a few are larger by orders of magnitude.
            median = float(np.median(values))
            spread = 5.0 * 1.4826 * float(np.median(np.abs(values - median))) or 1.0
            low, high = max(float(values.min()), median - spread), min(float(values.max()), median + spread)
            both_signs = low < 0 < high
            if both_signs:
                low, high = -max(-low, high), max(-low, high)
            colours = style.DIVERGING if both_signs else style.SEQUENTIAL
            shown = style.point_map(axis, title, fits.x, fits.y, values, Normalize(low, high), colours)
            style.colour_bar(shown, extend="both")
    return figure


@styled
def transmission_figure(
    calset: CalibrationSet,
    filter_name: str,
    place: tuple[float, float] = (0.0, 0.0),
    on: Canvas = PAGE,
    cameras: Cameras | None = None,
) -> AnyFigure:
    """Fraction of the light in each camera against the polariser angle at the field point nearest to `place` (deg).

    With the model of Paper II, a constant plus terms in q and u of the polariser; its residuals below.
    """
    e = calset.exposures
    rows = np.flatnonzero(e.clp_in & ~e.position(CALIBRATION_PLATE).inside & (e.filter == filter_name))
    if len(np.unique(np.mod(e.clp_angle[rows], 180.0))) < 3:
        what = f"EXPOSURES: fewer than 3 polariser angles in {filter_name}"
        raise DataError(f"{what}: nothing to draw a curve through")
    block = calset.intensities.block(0, len(calset.points))
    complete = np.flatnonzero(block.used[:, rows].all(axis=1))
    if not complete.size:
        raise DataError(f"INTENSITIES: no field point has all polariser angles in {filter_name}")
    point = complete[np.argmin(np.hypot(block.x[complete] - place[0], block.y[complete] - place[1]))]
    angle, counts, sigma = e.clp_angle[rows], block.counts[point, rows], block.sigma[point, rows]
    total = counts.sum(axis=1, keepdims=True)
    model = fit_transmissions(counts[None], polariser_states(angle))
    fine = np.linspace(angle.min(), angle.max(), 181)
    fitted, curve = (transmitted(model, polariser_states(angles))[0] for angles in (angle, fine))
    names = (cameras or instrument_of(calset).cameras).names
    figure, ((above,), (below,)) = on.panels(6.6, 4.2, 2, 1, sharex=True, height_ratios=(2.2, 1.0))
    for k in range(counts.shape[1]):
        above.plot(fine, curve[:, k] / curve.sum(axis=1), color=f"C{k}", lw=1.0)
        above.plot(angle, counts[:, k] / total[:, 0], "osD^"[k % 4], color=f"C{k}", ms=4, label=names[k])
        residual = 100.0 * (counts[:, k] / total[:, 0] - fitted[:, k] / fitted.sum(axis=1))
        error, look = 100.0 * sigma[:, k] / total[:, 0], {"fmt": "osD^"[k % 4], "color": f"C{k}"}
        below.errorbar(angle, residual, error, ms=3, lw=0.8, **look)
    below.axhline(0.0, color="0.6", lw=0.8)
    where = with_minus_sign(f"({block.x[point]:+.2f}°, {block.y[point]:+.2f}°)")
    above.set_title(f"{where}, {filter_name}", loc="left")
    above.set_ylabel("fraction of the light")
    below.set(xlabel="polariser angle (deg)", ylabel="residual (%)")
    figure.legend(*above.get_legend_handles_labels(), frameon=False, ncols=len(names), loc=style.ABOVE)
    style.angle_ticks(below)
    return figure


_COLOURS = {"paper": "tab:orange", "joint": "tab:blue"}
_NAMES = {"paper": "Paper II, point by point", "joint": "joint model"}
_RANGE = (1e-3, 10.0)  # per cent
_PLATE_PIXELS = 49
PLATE_SETTINGS = ((None,), (0.0, 45.0), (None, 22.5))  # deg: single exposures, the pair of Paper II, ours


@styled
def histogram_figure(comparison: Comparison) -> Figure:
    """Distribution over the field of the errors of q, u and p: on the grid points above, between them below."""
    figure, axes = PAGE.panels(9.6, 4.8, 2, 3, sharex=True, sharey="row")
    bins = np.geomspace(*_RANGE, 33)
    places = (comparison.grid, "on grid points"), (comparison.between, "between them")
    for row, (place, title) in zip(axes, places, strict=True):
        for axis, k in zip(row, range(3), strict=True):
            for method in ("paper", "joint"):
                values = np.clip(100 * getattr(place, method)[:, k], *_RANGE)
                axis.hist(values, bins, histtype="step", color=_COLOURS[method], label=_NAMES[method], lw=1.5)
            axis.axvline(100 * GOAL, color="0.5", lw=0.8, ls=":", label=f"goal {100 * GOAL:g} %")
            axis.set(xscale="log", title=f"{QUANTITIES[k]}, {title}")
            style.plain_ticks(axis.xaxis)
        row[0].set_ylabel("field points")
    for axis in axes[1]:
        axis.set_xlabel("rms error (%); the end bins hold all beyond")
    axes[0, 0].legend(frameon=False, loc="upper right")
    return figure


@styled
def map_figure(comparison: Comparison) -> Figure:
    """Maps of the errors of q and u of both methods, on the grid points and between them, a tile for each point."""
    figure, axes = PAGE.panels(10.4, 5.0, 2, 4, sharex=True, sharey=True)
    norm, shown = LogNorm(2e-3, 2.0), None
    for row, k in zip(axes, (0, 1), strict=True):
        panels = [(place, m) for place in (comparison.grid, comparison.between) for m in ("paper", "joint")]
        for axis, (place, method) in zip(row, panels, strict=True):
            where = "on the grid" if place is comparison.grid else "between"
            title = f"{QUANTITIES[k]}, {_NAMES[method].partition(',')[0]}, {where}"
            percent = 100 * getattr(place, method)[:, k]
            shown = style.point_map(axis, title, place.x, place.y, percent, norm, style.SEQUENTIAL)
    style.colour_bar(shown, "rms error (%)", axes, pad=0.01, shrink=0.8, extend="both")
    return figure


@styled
def offset_figure(comparison: Comparison) -> Figure:
    """Δq and Δu: against those of the weakest direction of the design matrix, and with one exposure more."""
    offsets = comparison.offsets
    figure, ((left, middle, right),) = PAGE.panels(9.6, 3.2, 1, 3)
    for axis, c, name in ((left, 0, "q"), (middle, 1, "u")):
        of_both = (offsets.along, "one", "tab:orange"), (offsets.along_three, "three", "tab:blue")
        for along, label, color in of_both:
            axis.plot(100 * along[:, c], 100 * offsets.found[:, c], ".", ms=4, color=color, label=label)
        axis.legend(title="directions", title_fontsize=style.SMALL)
        edge = 105 * np.abs(offsets.found[:, c]).max()
        axis.plot([-edge, edge], [-edge, edge], color="0.6", lw=0.8)
        words = f"Δ{name} from the weakest directions (%)", f"Δ{name} fitted as in Paper II (%)"
        axis.set(xlabel=words[0], ylabel=words[1])
    labels = ("as published", "noise-free states", "one unpolarised\nexposure added")
    for c, name, shift in ((0, "q", -0.15), (1, "u", 0.15)):
        sizes = [np.sqrt(np.mean(v[:, c] ** 2)) for v in (offsets.found, offsets.noiseless, offsets.anchored)]
        right.bar(np.arange(3) + shift, 100 * np.array(sizes), 0.28, label=f"Δ{name}")
    right.set(yscale="log", ylabel="rms over the grid (%)")
    right.set_xticks(range(3), labels, fontsize=style.SMALL)
    right.legend(fontsize=style.FONT)
    return figure


@styled
def spectral_figure(comparison: Comparison) -> Figure:
    """Efficiencies and cross-talk across the filter at the extreme point; Δq_m, Δu_m of stars of four colours."""
    figure, ((left, right),) = PAGE.panels(9.6, 3.2, 1, 2)
    lines = comparison.lines
    for column, label in ((2, "$m_{22}$: q to q"), (6, "$m_{33}$: u to u"), (5, "$m_{32}$: q to u")):
        left.plot(1000 * lines[:, 0], lines[:, column], label=label, lw=1.2)
    left.set(xlabel="wavelength (nm)", title="at the corner of the field where colour matters most")
    left.legend(fontsize=style.FONT)
    spread = np.clip(100 * comparison.colours, 1e-5, None)
    bins = np.geomspace(spread.min() * 0.9, spread.max() * 1.1, 30)
    for c, name in ((0, r"$\Delta q_m$"), (1, r"$\Delta u_m$")):
        right.hist(spread[:, c], bins, histtype="step", lw=1.5, label=name)
    right.axvline(0.05, color="0.5", ls=":", lw=0.8)
    colour = "largest change with the colour of a star, p = 1 % (%)"
    right.set(xscale="log", xlabel=colour, ylabel="grid points")
    right.legend(fontsize=style.FONT)
    return figure


@styled
def plate_figure(
    calibration: Calibration, combinations: Sequence[Sequence[float | None]] = PLATE_SETTINGS
) -> Figure:
    """Maps of how much worse than an ideal instrument (q, u) are known with some settings of the calibration plate.

    Each combination is a list of angles in degrees (None: out), one exposure each, and has a map of the photon error
    in the worse direction.
    """
    analysis = AnalysisVectors(calibration)
    x, y = calibration.raster(_PLATE_PIXELS)
    count, norm, shown = len(combinations), LogNorm(1.0, 100.0), None
    figure, (axes,) = PAGE.panels(2.6 * count + 0.9, 2.9, 1, count, sharey=True)
    for axis, plates in zip(axes, combinations, strict=True):
        settings = [Settings.default(1).at(CHWP=plate) for plate in plates]
        worst = plate_errors(analysis, settings, x, y).reshape(_PLATE_PIXELS, _PLATE_PIXELS)
        title = "plate " + " and ".join("out" if plate is None else f"{plate:g}°" for plate in plates)
        shown = style.pixel_map(axis, title, np.clip(worst, 1.0, 100.0), calibration.field, norm, "magma_r")
    style.colour_bar(shown, "error / ideal instrument", axes, pad=0.02)
    return figure

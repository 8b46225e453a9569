"""The figures of Paper II that are not maps of the matrix, from a calibration and its data."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.retardance import plate_names, plate_retardances
from walop_jax.data.records import CalibrationSet
from walop_jax.io.errors import DataError
from walop_jax.io.rounding import with_minus_sign
from walop_jax.paper.polynomial import (
    fit_paper,
    fit_transmissions,
    polariser_states,
)
from walop_jax.reports.style import DIVERGING, FONT, SMALL, empty_figure, field_axes, outer_labels

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

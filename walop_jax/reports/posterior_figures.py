"""Figures of a posterior: corner and trace."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from walop_jax.io.atomic import atomic_path
from walop_jax.io.rounding import with_error

SHARES = (0.393, 0.865)  # of the draws: inside 1 and 2 σ of a normal distribution of two coefficients
BINS = 30  # of a histogram, along each axis
MOST_IN_CORNER = 6  # coefficients whose axes can carry numbers
PRIOR_ONLY = 0.9  # of the prior width: a wider posterior is a picture of the prior
POINTS = 500  # draws shown as points
LABELS = {
    "sky.depolarisation": "δ",
    "collimator.diattenuation": "c",
    "collimator.q": "$c_q$",
    "collimator.u": "$c_u$",
    "pupil.magnification": "M",
    "pupil.distortion": "κ",
    "half1.wedge": "$w_1$",
    "half2.wedge": "$w_2$",
    "half1.plate.quartz": "$d_{q,1}$",
    "half1.plate.mgf2": "$d_{m,1}$",
    "half2.plate.quartz": "$d_{q,2}$",
    "half2.plate.mgf2": "$d_{m,2}$",
    "chwp.quartz": "$d_{q,c}$",
    "chwp.mgf2": "$d_{m,c}$",
    "half1.efficiency": "$η_1$",
    "half2.efficiency": "$η_2$",
    "noise.ln_f": "ln f",
}
"""Symbols of the coefficients that people quote; others keep their name."""


def label(name: str, unit: str = "") -> str:
    """Symbol of a coefficient, with its unit."""
    text = LABELS.get(name, name)
    return f"{text} [{unit}]" if unit else text


def informed(
    names: Sequence[str], spread: Mapping[str, float], prior: Mapping[str, float]
) -> tuple[str, ...]:
    """The names of which the data say something, most first: posterior narrower than the prior, where there is one.

    `spread` holds standard deviations of the posterior, `prior` those of the prior (NaN: none).
    """
    share = {
        name: spread[name] / prior[name] if np.isfinite(prior.get(name, np.nan)) else 0.0 for name in names
    }
    return tuple(sorted((n for n in names if share[n] < PRIOR_ONLY), key=lambda n: share[n]))


def _edges(values: Float[np.ndarray, " d"]) -> Float[np.ndarray, " b"]:
    low, high = float(values.min()), float(values.max())
    margin = 0.05 * (high - low) or abs(low) or 1.0  # a coefficient that never moved has a panel too
    return np.linspace(low - margin, high + margin, BINS + 1)


def density_levels(density: Float[np.ndarray, "a b"], shares: Sequence[float]) -> Float[np.ndarray, " s"]:
    """Densities above which those shares of the total lie; `shares` ascending, hence levels descending."""
    ordered = np.sort(density, axis=None)[::-1]
    inside = np.cumsum(ordered) / ordered.sum()
    return ordered[np.searchsorted(inside, shares)]


def _smoothed(counts: Float[np.ndarray, "a b"]) -> Float[np.ndarray, "a b"]:
    """Convolved with a normal distribution one bin wide."""
    kernel = np.exp(-0.5 * np.arange(-3.0, 4.0) ** 2)
    for axis in (0, 1):
        counts = np.apply_along_axis(np.convolve, axis, counts, kernel / kernel.sum(), mode="same")
    return counts


def _pair(
    axes: Axes,
    x: Float[np.ndarray, " d"],
    y: Float[np.ndarray, " d"],
    x_edges: Float[np.ndarray, " b"],
    y_edges: Float[np.ndarray, " b"],
) -> None:
    step = max(1, len(x) // POINTS)
    axes.plot(x[::step], y[::step], "o", markersize=0.7, color="0.5", markeredgewidth=0, zorder=0)
    density = _smoothed(np.histogram2d(x, y, (x_edges, y_edges))[0]).T
    levels = density_levels(density, SHARES)[::-1]
    if not np.all(np.diff([*levels, density.max()]) > 0):  # too few different draws for a contour
        return
    middles = [0.5 * (edges[1:] + edges[:-1]) for edges in (x_edges, y_edges)]
    axes.contourf(*middles, density, [*levels, density.max()], colors=["0.75", "0.35"])
    axes.contour(*middles, density, levels, colors="k", linewidths=0.6)


def corner_figure(
    draws: Float[np.ndarray, "d k"],
    names: Sequence[str],
    units: Sequence[str],
    reference: Float[np.ndarray, " k"] | None = None,
    width: float = 7.1,
) -> Figure:
    """Histogram of every coefficient, and below the diagonal contours of every pair of them.

    Contours hold 39 and 86 % of the draws, which is 1 and 2 σ of a normal distribution of two coefficients.
    `reference` marks values (the fit, or a known truth). `width` in inches: 7.1 is two columns of A&A or ApJ. Median
    and half the 68 % interval stand above the diagonal; beyond six coefficients the axes carry no numbers.
    """
    k = draws.shape[1]
    few = k <= 6
    figure = Figure(figsize=(width, width))
    panels = figure.subplots(k, k, squeeze=False)
    figure.subplots_adjust(left=0.1, right=0.99, bottom=0.08, top=0.94, wspace=0.05, hspace=0.05)
    edges = [_edges(column) for column in draws.T]
    for i in range(k):
        for j in range(k):
            axes = panels[i, j]
            if j > i:
                axes.set_visible(False)
                continue
            if i == j:
                axes.hist(draws[:, i], edges[i], histtype="step", color="k", linewidth=0.8)
                axes.set_yticks([])
            else:
                _pair(axes, draws[:, j], draws[:, i], edges[j], edges[i])
                axes.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
                axes.set_ylim(edges[i][0], edges[i][-1])
            axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
            axes.set_xlim(edges[j][0], edges[j][-1])
            if reference is not None:
                axes.axvline(reference[j], color="tab:orange", linewidth=0.8)
                if i != j:
                    axes.axhline(reference[i], color="tab:orange", linewidth=0.8)
    low, middle, high = np.quantile(draws, (0.1587, 0.5, 0.8413), axis=0)
    size = 8 if few else 6
    for i in range(k):
        title = f"{LABELS.get(names[i], names[i])}\n{with_error(float(middle[i]), float(0.5 * (high[i] - low[i])))}"
        panels[i, i].set_title(f"{title} {units[i]}".rstrip(), fontsize=8 if few else 4.5, loc="left")
        for j in range(i + 1):
            axes = panels[i, j]
            axes.tick_params(
                labelsize=6.5 if few else 5,
                length=2,
                labelbottom=few and i == k - 1,
                labelleft=few and 0 == j < i,
            )
            axes.tick_params(axis="x", labelrotation=45)
            for axis in (axes.xaxis, axes.yaxis) if i != j else (axes.xaxis,):
                axis.set_major_formatter(ScalarFormatter(useOffset=False))
                axis.get_offset_text().set_fontsize(5)
                axis.get_offset_text().set_visible(few)
        panels[k - 1, i].set_xlabel(
            label(names[i], units[i]) if few else LABELS.get(names[i], names[i]), fontsize=size
        )
        if i > 0:
            text = label(names[i], units[i]) if few else LABELS.get(names[i], names[i])
            panels[i, 0].set_ylabel(
                text, fontsize=size, rotation=90 if few else 0, ha="center" if few else "right"
            )
    return figure


def trace_figure(
    chains: Float[np.ndarray, "e n w k"],
    names: Sequence[str],
    units: Sequence[str],
    thin: int,
    tau: Float[np.ndarray, " k"],
    width: float = 7.1,
) -> Figure:
    """Median and 68 % band of the walkers against the step, one colour per ensemble, with τ as a bar."""
    e, n, _, k = chains.shape
    figure = Figure(figsize=(width, 0.9 * k + 0.6), layout="constrained")
    panels = figure.subplots(k, 1, sharex=True, squeeze=False)[:, 0]
    step = thin * np.arange(n)
    for i, axes in enumerate(panels):
        for j in range(e):
            low, middle, high = np.quantile(chains[j, :, :, i], (0.16, 0.5, 0.84), axis=1)
            axes.fill_between(step, low, high, color=f"C{j}", alpha=0.25, linewidth=0)
            axes.plot(step, middle, color=f"C{j}", linewidth=0.6)
        if np.isfinite(tau[i]):
            bottom = axes.get_ylim()[0]
            axes.plot([0, tau[i]], [bottom, bottom], color="k", linewidth=3, solid_capstyle="butt")
            axes.text(
                1.0, 1.0, f"τ = {tau[i]:.1f}", transform=axes.transAxes, fontsize=6, ha="right", va="bottom"
            )
        axes.set_ylabel(label(names[i], units[i]), fontsize=6, rotation=0, ha="right", va="center")
        axes.tick_params(labelsize=5)
        axes.yaxis.set_major_locator(MaxNLocator(3))
        axes.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
    panels[-1].set_xlabel("step after burn-in", fontsize=7)
    return figure


def save_figure(
    path: str | os.PathLike[str], figure: Figure, *, overwrite: bool = False, dpi: int = 200
) -> None:
    """Write a figure (format by the name); it appears whole or not at all."""
    with atomic_path(path, overwrite=overwrite) as temporary:
        figure.savefig(temporary, dpi=dpi, bbox_inches="tight")

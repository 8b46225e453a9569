"""Figures of a posterior: corner and trace."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from walop_jax.io.atomic import atomic_path
from walop_jax.reports.wording import with_error

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # corner imports ArviZ, which announces a refactoring once a day
    import corner

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


def corner_figure(
    draws: Float[np.ndarray, "d k"],
    names: Sequence[str],
    units: Sequence[str],
    reference: Float[np.ndarray, " k"] | None = None,
    width: float = 7.1,
) -> Figure:
    """Corner plot with 68 and 95 % contours; `reference` marks values (the fit, or a known truth).

    `width` in inches: 7.1 is two columns of A&A or ApJ. Median and half the 68 % interval stand above the
    diagonal; beyond six coefficients the axes carry no numbers.
    """
    k = draws.shape[1]
    few = k <= 6
    figure = Figure(figsize=(width, width))
    corner.corner(
        draws,
        fig=figure,
        truths=None if reference is None else list(reference),
        truth_color="tab:orange",
        levels=(0.68, 0.95),
        plot_datapoints=False,
        fill_contours=True,
        smooth=1.0,
        bins=30,
        max_n_ticks=3,
        hist_kwargs={"linewidth": 0.8},
        contour_kwargs={"linewidths": 0.6},
    )
    panels = np.array(figure.axes).reshape(k, k)
    low, middle, high = np.quantile(draws, (0.1587, 0.5, 0.8413), axis=0)
    size = 8 if few else 6
    for i in range(k):
        title = f"{LABELS.get(names[i], names[i])}\n{with_error(float(middle[i]), float(0.5 * (high[i] - low[i])))}"
        panels[i, i].set_title(f"{title} {units[i]}".rstrip(), fontsize=8 if few else 4.5, loc="left")
        for j in range(i + 1):
            axes = panels[i, j]
            axes.tick_params(
                labelsize=5, length=2, labelbottom=few and i == k - 1, labelleft=few and 0 == j < i
            )
            for axis in (axes.xaxis, axes.yaxis):
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
    panels[-1].set_xlabel("step after burn-in", fontsize=7)
    return figure


def save_figure(
    path: str | os.PathLike[str], figure: Figure, *, overwrite: bool = False, dpi: int = 200
) -> None:
    """Write a figure (format by the name); it appears whole or not at all."""
    with atomic_path(path, overwrite=overwrite) as temporary:
        figure.savefig(temporary, dpi=dpi, bbox_inches="tight")

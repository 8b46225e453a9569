"""Figures of a posterior: corner and trace."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from walop_jax.io.atomic import atomic_path
from walop_jax.io.text import RAISED, with_error
from walop_jax.reports.style import PAGE, SMALL, AnyFigure, Canvas, PaperFigure, styled, texts

SHARES = (0.393, 0.865)  # of the draws: inside 1 and 2 σ of a normal distribution of two coefficients
BINS = 30  # of a histogram, along each axis
MOST_IN_CORNER = 6  # coefficients whose axes can carry numbers
CORNER = 7.1  # inches: two columns of A&A or ApJ
PRIOR_ONLY = 0.9  # of the prior width: a wider posterior is a picture of the prior


def label(name: str, unit: str = "") -> str:
    """Symbol of a coefficient, with its unit."""
    text, _ = texts("symbols").get(name, (name, name))
    return f"{text} ({unit_in_words(unit)})" if unit else text


def key(names: Sequence[str]) -> str:
    """What the symbols of coefficients mean, a line each: their names in the table of parameters."""
    return "\n".join(f"{symbol}: {name}" for name in names if (symbol := label(name)) != name)


def unit_in_words(unit: str) -> str:
    """A unit as it is printed: µm, deg⁻²."""
    raised = re.sub(r"(?<=[A-Za-z])-?\d+", lambda power: power[0].translate(RAISED), unit)
    return "µm" if raised == "um" else raised


def informed(
    names: Sequence[str], spread: Mapping[str, float], prior: Mapping[str, float]
) -> tuple[str, ...]:
    """Names that the data constrain, best first: `spread` (posterior) below that of the `prior` (NaN: none)."""
    share = {name: np.nan_to_num(spread[name] / prior.get(name, np.nan)) for name in names}
    return tuple(sorted((n for n in names if share[n] < PRIOR_ONLY), key=lambda n: share[n]))


def correlated(
    draws: Float[np.ndarray, "d k"],
    names: Sequence[str],
    prior: Mapping[str, float],
    most: int = MOST_IN_CORNER,
) -> tuple[str, ...]:
    """The coefficients worth a corner plot, at most `most`, in their order.

    Of those that the data constrain (`informed`; all where there is none) the two most correlated, then one after the
    other whatever is most correlated with any of these.
    """
    spread = dict(zip(names, draws.std(axis=0).tolist(), strict=True))
    pool = informed(names, spread, prior) or tuple(names)
    if len(pool) <= most:
        return tuple(name for name in names if name in pool)
    columns = draws[:, [names.index(name) for name in pool]]
    with np.errstate(invalid="ignore"):  # of a coefficient that never moved
        size = np.nan_to_num(np.abs(np.corrcoef(columns, rowvar=False)))
    np.fill_diagonal(size, 0.0)
    chosen = [int(np.argmax(size.max(axis=1)))]
    while len(chosen) < most:
        nearest = size[chosen].max(axis=0)
        nearest[chosen] = -1.0
        chosen.append(int(np.argmax(nearest)))
    shown_names = {pool[i] for i in chosen}
    return tuple(name for name in names if name in shown_names)


@styled
def corner_figure(
    draws: Float[np.ndarray, "d k"],
    names: Sequence[str],
    units: Sequence[str],
    reference: Mapping[str, float] | None = None,
    width: float = CORNER,
) -> Figure:
    """Histogram of every coefficient, and below the diagonal contours of every pair of them, drawn by `corner`.

    Contours hold 39 and 86 % of the draws, which is 1 and 2 σ of a normal distribution of two coefficients.
    `reference` marks values by name (the fit, or a known truth). `width` in inches.
    Median and half the 68 % interval stand above the diagonal; beyond six coefficients the axes carry no numbers.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ArviZ, which it imports, makes an announcement
        from corner import corner
    k = draws.shape[1]
    few, marked = k <= MOST_IN_CORNER, reference or {}
    lowest, highest = draws.min(axis=0), draws.max(axis=0)
    # A coefficient that never moved has a panel too.
    margin = 0.05 * np.where(highest > lowest, highest - lowest, 20.0 * (np.abs(lowest) + (lowest == 0)))
    shown = [label(name, unit if few else "") for name, unit in zip(names, units, strict=True)]
    figure = PaperFigure(figsize=(width, width))
    corner(
        draws, bins=BINS, range=list(zip(lowest - margin, highest + margin, strict=True)), smooth=1.0, labels=shown,
        label_kwargs={"fontsize": 8 if few else 6}, levels=SHARES, plot_density=False, fill_contours=True, quiet=True,
        contour_kwargs={"linewidths": 0.6}, contourf_kwargs={"colors": ["none", "0.75", "0.35"]}, color="k",
        data_kwargs={"ms": 0.7, "color": "0.5", "alpha": 0.3}, hist_kwargs={"linewidth": 0.8},
        max_n_ticks=3 if few else 0, fig=figure,
    )  # fmt: skip
    edges = {"left": 0.71 / width, "bottom": 0.64 / width, "top": 1.0 - 0.43 / width}
    figure.subplots_adjust(**edges, right=1.0 - 0.07 / width, wspace=0.05, hspace=0.05)
    place = {"ha": "right", "va": "top", "fontsize": 7 if few else 4.5, "linespacing": 1.4}
    figure.text(1.0 - 0.07 / width, 1.0 - 0.05 / width, key(names), **place)
    low, middle, high = np.quantile(draws, (0.1587, 0.5, 0.8413), axis=0)
    panels = np.array(figure.axes, dtype=object).reshape(k, k)
    for i in range(k):
        numbers = with_error(float(middle[i]), float(0.5 * (high[i] - low[i])))
        title = f"{label(names[i])}\n{numbers} {unit_in_words(units[i])}".rstrip()
        panels[i, i].set_title(title, fontsize=8 if few else 4.5, loc="left")
        below, left = panels[k - 1, i], panels[i, 0]
        half = 0.5 * below.get_position().width
        below.xaxis.set_label_coords(below.get_position().x0 + half, 0.02, transform=figure.transFigure)
        left.yaxis.set_label_coords(0.03, left.get_position().y0 + half, transform=figure.transFigure)
        if few:
            for axis in (below.xaxis, left.yaxis)[: 1 + (i > 0)]:
                axis.set_major_locator(MaxNLocator(3, prune="both"))
                axis.set_major_formatter(ScalarFormatter(useOffset=False))
        for j, axes in enumerate(panels[i, : i + 1]):
            axes.tick_params(labelsize=6.5, length=2)
            if names[j] in marked:
                axes.axvline(marked[names[j]], color="tab:orange", linewidth=0.8)
            if names[i] in marked and i != j:
                axes.axhline(marked[names[i]], color="tab:orange", linewidth=0.8)
    return figure


@styled
def trace_figure(
    chains: Float[np.ndarray, "e n w k"],
    names: Sequence[str],
    units: Sequence[str],
    thin: int | None,
    tau: Float[np.ndarray, " k"],
    on: Canvas = PAGE,
) -> AnyFigure:
    """Median and 68 % band of walkers against the step, a colour per ensemble; the bar is one autocorrelation time.

    Without `thin`, the steps from one to the next, they are draws in the order of their file.
    """
    e, n, _, k = chains.shape
    figure, panels = on.panels(7.1, 0.9 * k + 0.6, k, 1, labels=0.05, sharex=True)
    step = (thin or 1) * np.arange(n)
    for i, axes in enumerate(panels[:, 0]):
        for j in range(e):
            low, middle, high = np.quantile(chains[j, :, :, i], (0.16, 0.5, 0.84), axis=1)
            axes.fill_between(step, low, high, color=(*to_rgb(f"C{j}"), 0.25), linewidth=0)
            axes.plot(step, middle, color=f"C{j}", linewidth=0.6)
        if np.isfinite(tau[i]):
            bottom = axes.get_ylim()[0]
            axes.plot([0, tau[i]], [bottom, bottom], color="k", linewidth=3, solid_capstyle="butt")
            caption = f"autocorrelation time (bar) {tau[i]:.1f} steps"
            axes.text(1.0, 1.0, caption, transform=axes.transAxes, fontsize=SMALL, ha="right", va="bottom")
        axes.set_ylabel(label(names[i], units[i]), fontsize=SMALL, rotation=0, ha="right", va="center")
        axes.text(0.0, 1.0, key((names[i],)), transform=axes.transAxes, fontsize=SMALL, va="bottom")
        axes.tick_params(labelsize=SMALL - 1)
        axes.yaxis.set_major_locator(MaxNLocator(3))
        axes.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
    panels[-1, 0].set_xlabel("step after burn-in" if thin else "draw", fontsize=SMALL)
    return figure


def save_figure(
    path: str | os.PathLike[str], figure: Figure, *, overwrite: bool = False, exact: bool = False
) -> None:
    """Write a figure (format by the name), without empty margins, or of its `exact` size; whole or not at all."""
    with atomic_path(path, overwrite=overwrite) as temporary:
        if exact:
            figure.savefig(temporary, dpi=300)
        else:
            figure.savefig(temporary, dpi=200, bbox_inches="tight")

"""Figures against time: parameters of a survey, its χ² night by night, cameras that are watched by stars."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from walop_jax.fit.verdict import SUSPECT_SIGMA
from walop_jax.reports.posterior_figures import unit_in_words
from walop_jax.reports.style import AFTER, BEFORE, PAGE, QUIET, SMALL, Canvas, calendar, day_of, styled
from walop_jax.science.quality import ERRORS, GAIN, OUTSIDE, Limits
from walop_jax.science.star_words import Watch

MOST = 8  # parameters in a figure


def tracked(document: Mapping[str, Any]) -> list[str]:
    """Parameters of a survey that change: first those with breaks, then others that their law allows to change."""
    broken = [entry["name"] for entry in document["breaks"]]
    return [*dict.fromkeys([*broken, *document["laws"]])][:MOST]


@styled
def tracks_figure(tracks: Any, document: Mapping[str, Any], on: Canvas = PAGE) -> Figure:
    """The parameters that change (`tracked`, one at least), against time.

    The band is the value under the law with its error, dots the value of each night alone. A step is a step:
    grey across is the time in which it can have been; dashed lines are bad nights of that parameter, dotted ones the
    events that the user wrote down.
    """
    broken, names = document["breaks"], tracked(document)
    count = len(names)
    figure, axes = on.panels(6.4, 0.9 + 1.25 * count, count, 1, sharex=True)
    for axis, name in zip(axes[:, 0], names, strict=True):
        rows = tracks[np.asarray(tracks["NAME"]).astype(str) == name]
        mjd, value, error, alone, alone_error = (
            np.asarray(rows[key], float) for key in ("MJD", "VALUE", "ERROR", "DEVIATION", "DEVIATION_ERR")
        )
        breaks = [entry for entry in broken if entry["name"] == name and entry["kind"] != "drift"]
        steps = sorted(entry["date"] for entry in breaks if entry["kind"] == "step")
        time, segments = day_of(mjd), np.searchsorted(steps, mjd)
        for segment in range(len(steps) + 1):
            at = segments == segment
            low, high = (value - error)[at], (value + error)[at]
            axis.fill_between(time[at], low, high, color=AFTER, alpha=0.3, lw=0)
            axis.plot(time[at], value[at], color=AFTER, lw=1.2)
        look = {"ms": 2.5, "mfc": "white", "lw": 0.7, "color": "0.45", "zorder": 1.5}
        axis.errorbar(time, value + alone, alone_error, fmt="o", **look)
        for entry in breaks:
            if entry["kind"] == "step":
                axis.axvspan(*day_of([entry["before"], entry["after"]]), color=QUIET, lw=0, zorder=0)
            else:
                axis.axvline(float(day_of(_night_of(entry, rows))), color=BEFORE, lw=0.9, ls="--")
        _events(axis, document["events"])
        unit = unit_in_words(str(rows["UNIT"][0])) if len(rows) else ""
        axis.set_ylabel(f"{name}\n{f'({unit})' if unit else ''}".strip(), fontsize=SMALL)
    calendar(axes[-1, 0], tracks["MJD"])
    return figure


def _night_of(bad_night: Mapping[str, Any], rows: Any) -> float:
    """MJD of a bad night in the rows of a parameter; the middle of its time where these do not have its number."""
    numbers = np.asarray(rows["NIGHT"]) == bad_night["night"]
    if not numbers.any():
        return 0.5 * (bad_night["before"] + bad_night["after"])
    return float(np.asarray(rows["MJD"], float)[numbers][0])


@styled
def nights_figure(document: Mapping[str, Any], on: Canvas = PAGE) -> Figure:
    """Distance of χ² of every night from its expectation, in standard deviations."""
    nights: Sequence[Mapping[str, Any]] = document["by_night"]
    excess = np.array([night["excess"] for night in nights], float)
    mjd = np.array([night["mjd"] for night in nights], float)
    figure, axis = on.single(6.4, 2.0)
    axis.axhspan(-2.0, 2.0, color=QUIET, lw=0)
    axis.scatter(day_of(mjd), excess, s=6, color=np.where(excess > SUSPECT_SIGMA, BEFORE, AFTER).tolist())
    _events(axis, document["events"])
    axis.set_ylabel("(χ² − dof)/σ")
    calendar(axis, mjd)
    return figure


@styled
def watch_figure(watch: Watch) -> Figure:
    """Gain of every camera since the calibration (%) by group; band: smallest step seen in 99 %, lines: changes."""
    count = len(watch.cameras)
    figure, axes = PAGE.panels(6.0, 1.1 + 1.3 * count, count, 1, sharex=True, sharey=True)
    time, named = day_of(watch.time), {change.camera for change in watch.changes}
    percent = (100.0 * values.T for values in (watch.gain, watch.error, watch.smallest))
    for axis, camera, gain, error, detectable in zip(axes[:, 0], watch.cameras, *percent, strict=True):
        axis.fill_between(time, -detectable, detectable, color=QUIET, lw=0)
        colour = BEFORE if camera in named else AFTER
        axis.errorbar(time, gain, error, fmt="o", ms=3, lw=1, color=colour)
        for change in watch.changes:
            axis.axvline(float(day_of(change.time)), color=BEFORE, lw=0.8, ls="--")
        axis.set_ylabel(f"{camera} (%)")
    axes[0, 0].set_title("gain since the calibration; grey: steps too small to be detected")
    calendar(axes[-1, 0], watch.time, "number of the exposure group")
    return figure


PANELS: Mapping[str, tuple[tuple[str, ...], float, str]] = {
    "ANGLE": (("ANGLE",), 1.0, "angle (deg)"),
    "P_RATIO": (("P_RATIO",), 1.0, "p / catalogue"),
    "ZERO_Q": (("ZERO_Q", "ZERO_U"), 100.0, "zero of q, u (%)"),
    "CHI2DOF": (("CHI2DOF",), 1.0, "χ²/dof"),
    "ACCURACY": (("ACCURACY",), 100.0, "error of p (%)"),
}
"""Panels of the quality numbers: columns, factor, label."""
ASIDE = 0.012  # of the time shown: distance of the numbers of one night in a panel


@styled
def quality_figure(table: Any, limits: Limits) -> Figure:
    """Quality numbers night by night, of all cameras last; grey: their limits, red: outside."""
    gains = [name for name in table.colnames if name.startswith(f"{GAIN}_")]
    panels = {**PANELS, GAIN: (tuple(gains), 1.0, "gain of cameras")}
    figure, axes = PAGE.panels(6.4, 0.9 + 1.1 * len(panels), len(panels), 1, sharex=True)
    time = day_of(table["NIGHT"])
    known = time[np.isfinite(time)]
    aside = ASIDE * max(float(np.ptp(known)) if known.size else 0.0, 1.0)
    for axis, (limited, (names, factor, label)) in zip(axes[:, 0], panels.items(), strict=True):
        for number, (name, marker) in enumerate(zip(names, itertools.cycle("osD^v<>phx"), strict=False)):
            # Side by side: bars in one place would hide each other.
            at = time + aside * (number - 0.5 * (len(names) - 1))
            values = factor * np.ma.filled(np.ma.asarray(table[name], float), np.nan)
            error = factor * np.asarray(table[ERRORS[name]], float) if name in ERRORS else None
            outside = np.array([name in str(entry).split() for entry in table[OUTSIDE]])
            camera = name.removeprefix(f"{GAIN}_")
            axis.errorbar(at, values, error, fmt=marker, ms=3, lw=0.8, color=AFTER, label=camera)
            axis.plot(at[outside], values[outside], marker, ms=5, color=BEFORE, zorder=5)
        if limited in limits and limited != GAIN:
            low, high = (factor * value for value in limits[limited])
            axis.axhspan(low, high, color=QUIET, lw=0, zorder=0)
        axis.set_ylabel(label, fontsize=SMALL)
        if len(names) > 1:
            above = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
            axis.legend(ncol=len(names), frameon=False, **above)
    calendar(axes[-1, 0], table["NIGHT"])
    return figure


def _events(axis: Any, events: Sequence[Mapping[str, Any]]) -> None:
    for event in events:
        axis.axvline(float(day_of(event["mjd"])), color="0.4", lw=0.8, ls=":")
        axis.update_datalim([(float(day_of(event["mjd"])), 0.0)], updatey=False)

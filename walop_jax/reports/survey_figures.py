"""Figures against time: parameters of a survey, its χ² night by night, cameras that are watched by stars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from walop_jax.reports.style import (
    AFTER,
    BEFORE,
    FONT,
    PAGE,
    QUIET,
    SMALL,
    styled,
)
from walop_jax.science.watch_found import Watch

MOST = 8  # parameters in a figure
SHORTEST = 1.0  # d, of an axis of dates


@styled
def tracks_figure(tracks: Any, document: Mapping[str, Any]) -> Figure | None:
    """Parameters whose law lets them change, against time; None where there is none.

    The band is the value under the law with its error, dots what each night would have by itself; dashed lines are
    breaks of that parameter, dotted ones the events that the user wrote down.
    """
    found = document["breaks"]
    laws = [name for name in document["laws"] if name not in {one["name"] for one in found}]
    names = [*dict.fromkeys(one["name"] for one in found), *laws][:MOST]
    if not names:
        return None
    count = len(names)
    figure, axes = PAGE.panels(6.4, 0.9 + 1.25 * count, count, 1, sharex=True, squeeze=False)
    for axis, name in zip(axes[:, 0], names, strict=True):
        rows = tracks[np.asarray(tracks["NAME"]).astype(str) == name]
        mjd, value, error, alone, alone_error = (
            np.asarray(rows[key], float) for key in ("MJD", "VALUE", "ERROR", "DEVIATION", "DEVIATION_ERR")
        )
        axis.fill_between(mjd, value - error, value + error, color=QUIET, lw=0)
        axis.plot(mjd, value, color=AFTER, lw=1.0)
        axis.errorbar(mjd, value + alone, alone_error, fmt="o", ms=2, lw=0.6, color=AFTER, alpha=0.6)
        for one in found:
            if one["name"] == name and one["kind"] != "drift":
                axis.axvline(
                    one["after"] if one["kind"] == "step" else one["before"], color=BEFORE, lw=0.9, ls="--"
                )
        _events(axis, document["events"])
        unit = str(rows["UNIT"][0]) if len(rows) else ""
        axis.set_ylabel(f"{name}\n{f'({unit})' if unit else ''}".strip(), fontsize=SMALL)
    _dates(axes[-1, 0])
    return figure


@styled
def nights_figure(document: Mapping[str, Any]) -> Figure:
    """Distance of χ² of every night from its expectation, in standard deviations."""
    nights: Sequence[Mapping[str, Any]] = document["by_night"]
    excess = np.array([night["excess"] for night in nights], float)
    mjd = np.array([night["mjd"] for night in nights], float)
    figure, axis = PAGE.panels(6.4, 2.0)
    axis.axhspan(-2.0, 2.0, color=QUIET, lw=0)
    axis.scatter(mjd, excess, s=6, color=np.where(excess > 5.0, BEFORE, AFTER).tolist())
    _events(axis, document["events"])
    axis.set_ylabel("(χ² − dof)/σ", fontsize=FONT)
    _dates(axis)
    return figure


@styled
def watch_figure(found: Watch) -> Figure:
    """Gain of every camera (per cent, since the calibration, that camera alone) by exposure group.

    The band is the smallest step from there on that is found in 99 % of cases; lines are changes that were found.
    """
    count = len(found.cameras)
    figure, axes = PAGE.panels(6.0, 1.1 + 1.3 * count, count, 1, sharex=True, sharey=True, squeeze=False)
    named = {change.camera for change in found.changes}
    for k, axis in enumerate(axes[:, 0]):
        gain, error, seen = (100.0 * values[:, k] for values in (found.gain, found.error, found.smallest))
        axis.fill_between(found.time, -seen, seen, color=QUIET, lw=0, step=None)
        colour = BEFORE if found.cameras[k] in named else AFTER
        axis.errorbar(found.time, gain, error, fmt="o", ms=3, lw=1, color=colour)
        for change in found.changes:
            axis.axvline(change.time, color=BEFORE, lw=0.8, ls="--")
        axis.set_ylabel(f"{found.cameras[k]} (%)", fontsize=FONT)
    axes[0, 0].set_title("gain since the calibration; grey: steps that would not be seen", fontsize=FONT)
    _a_day_at_least(axes[-1, 0])
    axes[-1, 0].set_xlabel("MJD, or number of the exposure group", fontsize=FONT)
    return figure


def _dates(axis: Any) -> None:
    """MJD along X, written in full, over a day at least."""
    _a_day_at_least(axis)
    axis.set_xlabel("MJD", fontsize=FONT)
    axis.xaxis.set_major_locator(MaxNLocator(6))
    axis.xaxis.set_major_formatter(ScalarFormatter(useOffset=False))


def _a_day_at_least(axis: Any) -> None:
    """Limits of X: of a single date matplotlib would draw a tenth of all days since 1858."""
    low, high = axis.dataLim.intervalx
    margin = max(0.05 * (high - low), (SHORTEST - (high - low)) / 2.0)
    axis.set_xlim(low - margin, high + margin)


def _events(axis: Any, events: Sequence[Mapping[str, Any]]) -> None:
    for event in events:
        axis.axvline(event["mjd"], color="0.4", lw=0.8, ls=":")
        axis.update_datalim([(event["mjd"], 0.0)], updatey=False)

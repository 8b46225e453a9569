"""Figure of a calibration that is watched by its stars: every camera against time, and what would have been seen."""

from __future__ import annotations

from matplotlib.figure import Figure

from walop_jax.reports.style import AFTER, BEFORE, FONT, PAGE, QUIET
from walop_jax.science.watch_found import Watch


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
    axes[-1, 0].set_xlabel("MJD, or number of the exposure group", fontsize=FONT)
    return figure

"""What a calibration may be applied to: the filters and temperatures of the exposures that it was made from.

Dates are no bound: every science exposure lies outside those of the calibration. Whether it still holds at another
date is for calibration exposures of that date to say (`science.epoch`).
"""

from __future__ import annotations

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.settings import Settings
from walop_jax.io.errors import DataError, rows_text


def check_validity(calibration: Calibration, settings: Settings) -> None:
    """Raise `DataError`, with column and rows, for settings that the exposures of a calibration do not cover."""
    beyond = calibration.beyond_settings(settings)
    if not beyond.any():
        return
    seen = np.unique(calibration.exposures.filter)
    other = ~np.isin(settings.filter, seen)
    if other.any():
        column, rows = "FILTER", other
        what = (
            f"{', '.join(np.unique(settings.filter[other]))}; the calibration was made in {', '.join(seen)}"
        )
    else:
        column, rows = "TEMP", beyond
        low, high = np.nanmin(calibration.exposures.temp), np.nanmax(calibration.exposures.temp)
        what = f"the calibration was made between {low:.1f} and {high:.1f} Celsius"
    raise DataError(
        f"{column}: {rows_text(np.flatnonzero(rows))}: {what}; apply a calibration that covers them, or --force "
        "(force=True): FLAG 2048 marks these stars then"
    )

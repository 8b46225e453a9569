"""The instrument matrix of an instrument that is known, or assumed, to the last number."""

from __future__ import annotations

import numpy as np

from walop_jax.calibration.matrix import matrices
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import values_of


def matrix_at(
    instrument: Instrument, calset: CalibrationSet, x: np.ndarray | None = None, y: np.ndarray | None = None
) -> np.ndarray:
    """Its elements in the filter of the first exposure of a set, at the field points of that or at others (deg)."""
    x, y = calset.points.x if x is None else x, calset.points.y if y is None else y
    nothing = np.zeros((values_of(instrument).size,) * 2)
    setting = Settings.default(len(x), str(calset.exposures.filter[0]))
    return matrices(instrument, setting, calset.filters, x, y, nothing)[0]

"""The base model fitted to a set with known truth."""

from __future__ import annotations

from typing import NamedTuple

from south_sets import SouthSet

from walop_jax.calibration.calibration import Calibration
from walop_jax.data import read_calibration_set
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.refit import FitResult, refit


class SouthFit(NamedTuple):
    """A set, its fit and the calibration that comes of it."""

    calset: CalibrationSet
    result: FitResult
    calibration: Calibration

    @classmethod
    def of(cls, south: SouthSet) -> SouthFit:
        """Fit the base model, which is complete for the sets a and b."""
        calset = read_calibration_set(south.path)
        result = refit(calset)
        return cls(calset, result, Calibration.from_fit(result))

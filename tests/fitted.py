"""A calibration set, the base model fitted to it, and the calibration that comes of that."""

from __future__ import annotations

from typing import NamedTuple

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.problem import Problem, base_model


class Fitted(NamedTuple):
    """The base model fitted to a set."""

    calset: CalibrationSet
    problem: Problem
    result: FitResult
    calibration: Calibration

    @classmethod
    def to(cls, calset: CalibrationSet) -> Fitted:
        """Fit a set."""
        problem = Problem(calset, base_model(calset))
        result = fit(problem)
        return cls(calset, problem, result, Calibration.from_fit(result, problem))

"""Differentiable end-to-end calibration of the WALOP four-camera imaging polarimeters.

The public names are those of `__all__`; everything else lives in the rooms of the package and may move.
Nothing is loaded before it is used, so that importing the package is free of charge. It computes in float64,
which JAX must be told before anything else:

    import jax
    jax.config.update("jax_enable_x64", True)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.calibration.residual_map import residual_map
    from walop_jax.data.calset import read_calibration_set
    from walop_jax.data.settings import Settings
    from walop_jax.data.write import write_calibration_set
    from walop_jax.diagnosis.trust import refit
    from walop_jax.diagnosis.workflow import diagnose as find_effects
    from walop_jax.fit.misfit import describe as describe_misfit
    from walop_jax.fit.model_builder import base_model
    from walop_jax.fit.refit import FitResult
    from walop_jax.io.errors import DataError
    from walop_jax.likelihood.likelihood import Likelihood
    from walop_jax.model.build import nominal_instrument
    from walop_jax.model.effects import effect_by_name
    from walop_jax.model.instrument import Instrument
    from walop_jax.model.specification import with_effects
    from walop_jax.model.trace import Sightline, trace
    from walop_jax.science.apply import apply
    from walop_jax.simulation.observing_plan import ObservingPlan
    from walop_jax.simulation.simulate import simulate

__version__ = "0.1.0"

__all__ = [
    "Calibration",
    "DataError",
    "FitResult",
    "Instrument",
    "Likelihood",
    "ObservingPlan",
    "Settings",
    "Sightline",
    "apply",
    "base_model",
    "describe_misfit",
    "effect_by_name",
    "find_effects",
    "nominal_instrument",
    "read_calibration_set",
    "refit",
    "residual_map",
    "simulate",
    "trace",
    "with_effects",
    "write_calibration_set",
]

_HOME = {
    "Calibration": ("calibration.calibration", "Calibration"),
    "DataError": ("io.errors", "DataError"),
    "FitResult": ("fit.refit", "FitResult"),
    "Instrument": ("model.instrument", "Instrument"),
    "Likelihood": ("likelihood.likelihood", "Likelihood"),
    "ObservingPlan": ("simulation.observing_plan", "ObservingPlan"),
    "Sightline": ("model.trace", "Sightline"),
    "Settings": ("data.settings", "Settings"),
    "apply": ("science.apply", "apply"),
    "base_model": ("fit.model_builder", "base_model"),
    "describe_misfit": ("fit.misfit", "describe"),
    "effect_by_name": ("model.effects", "effect_by_name"),
    "find_effects": ("diagnosis.workflow", "diagnose"),
    "nominal_instrument": ("model.build", "nominal_instrument"),
    "read_calibration_set": ("data.calset", "read_calibration_set"),
    "refit": ("diagnosis.trust", "refit"),
    "residual_map": ("calibration.residual_map", "residual_map"),
    "simulate": ("simulation.simulate", "simulate"),
    "trace": ("model.trace", "trace"),
    "with_effects": ("model.specification", "with_effects"),
    "write_calibration_set": ("data.write", "write_calibration_set"),
}


def __getattr__(name: str) -> Any:
    """Load a public name from its room when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    room, attribute = _HOME[name]
    return getattr(importlib.import_module(f"{__name__}.{room}"), attribute)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

"""Differentiable end-to-end calibration of the WALOP four-camera imaging polarimeters.

Every command has a function of the same name: `read`, `refit`, `diagnose`, `sample`, `matrix`, `apply`, `compare`,
`certify`, `epoch`, `report`, `simulate`, `trace`; `from_arrays` makes a calibration set of arrays, `limits` says what
could hide in a fit. The public names are those of `__all__`; everything else lives in the rooms of the package and may
move.

Nothing is loaded before it is used, so that importing the package is free of charge. It computes in float64: the first
name that is asked for switches JAX to it, unless arrays have been made in float32 already. Then switch it on yourself,
before anything else:

    import jax
    jax.config.update("jax_enable_x64", True)
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.calibration.residual_map import residual_map
    from walop_jax.commands.certify import certify
    from walop_jax.commands.refit import refit
    from walop_jax.commands.simulate import simulate
    from walop_jax.data.from_arrays import from_arrays
    from walop_jax.data.settings import Settings
    from walop_jax.data.write import write_calibration_set
    from walop_jax.fit.misfit import describe as describe_misfit
    from walop_jax.fit.model_builder import base_model
    from walop_jax.fit.refit import FitResult
    from walop_jax.io.errors import DataError
    from walop_jax.likelihood.likelihood import Likelihood
    from walop_jax.model.build import nominal_instrument
    from walop_jax.model.effects import EFFECTS, Effect, effect_by_name
    from walop_jax.model.effects.base import Scalar
    from walop_jax.model.instrument import Instrument
    from walop_jax.model.parameters import param
    from walop_jax.model.specification import with_effects
    from walop_jax.model.trace import Sightline
    from walop_jax.posterior import Options
    from walop_jax.runs.from_python import (
        apply,
        compare,
        diagnose,
        epoch,
        limits,
        matrix,
        report,
        sample,
        trace,
    )
    from walop_jax.runs.reading import Run, read
    from walop_jax.simulation.observing_plan import ObservingPlan

__version__ = "0.1.0"

__all__ = [
    "EFFECTS",
    "Calibration",
    "DataError",
    "Effect",
    "FitResult",
    "Instrument",
    "Likelihood",
    "ObservingPlan",
    "Options",
    "Run",
    "Scalar",
    "Settings",
    "Sightline",
    "apply",
    "base_model",
    "certify",
    "compare",
    "describe_misfit",
    "diagnose",
    "effect_by_name",
    "epoch",
    "from_arrays",
    "limits",
    "matrix",
    "nominal_instrument",
    "param",
    "read",
    "refit",
    "report",
    "residual_map",
    "sample",
    "simulate",
    "trace",
    "with_effects",
    "write_calibration_set",
]

_HOME = {
    "Calibration": ("calibration.calibration", "Calibration"),
    "DataError": ("io.errors", "DataError"),
    "EFFECTS": ("model.effects", "EFFECTS"),
    "Effect": ("model.effects", "Effect"),
    "FitResult": ("fit.refit", "FitResult"),
    "Instrument": ("model.instrument", "Instrument"),
    "Likelihood": ("likelihood.likelihood", "Likelihood"),
    "ObservingPlan": ("simulation.observing_plan", "ObservingPlan"),
    "Options": ("posterior", "Options"),
    "Run": ("runs.reading", "Run"),
    "Scalar": ("model.effects.base", "Scalar"),
    "Settings": ("data.settings", "Settings"),
    "Sightline": ("model.trace", "Sightline"),
    "apply": ("runs.from_python", "apply"),
    "base_model": ("fit.model_builder", "base_model"),
    "certify": ("commands.certify", "certify"),
    "compare": ("runs.from_python", "compare"),
    "describe_misfit": ("fit.misfit", "describe"),
    "diagnose": ("runs.from_python", "diagnose"),
    "effect_by_name": ("model.effects", "effect_by_name"),
    "epoch": ("runs.from_python", "epoch"),
    "from_arrays": ("data.from_arrays", "from_arrays"),
    "limits": ("runs.from_python", "limits"),
    "matrix": ("runs.from_python", "matrix"),
    "nominal_instrument": ("model.build", "nominal_instrument"),
    "param": ("model.parameters", "param"),
    "read": ("runs.reading", "read"),
    "refit": ("commands.refit", "refit"),
    "report": ("runs.from_python", "report"),
    "residual_map": ("calibration.residual_map", "residual_map"),
    "sample": ("runs.from_python", "sample"),
    "simulate": ("commands.simulate", "simulate"),
    "trace": ("runs.from_python", "trace"),
    "with_effects": ("model.specification", "with_effects"),
    "write_calibration_set": ("data.write", "write_calibration_set"),
}


def __getattr__(name: str) -> Any:
    """Load a public name from its room when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    room, attribute = _HOME[name]
    found = getattr(importlib.import_module(f"{__name__}.{room}"), attribute)
    _switch_on_float64()
    return found


def _switch_on_float64() -> None:
    """Let JAX compute in float64 if nothing has been computed yet; otherwise leave it, and a computation will
    object."""
    fresh = "jax" not in sys.modules
    jax = importlib.import_module("jax")
    if not jax.config.jax_enable_x64 and (fresh or not jax.live_arrays()):
        jax.config.update("jax_enable_x64", True)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

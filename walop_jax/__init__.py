"""Differentiable end-to-end calibration of the WALOP four-camera imaging polarimeters.

Every command of `walop-jax` is a function of the same name with the same options; what it returns shows itself as a
short table. The public names, by what they are for:

Calibrate
    read                    calibration sets, a calibration, or the folder of a run
    from_arrays             a calibration set of arrays in memory
    write_calibration_set   a calibration set as a FITS file
    inspect                 contents and faults of calibration sets
    refit                   fit a set: a `FitResult` with values, covariance and verdict
    refit_many              the same for many sets of one layout, in one program
    diagnose                find what the model lacks, add it, and fit again
    sample                  draws from the posterior
    check                   is this calibration good for my stars, and if not, what to do
    matrix                  the instrument matrix with its errors at field points
    residual_map            what a smooth model leaves over the field
    compare                 the joint fit beside the polynomials of Paper II
    report, plot            the page of a run; one of its figures
    cite                    sources of the physics in a fit
    demo                    all of it with a small set that comes with the package

Plan
    plan                    the calibration exposures that make the error of p smallest
    simulate                a calibration set of an instrument as it may be built
    limits                  the size at which each effect would be detected and named
    exposures               the table EXPOSURES from the records of an observatory
    standards               standard stars with bands and errors
    ObservingPlan           a calibration run: where, when, through what

Stars and nights
    gather                  one catalogue from the catalogues of the cameras
    apply                   Stokes parameters of stars with their errors
    check_common_table      faults of a common table of stellar polarisation
    stack                   many nights, each parameter under a law of time

Models and JAX
    instrument, trace       an instrument as described; light followed through it
    base_model, model       the model of a plain fit; the same as a file
    with_effects            the model with effects of the catalogue or of your own
    with_noise              the model with errors of the data that are fitted
    forward                 counts, residuals and densities as functions for jit, grad and vmap
    effect_by_name, EFFECTS one effect; all effects that have a name

Extend
    Element, number         a class of optical elements; a number of such a class
    Effect, param           a class of effects; a parameter of such a class
    Scalar                  the type of a number in both

What functions take and return
    CalibrationSet, FilterCurve, Settings, Instrument, Model, Likelihood, Forward, FitResult, ManyFits, Calibration,
    Run, Options, DataError, docs (the pages)

The public names and their homes are those of `__init__.pyi`; everything else lives in the rooms of the package and may
move. Nothing is loaded before it is used, so that importing the package is free of charge. It computes in float64: the
first name that is asked for switches JAX to it. Where arrays have been made in float32 already, or float64 was
switched off later, the session stays as it is, and the package computes in float64 all the same.
"""

from __future__ import annotations

import functools
import importlib
import sys
import types
from typing import Any

__version__ = "0.1.0"


@functools.cache
def _homes() -> dict[str, tuple[str, str]]:
    """Module, and name in it, of every public name: the imports of `__init__.pyi`, which type checkers read as well.

    Names with an underscore are not public: methods of results in lower rooms call them.
    """
    import ast
    from importlib.resources import files

    stub = ast.parse((files(__name__) / "__init__.pyi").read_text(encoding="utf-8"))
    lines = [line for line in stub.body if isinstance(line, ast.ImportFrom)]
    return {str(name.asname): (str(line.module), name.name) for line in lines for name in line.names}


def __getattr__(name: str) -> Any:
    """Load a public name when it is first asked for; functions compute in float64."""
    if name == "__all__":
        return _public()
    if name.startswith("__") or name not in _homes():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _homes()[name]
    found = getattr(importlib.import_module(module), attribute)
    _switch_on_float64()
    if isinstance(found, types.FunctionType) and not hasattr(found, "command") and name != "forward":
        from walop_jax.model.compiled import (
            in_float64,
        )  # `forward`: the session itself compiles its functions

        found = in_float64(found, name)
    globals()[name] = found
    return found


def _switch_on_float64() -> None:
    """Let JAX compute in float64 if nothing has been computed yet; otherwise leave the session as it is."""
    fresh = "jax" not in sys.modules
    jax = importlib.import_module("jax")
    if not jax.config.jax_enable_x64 and (fresh or not jax.live_arrays()):
        jax.config.update("jax_enable_x64", True)


def _public() -> list[str]:
    return sorted(name for name in _homes() if not name.startswith("_"))


def __dir__() -> list[str]:
    return [*_public(), "__version__"]


class _Package(types.ModuleType):
    """The package: importing a room does not hide the public name that is spelled like it (`model`)."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (isinstance(value, types.ModuleType) and name == "model"):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package

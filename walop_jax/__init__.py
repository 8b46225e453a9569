"""Differentiable end-to-end calibration of the WALOP four-camera imaging polarimeters.

Every command is a function of the same name, with the same options: `refit`, `diagnose`, `sample`, `matrix`, `apply`
and so on. `read` reads whatever the program has written; `from_arrays` makes a calibration set of arrays. The public
names are those of `__init__.pyi`; everything else lives in the rooms of the package and may move.

Nothing is loaded before it is used, so that importing the package is free of charge. It computes in float64: the first
name that is asked for switches JAX to it. Where arrays have been made in float32 already, or float64 was switched off
later, the session stays as it is, and the package computes in float64 all the same.
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
    """Module and name there of every name: the imports of `__init__.pyi`, which type checkers read as well.

    Those with an underscore are no public names, but what methods of results in the rooms below come to.
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

"""Software and machine: classes in a file of the user, versions that results rest on, processor cores."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import platform
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from walop_jax.io.errors import PathLike, fail

T = TypeVar("T")
_OF_USERS = "walop_jax_own_"  # modules made of files of users


def classes_of(path: PathLike, base: type[T], advice: str) -> dict[str, type[T]]:
    """The subclasses of `base` that a Python file defines, by name, in the order of the file.

    The file is run. Raises `DataError`, with `advice` where there is no such file, and if it fails when it is run.
    """
    module = run_file(path, advice)
    return {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == module.__name__
    }


def run_file(path: PathLike, advice: str) -> ModuleType:
    """A Python file of a user, run as a module. Raises `DataError` as `classes_of` does."""
    path = Path(path)
    if not path.is_file():
        raise fail("there is no such file", file=path, advice=advice)
    module_name = f"{_OF_USERS}{path.stem}"
    specification = importlib.util.spec_from_file_location(module_name, path)
    if specification is None or specification.loader is None:
        raise fail("is no Python file", file=path, advice=advice)
    module = importlib.util.module_from_spec(specification)
    sys.modules[module_name] = module  # dataclasses look up their module
    try:
        specification.loader.exec_module(module)
    except Exception as error:
        raise fail(f"cannot be run: {type(error).__name__}: {error}", file=path) from error
    return module


def files_of_users() -> tuple[str, ...]:
    """Absolute paths of the Python files of users that were run; another process must run them before it unpickles."""
    modules = [
        getattr(module, "__file__", None)
        for name, module in sys.modules.items()
        if name.startswith(_OF_USERS)
    ]
    return tuple(sorted(str(Path(file).resolve()) for file in modules if file is not None))


def blank(kind: type[T]) -> T:
    """An object without its fields, for `__reduce__`.

    It switches float64 on before the arrays of the object are read, which would lose half of their digits otherwise:
    whoever unpickles a result may not have asked the package for anything yet.
    """
    importlib.import_module("walop_jax")._switch_on_float64()
    return object.__new__(kind)


def cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


SOFTWARE = ("walop-jax", "jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy", "scipy", "astropy")


def versions_of(names: Iterable[str]) -> dict[str, str]:
    """Versions of packages; "unknown" for those that are not installed."""
    return {name: _version(name) for name in names}


def software_versions() -> dict[str, str]:
    """Versions of Python, of this package and of what its results rest on."""
    return {"python": platform.python_version()} | versions_of(SOFTWARE)


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"

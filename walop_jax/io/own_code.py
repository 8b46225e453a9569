"""Code that users bring along as a file: run it, and find the classes in it."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import TypeVar

from walop_jax.io.errors import fail

T = TypeVar("T")


def classes_of(path: str | os.PathLike[str], base: type[T], advice: str) -> dict[str, type[T]]:
    """The subclasses of `base` that a Python file defines, by name, in the order of the file.

    The file is run. Raises `DataError`, with `advice` where there is no such file, and if it fails when it is run.
    """
    path = Path(path)
    if not path.is_file():
        raise fail("there is no such file", file=path, advice=advice)
    module_name = f"walop_jax_own_{path.stem}"
    specification = importlib.util.spec_from_file_location(module_name, path)
    if specification is None or specification.loader is None:
        raise fail("is no Python file", file=path, advice=advice)
    module = importlib.util.module_from_spec(specification)
    sys.modules[module_name] = module  # dataclasses look up their module
    try:
        specification.loader.exec_module(module)
    except Exception as error:
        raise fail(f"cannot be run: {type(error).__name__}: {error}", file=path) from error
    return {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == module_name
    }

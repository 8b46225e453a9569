"""Versions of the software that results rest on."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Iterable

SOFTWARE = ("walop-jax", "jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy", "astropy")


def versions_of(names: Iterable[str]) -> dict[str, str]:
    """Versions of packages; "unknown" for what is not installed."""
    return {name: _version(name) for name in names}


def software_versions() -> dict[str, str]:
    """Versions of Python, of this package and of what its results rest on."""
    return {"python": platform.python_version()} | versions_of(SOFTWARE)


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"

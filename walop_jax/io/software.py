"""Versions of the software that results rest on."""

from __future__ import annotations

import importlib.metadata
import platform

SOFTWARE = ("walop-jax", "jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy", "astropy")


def software_versions() -> dict[str, str]:
    """Versions of Python, of this package and of what its results rest on; "unknown" for what is not installed."""
    versions = {"python": platform.python_version()}
    for name in SOFTWARE:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "unknown"
    return versions

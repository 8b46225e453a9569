"""Sources of light, one class for each KIND of exposures; `SOURCES` lists those that every instrument can look at."""

from walop_jax.model.sources.base import ExposureArrays, Sight, Source, turned
from walop_jax.model.sources.moon_sky import MoonSky, Patches
from walop_jax.model.sources.standards import Standards
from walop_jax.model.sources.unpolarised import KnownFlux, Lamp, ThroughPolariser

SOURCES: tuple[type[Source], ...] = (MoonSky, Standards, ThroughPolariser, Lamp, KnownFlux)

__all__ = [
    "SOURCES",
    "ExposureArrays",
    "KnownFlux",
    "Lamp",
    "MoonSky",
    "Patches",
    "Sight",
    "Source",
    "Standards",
    "ThroughPolariser",
    "turned",
]

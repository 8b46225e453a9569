"""Sources without polarisation of their own: whatever shines through the polariser, lamps, light of known flux."""

from __future__ import annotations

from typing import ClassVar

from walop_jax.model.sources.base import Source


class ThroughPolariser(Source):
    """Any source through the calibration polariser."""

    name: ClassVar[str] = "clp"
    kind: ClassVar[str] = "clp"


class Lamp(Source):
    """Light of unknown flux and polarisation near zero that enters behind the telescope."""

    name: ClassVar[str] = "lamp"
    kind: ClassVar[str] = "lamp"
    from_sky: ClassVar[bool] = False


class KnownFlux(Source):
    """Unpolarised light of unit flux that enters behind the telescope, e.g. from an optical design program."""

    name: ClassVar[str] = "flux"
    kind: ClassVar[str] = "flux"
    flux_known: ClassVar[bool] = True
    from_sky: ClassVar[bool] = False

"""Kinds of exposures, and the columns of moving elements that every calibration set may have."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple


class ExposureKind(NamedTuple):
    """What all exposures of one KIND have in common.

    `flux_known`: the flux is one. `flux_shared`: an unknown flux is the same in all exposures of a filter. `from_sky`:
    the light comes through the telescope. `seconds` is the usual exposure time, None for a KIND that no plan observes.
    The KIND `moon`, for instance, has an unknown flux and comes from the sky.
    """

    flux_known: bool = False
    flux_shared: bool = False
    from_sky: bool = True
    seconds: float | None = None


KINDS: Mapping[str, ExposureKind] = {
    "clp": ExposureKind(seconds=30.0),
    "lamp": ExposureKind(from_sky=False, seconds=30.0),
    "moon": ExposureKind(seconds=60.0),
    "standard": ExposureKind(seconds=60.0),
    "flux": ExposureKind(flux_known=True, from_sky=False),
    "steady": ExposureKind(flux_shared=True, from_sky=False),
}
"""Kinds of exposures: through the polariser, lamp, full-Moon sky, standard star, known throughput, lamp of one flux."""

POLARISER, CALIBRATION_PLATE = "CLP", "CHWP"
"""Column prefixes of the moving elements that every calibration set may have."""

PREFIX = re.compile(r"[A-Z][A-Z0-9_]*")
"""Form of the column prefix of a moving element."""

WAVELENGTHS = (0.2, 20.0)
"""Light of a camera (µm), from the ultraviolet to the thermal infrared."""

EPHEMERIS_MJD = (15020.0, 88069.0)
"""Range of astropy's built-in ephemeris (ERFA `moon98`, the years 1900 to 2100)."""

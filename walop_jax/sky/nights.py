"""The night of an exposure: one definition for all that asks.

A night lasts from noon to noon of the mean Sun at the site, and has the MJD of its evening:

    night = ⌊MJD + λ/360° − ½⌋        λ the longitude, east positive

Where the longitude is not known, `GAP` hours without an exposure part two nights; such a night has the MJD of its first
exposure.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

GAP = 8.0
FIRST_DATE = 30000.0
"""MJD (1941) up to which times are no dates but numbers of exposures or of groups."""


def night_of(mjd: Float[np.ndarray, " e"], longitude: float) -> Float[np.ndarray, " e"]:
    """The night of every exposure (`mjd` UTC, days), NaN where the time is not known; NaN is an unknown longitude."""
    if np.isfinite(longitude):
        return np.floor(mjd + longitude / 360.0 - 0.5)
    night, dated = np.full(len(mjd), np.nan), np.flatnonzero(np.isfinite(mjd))
    order = dated[np.argsort(mjd[dated], kind="stable")]
    first = first_of_nights(mjd[order])
    night[order] = np.repeat(np.floor(mjd[order][first]), np.diff(np.append(first, len(order))))
    return night


def first_of_nights(mjd: Float[np.ndarray, " e"]) -> Int[np.ndarray, " n"]:
    """The first exposures of nights among times in their order (days), by the gaps between them."""
    return np.flatnonzero(np.diff(mjd, prepend=-np.inf) > GAP / 24.0)

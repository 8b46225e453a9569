"""The night of an exposure, defined once for the whole package.

    night = ⌊MJD + λ/360° − ½⌋        λ the longitude, east positive, −180° to 180°

A night lasts from noon to noon of the mean Sun at the site, and has the MJD of its evening. Where the longitude is not
known, noon is the middle of the longest part of the day without an exposure. Exposures of the same night in another
file may then make another noon; with the longitude they cannot.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

GAP = 8.0
"""Hours without an exposure between two nights, for changes that begin anew with each."""
FIRST_DATE = 30000.0
"""MJD (1941) up to which times are no dates but numbers of exposures or of groups."""


def night_of(mjd: Float[np.ndarray, " e"], longitude: float) -> Float[np.ndarray, " e"]:
    """The night of every exposure (`mjd` UTC, days), NaN where the time is not known; NaN is an unknown longitude."""
    if np.isfinite(longitude):
        return np.floor(mjd + ((longitude + 180.0) % 360.0 - 180.0) / 360.0 - 0.5)
    night, dated = np.full(len(mjd), np.nan), np.flatnonzero(np.isfinite(mjd))
    if not len(dated):
        return night
    of_day = np.unique(mjd[dated] % 1.0)
    gaps = np.diff(of_day, append=of_day[:1] + 1.0)
    longest = int(np.argmax(gaps))
    night[dated] = np.floor(mjd[dated] - (of_day[longest] + 0.5 * gaps[longest]) % 1.0)
    return night


def first_of_nights(mjd: Float[np.ndarray, " e"]) -> Int[np.ndarray, " n"]:
    """The first exposures of nights among times in their order (days), by the gaps between them."""
    return np.flatnonzero(np.diff(mjd, prepend=-np.inf) > GAP / 24.0)

"""What a file says of place and time, held against what is known otherwise: doubts that a reader remarks on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from walop_jax.data.records import Exposures, Site
from walop_jax.data.schema import Place
from walop_jax.instruments.description import described, shipped
from walop_jax.io.errors import rows_text

_NEAR = 0.05  # degrees between two statements of one site
_LEVEL = 100.0  # metres
_OLDEST = 48000.0  # MJD: 1990, before which no such camera was read out
_CAMPAIGN = 400.0  # days


def doubts_about(instrument: str, site: Site, exposures: Exposures, place: Place) -> Iterator[str]:
    """Sentences on a site that is not that of a shipped instrument, and on dates that cannot be those of one campaign.

    None of it forbids a fit: an instrument may have been moved, and MJD matters to few of its exposures.
    """
    if instrument in shipped():
        yield from _about_site(instrument, site, place)
    yield from _about_dates(exposures, place)


def _about_site(instrument: str, site: Site, place: Place) -> Iterator[str]:
    _, latitude, longitude, elevation, _ = described(instrument).place
    for card, value, known, near, unit in (
        ("SITELAT", site.latitude, latitude, _NEAR, "°"),
        ("SITELONG", site.longitude, longitude, _NEAR, "°"),
        ("SITEELEV", site.elevation, elevation, _LEVEL, " m"),
    ):
        away = abs(value - known)
        if card == "SITELONG":
            away = abs((away + 180.0) % 360.0 - 180.0)
        if np.isfinite(away) and away > near:
            yield (
                f"{place.file} [PRIMARY] {card}: is {value:g}{unit}, {instrument} stands at {known:g}{unit}; "
                "correct the card if the instrument has not been moved"
            )


def _about_dates(exposures: Exposures, place: Place) -> Iterator[str]:
    where = f"{place.file} [EXPOSURES] MJD"
    given = np.flatnonzero(np.isfinite(exposures.mjd))
    if not len(given):
        return
    mjd = exposures.mjd[given]
    if np.any(old := mjd < _OLDEST):
        yield f"{where}: is before 1990 in {rows_text(given[old])}; write NaN where the time is not known"
    middle = np.median(mjd)
    if np.any(far := np.abs(mjd - middle) > _CAMPAIGN):
        yield (
            f"{where}: is more than {_CAMPAIGN:g} days from the median, {middle:.1f}, in {rows_text(given[far])}; "
            "correct it, or calibrate the epochs one by one"
        )

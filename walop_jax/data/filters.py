"""Filter curves that a calibration set may name without bringing them along."""

from __future__ import annotations

import numpy as np

from walop_jax.data.records import FilterCurve
from walop_jax.io.errors import fail, nearest

DEFAULT_FILTER = "SDSS-r"
"""What an exposure without a FILTER was taken through."""

_SPECLITE = {"SDSS-r": "sdss2010-r"}
"""Our names and speclite's. The WALOP filters are custom: the survey's curve is where one starts."""

BUILTIN_FILTERS = tuple(_SPECLITE)
"""Names that `builtin_filter` knows."""


def builtin_filter(name: str) -> FilterCurve:
    """Return a built-in filter curve by name; wavelength in µm.

    `SDSS-r` is the r curve of the SDSS camera as measured by Doi et al. 2010, AJ 139, 1628, Table 4, for an
    airmass of 1.3, as tabulated by speclite (`sdss2010-r`). The curve counts photons: it is the share
    of the photons at each wavelength that is detected.

    Raises `DataError` with the nearest names if there is no such filter.
    """
    if name not in _SPECLITE:
        raise fail(
            f"no built-in filter is called {name!r}",
            advice=nearest(name, BUILTIN_FILTERS) + " Otherwise add it to the FILTERS table",
        )
    # Imported here because it reads its tables and much of astropy, which few callers need.
    import speclite.filters

    response = speclite.filters.load_filter(_SPECLITE[name])
    return FilterCurve(
        name=name,
        wavelength=np.asarray(response.wavelength, dtype=np.float64) * 1e-4,
        throughput=np.asarray(response.response, dtype=np.float64),
    )

"""Filter curves that a calibration set may name without bringing them along."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from walop_jax.data.records import FilterCurve
from walop_jax.io.errors import fail, nearest

DEFAULT_FILTER = "SDSS-r"
"""What an exposure without a FILTER was taken through."""

_TABLES = {"SDSS-r": "sdss_r.csv"}
"""Files beside this one. The WALOP filters are custom: the survey's curve is where one starts."""

BUILTIN_FILTERS = tuple(_TABLES)
"""Names that `builtin_filter` knows, single wavelengths (`single_wavelength`) apart."""

_SINGLE = re.compile(r"MONO-(\d{3,6}(?:\.\d+)?)")


def single_wavelength(name: str) -> float | None:
    """Wavelength (µm) of light called MONO-<Ångström>, as `import-zemax` names it; None: another name."""
    found = _SINGLE.fullmatch(name)
    return None if found is None else 1e-4 * float(found[1])


def builtin_filter(name: str) -> FilterCurve:
    """Return a built-in filter curve by name; wavelength in µm.

    `SDSS-r` is the r curve of the SDSS camera as measured by Doi et al. 2010, AJ 139, 1628, Table 4, for an
    airmass of 1.3. The curve counts photons: it is the share of the photons at each wavelength that is detected.

    `MONO-6500` is light of 6500 Å alone, and so on. Raises `DataError` with the nearest names if there is no such
    filter.
    """
    wavelength = single_wavelength(name)
    if wavelength is not None:
        return FilterCurve(name=name, wavelength=np.array([wavelength]), throughput=np.ones(1))
    if name not in _TABLES:
        raise fail(
            f"no built-in filter is called {name!r}",
            advice=nearest(name, BUILTIN_FILTERS) + " Otherwise add it to the FILTERS table",
        )
    table = Path(__file__).with_name(_TABLES[name])
    wavelength, throughput = np.loadtxt(table, delimiter=",", unpack=True, encoding="utf-8")
    return FilterCurve(name=name, wavelength=wavelength * 1e-4, throughput=throughput.copy())

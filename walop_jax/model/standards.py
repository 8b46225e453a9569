"""The standards of a set in the model: names of their values, and their colours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from walop_jax.data.records import Exposures, FilterCurve, Sources
from walop_jax.data.settings import PHOTOMETRIC_BANDS, builtin_filter
from walop_jax.model.quadrature import moments
from walop_jax.model.sources import Standards

LEAST_RANGE = 0.01  # µm
WIDTHS_PER_RMS = 2.355  # full width at half maximum of a Gaussian
Curves = Mapping[str, FilterCurve]


def standard_names(sources: Sources) -> tuple[str, ...]:
    """Unique names of the values of standards, usable in parameter names: the star, with the band if it is known."""
    plain = [
        _usable(str(name)) or f"source{number}"
        for number, name in zip(sources.source, sources.name, strict=True)
    ]
    names: dict[int, str] = {}
    for number, name in zip(sources.source.tolist(), plain, strict=True):
        # The name of another star is not given to a namesake.
        unique = name
        while number not in names and (unique in names.values() or (unique != name and unique in plain)):
            unique = f"{unique}_{number}"
        names.setdefault(number, unique)
    bands = [f".{_usable(str(band), '-+')}" if band else "" for band in sources.filter]
    return tuple(names[number] + band for number, band in zip(sources.source.tolist(), bands, strict=True))


def _usable(name: str, further: str = "") -> str:
    return "".join(c if c.isalnum() or c in further else "_" for c in name.strip())


def standards_of(sources: Sources, exposures: Exposures, filters: Curves) -> Standards:
    """The standards of a set, with their catalogue values.

    They have a colour where a band is stated for any of them, or where they were observed in several filters; otherwise
    a value belongs to the only filter.
    """
    names, qu = standard_names(sources), np.stack([sources.q, sources.u])
    filter_names = _filters_seen(exposures)
    stated = sources.filter != ""
    if not (stated.any() or len(filter_names) > 1):
        return Standards(names=names, q=qu[0], u=qu[1])
    bands = []
    for teff, band in zip(sources.teff.tolist(), sources.filter.tolist(), strict=True):
        band_moments = [_band(name, teff, filters) for name in ([band] if band else filter_names)]
        wavelength, width = np.mean(band_moments, axis=0) if band_moments else _band("V", teff, filters)
        bands.append((float(wavelength), float(width)))
    unknown = np.flatnonzero(~stated).tolist() if len(filter_names) > 1 else ()
    return Standards.coloured(names, qu, bands, sources.stars.tolist(), unknown)


def _filters_seen(exposures: Exposures) -> list[str]:
    return np.unique(exposures.filter[exposures.direct("standard")]).tolist()


def half_range(sources: Sources, row: int, exposures: Exposures, filters: Curves) -> float:
    """Half of the range of the mean wavelengths of the observations of a star (µm)."""
    means = [_band(name, float(sources.teff[row]), filters)[0] for name in _filters_seen(exposures)]
    return 0.5 * max(max(means) - min(means), LEAST_RANGE)


def _band(name: str, teff: float, filters: Curves) -> tuple[float, float]:
    """Mean wavelength and rms width (µm) of a band; of a photometric one those of any light."""
    if name in PHOTOMETRIC_BANDS and name not in filters:
        wavelength, width = PHOTOMETRIC_BANDS[name]
        return wavelength, width / WIDTHS_PER_RMS
    curve = filters[name] if name in filters else builtin_filter(name)
    return moments(curve.wavelength, curve.throughput, teff)

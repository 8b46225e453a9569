"""The primary header of a calibration product, and the cards that say where moving elements stand."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.calibration.records import CalibrationProduct, in_ascii
from walop_jax.data.checks import instrument_name, oldest_version
from walop_jax.data.records import PREFIX
from walop_jax.data.schema import Place

PRODVERS = 2
"""Newest version of the format; a product is written in the oldest version that can hold it."""

_LONGEST_SOFTWARE_LIST = 30


def product_version(product: CalibrationProduct) -> int:
    """The oldest version of the format that can hold a product."""
    newer = (
        product.maps.arms != 2
        or product.maps.positions
        or (product.residuals is not None and product.residuals.positions)
    )
    return 2 if newer else oldest_version(product.instrument, product.exposures, 4)


def position_cards(positions: Mapping[str, float]) -> dict[str, str | float]:
    """Header cards of moving elements: column prefix and angle (deg) of those that are in the beam."""
    cards: dict[str, str | float] = {}
    inside = [entry for entry in positions.items() if np.isfinite(entry[1])]
    for number, (prefix, angle) in enumerate(inside, start=1):
        cards |= {f"ELEM{number}": prefix, f"ANGLE{number}": angle}
    return cards


def read_positions(header: Any, place: Place) -> dict[str, float]:
    """The moving elements of `position_cards`; `DataError` for what is none."""
    positions: dict[str, float] = {}
    while (name := f"ELEM{len(positions) + 1}") in header:
        prefix, angle = header[name], header.get(f"ANGLE{len(positions) + 1}")
        known = isinstance(prefix, str) and PREFIX.fullmatch(prefix) and prefix not in positions
        if not known or isinstance(angle, bool) or not isinstance(angle, int | float):
            raise place.fail(f"is {prefix!r} at {angle!r}", name, "make the product again")
        positions[prefix] = float(angle)
    return positions


def primary_hdu(product: CalibrationProduct, version: int) -> fits.PrimaryHDU:
    """The primary header of a product of a version of the format: verdict, validity, software, content hash."""
    verdict, site = product.verdict, product.site
    primary = fits.PrimaryHDU()
    cards: dict[str, tuple[Any, str]] = {
        "TELESCOP": (site.telescope, ""),
        "INSTRUME": (product.instrument, ""),
        "PRODVERS": (version, "version of the calibration product format"),
        "ORIGIN": (product.origin, ""),
        "CREATOR": ("walop-jax", ""),
        "DATE": (product.date, "UTC, when the product was made"),
        "SITELAT": (site.latitude, "[deg] latitude"),
        "SITELONG": (site.longitude, "[deg] longitude, east positive"),
        "SITEELEV": (site.elevation, "[m] elevation"),
        "TRUSTED": (verdict.trusted, "converged and explains the data"),
        "CONVERGD": (verdict.converged, "the minimum was reached"),
        "CHI2": (verdict.chi2, "chi squared of data and priors"),
        "DOF": (verdict.dof, "degrees of freedom"),
        "NDATA": (verdict.n_data, "intensities used"),
        "NOISESCL": (verdict.noise_scale, "factor on the errors of the data"),
        "QUALITY": (int(verdict.quality), "bit mask, 0 is good"),
        "COVFROM": (verdict.covariance_from, "what COVARIANCE is of"),
        "ERRFROM": (verdict.errors_from, ""),
        **(
            {
                "STRUCTG": (verdict.structure.gain, "rms gain of a camera at a field point"),
                "STRUCTR": (verdict.structure.response, "rms response of a camera to q, u there"),
            }
            if verdict.structure
            else {}
        ),
        "MAPFILT": (product.maps.filter, f"filter of the maps M21...{product.maps.names[-1]}"),
        **{
            f"FIELD{side}": (value, "[deg] extent of the field points used")
            for side, value in zip(("XMI", "XMA", "YMI", "YMA"), product.field, strict=True)
        },
        **_validity(product),
        "CONTHASH": (product.content_hash(), ""),
    }
    for name, (value, comment) in cards.items():
        if isinstance(value, float) and not np.isfinite(value):
            continue  # FITS headers know no NaN; a missing card is read as one
        primary.header[name] = (in_ascii(value) if isinstance(value, str) else value, comment)
    primary.header["INSTRUME"] = product.instrument  # blanks inside a name count
    for number, (name, release) in enumerate(product.versions.items(), start=1):
        primary.header[f"SOFT{number}"] = in_ascii(f"{name} {release}")
    return primary


def _validity(product: CalibrationProduct) -> dict[str, tuple[Any, str]]:
    """What the product may be applied to, for a look: EXPOSURES says the same."""
    cards: dict[str, tuple[Any, str]] = {}
    for values, names, comment in (
        (product.exposures.mjd, ("MJD-BEG", "MJD-END"), "[d] UTC of the exposures"),
        (product.exposures.temp, ("TEMPMIN", "TEMPMAX"), "[Celsius] of the exposures"),
    ):
        known = values[np.isfinite(values)]
        if known.size:
            cards |= {names[0]: (float(known.min()), comment), names[1]: (float(known.max()), comment)}
    for number, name in enumerate(np.unique(product.exposures.filter).tolist(), start=1):
        cards[f"FILTER{number}"] = (name, "")
    return cards


@dataclasses.dataclass(frozen=True)
class ProductHeader:
    """The primary header of a product, read with types; each method raises `DataError` for what is amiss."""

    header: Any
    place: Place

    def version(self) -> int:
        """PRODVERS."""
        version = self.header.get("PRODVERS")
        if version is None and "CALVERS" in self.header:
            raise self.place.fail(
                "this is a calibration set, not a calibration product",
                "PRODVERS",
                "run walop-jax refit on it",
            )
        if version is None:
            raise self.place.fail("is missing", "PRODVERS", "is this the calibration.fits of a fit?")
        if isinstance(version, bool) or not isinstance(version, int) or version < 1:
            raise self.place.fail(f"is {version!r}, not a version", "PRODVERS", "make the product again")
        if version > PRODVERS:
            raise self.place.fail(
                f"is {version}, this program reads up to {PRODVERS}",
                "PRODVERS",
                "use a newer walop-jax, or make the product again with this one",
            )
        return version

    def number(self, name: str, missing: float | None = None) -> float:
        """A number; `missing` where it is absent, if that may be."""
        value = self.header.get(name, missing)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.place.fail(f"is {value!r}, not a number", name, "make the product again")
        return float(value)

    def flag(self, name: str) -> bool:
        """T or F."""
        value = self.header.get(name)
        if not isinstance(value, bool):
            raise self.place.fail(f"is {value!r}, not T or F", name, "make the product again")
        return value

    def text(self, name: str) -> str:
        """A text without blanks around it, empty where it is absent."""
        return str(self.header.get(name, "")).strip()

    def instrument(self, version: int) -> str:
        """INSTRUME, as a calibration set of that version may have it."""
        return instrument_name(self.header.get("INSTRUME", ""), version, self.place)

    def versions(self) -> dict[str, str]:
        """Versions of the software by name."""
        found: dict[str, str] = {}
        for number in range(1, _LONGEST_SOFTWARE_LIST):
            name, _, version = self.text(f"SOFT{number}").partition(" ")
            if name:
                found[name] = version
        return found

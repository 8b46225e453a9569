"""Reference systems of directions as FITS headers state them (RADESYS, EQUINOX), made ICRS.

Equinox     Without RADESYS an EQUINOX before 1984 is FK4, a later one FK5; without both a direction is in ICRS.
            RADECSYS and EPOCH are read in their place (FITS standard 4.0, section 8.3.1).
Limits      GAPPT, the geocentric apparent place, needs the time: MJD, MJD-OBS or DATE-OBS. Proper motions are not
            touched: a frame of another equinox turns directions, it does not move stars.
Source      Calabretta & Greisen 2002, A&A 395, 1077, section 3.1; astropy does the transformations.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.data.units import Place, mjd_of

Degrees = Float[np.ndarray, "*n"]

SYSTEMS = ("ICRS", "FK5", "FK4", "FK4-NO-E", "GAPPT")
_ALSO = {"FK4-NO-E": "FK4-NO-E", "FK4NOE": "FK4-NO-E", "GCRS": "ICRS", "GAIA-CRF3": "ICRS", "J2000": "FK5"}
_FIRST_OF_FK5 = 1984.0
_YEARS = (1800.0, 2200.0)
_NOT_STATED = ("", "NONE", "UNKNOWN", "N/A", "UNDEFINED", "0", "0.0")
_WORDS = ("RADESYS", "RADECSYS"), ("EQUINOX", "EPOCH")


@dataclasses.dataclass(frozen=True)
class Frame:
    """A reference system by its name in FITS, with its equinox (year) or, of apparent places, the time (MJD)."""

    system: str = "ICRS"
    equinox: float = 2000.0
    mjd: float = math.nan

    @property
    def is_icrs(self) -> bool:
        """True where directions are in ICRS as they are: also of FK5 at J2000, which is within 0.03 arcsec of it."""
        return self.system == "ICRS" or (self.system == "FK5" and self.equinox == 2000.0)

    def __str__(self) -> str:
        if self.system == "GAPPT":
            return f"GAPPT (apparent places) of MJD {self.mjd:.6g}"
        return self.system if self.system == "ICRS" else f"{self.system}, equinox {self.equinox:g}"

    def _of_astropy(self) -> Any:
        from astropy import coordinates
        from astropy.time import Time

        if self.system == "GAPPT":
            return coordinates.TETE(obstime=Time(self.mjd, format="mjd", scale="utc"))
        kind = {"FK5": coordinates.FK5, "FK4": coordinates.FK4, "FK4-NO-E": coordinates.FK4NoETerms}
        scale = "jyear" if self.system == "FK5" else "byear"
        return kind[self.system](equinox=Time(self.equinox, format=scale))

    def to_icrs(self, ra: Any, dec: Any) -> tuple[Degrees, Degrees]:
        """Right ascensions and declinations (deg) of this system in ICRS; those that are not finite stay so."""
        ra, dec = (np.array(values, float) for values in np.broadcast_arrays(ra, dec))
        known = np.isfinite(ra) & np.isfinite(dec)
        if self.is_icrs or not known.any():
            return ra, dec
        from astropy.coordinates import SkyCoord
        from astropy.utils import iers

        with (
            iers.conf.set_temp("auto_download", False),
            iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
        ):
            stars: Any = SkyCoord(ra[known], dec[known], unit="deg", frame=self._of_astropy()).icrs
        ra[known], dec[known] = stars.ra.deg, stars.dec.deg
        return ra, dec


ICRS = Frame()


def frame_of(header: Mapping[str, Any], place: Place, mjd: float = math.nan) -> Frame:
    """The reference system that a header states; `mjd` is the time, where the header has none.

    Raises `DataError` for a system that is not known, an EQUINOX that is no year, and apparent places without a time.
    """
    words = {str(key).upper(): value for key, value in header.items() if isinstance(key, str)}
    if not {"CTYPE1", "RADESYS", "RADECSYS"} & set(words):
        words.pop("EPOCH", None)  # of a table: the time to which the places of its stars belong
    system, equinox = (
        next(((n, words[n]) for n in names if _stated(words.get(n))), None) for names in _WORDS
    )
    year = None if equinox is None else _year_of(*equinox, place)
    if system is None:
        return ICRS if year is None else Frame("FK5" if year >= _FIRST_OF_FK5 else "FK4", year)
    name = str(system[1]).strip().upper()
    name = _ALSO.get(name, name)
    if name not in SYSTEMS:
        advice = f"it is one of {', '.join(SYSTEMS)}; correct the word, or give directions in ICRS"
        raise place.fail(
            f"{str(system[1]).strip()!r} is no reference system that is known", system[0], advice
        )
    if name == "GAPPT":
        return Frame(name, mjd=_time_of(words, mjd, place, system[0]))
    return Frame(name, year if year is not None else 2000.0 if name in ("ICRS", "FK5") else 1950.0)


def made_icrs(
    header: Mapping[str, Any], ra: Any, dec: Any, mjd: Any, place: Place
) -> tuple[Degrees, Degrees, Frame]:
    """Directions (deg) of the system that a header states in ICRS, each at its MJD, and that system."""
    ra, dec, mjd = (np.array(values, float) for values in np.broadcast_arrays(ra, dec, mjd))
    frame = ICRS
    for time in np.unique(mjd):  # NaN once
        same = (mjd == time) | (np.isnan(mjd) & np.isnan(time))
        frame = frame_of(header, place, float(time))
        ra[same], dec[same] = frame.to_icrs(ra[same], dec[same])
    return ra, dec, frame


def frame_of_names(names: Sequence[str]) -> Frame | None:
    """The system that names of columns state (…_J2000, …_B1950); None: they say nothing."""
    ends = {name.upper().rpartition("_")[2] for name in names}
    return ICRS if ends == {"J2000"} else Frame("FK4", 1950.0) if ends == {"B1950"} else None


def plane_of(header: Mapping[str, Any]) -> Any:
    """The WCS of a header, without its reference system, of which `frame_of` tells."""
    from astropy.io import fits
    from astropy.wcs import WCS, FITSFixedWarning

    plain = fits.Header(header, copy=True) if isinstance(header, fits.Header) else fits.Header(dict(header))
    for word in itertools.chain(*_WORDS):
        plain.remove(word, ignore_missing=True, remove_all=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        return WCS(plain)


def sky_of_pixels(
    header: Mapping[str, Any], x: Any, y: Any, first_pixel: int, place: Place, mjd: float = math.nan
) -> tuple[Degrees, Degrees]:
    """ICRS right ascensions and declinations (deg) of pixels, by the WCS and the reference system of a header."""
    from astropy.coordinates import SkyCoord

    plane: Any = plane_of(header).celestial
    world = plane.all_pix2world(x, y, first_pixel)
    longitude, latitude = (np.asarray(world[axis], float) for axis in (plane.wcs.lng, plane.wcs.lat))
    native = str(plane.wcs.lngtyp).strip().upper()
    if native == "RA":
        ra, dec = frame_of(header, place, mjd).to_icrs(np.mod(longitude, 360.0), latitude)
        return np.mod(ra, 360.0), dec
    frames = {"GLON": "galactic", "ELON": "barycentricmeanecliptic"}
    if native not in frames:
        raise place.fail(f"has the axis {native}", "CTYPE", "a WCS in RA and DEC is needed")
    stars: Any = SkyCoord(longitude, latitude, unit="deg", frame=frames[native]).icrs
    return np.asarray(stars.ra.deg, float), np.asarray(stars.dec.deg, float)


def _stated(value: Any) -> bool:
    return value is not None and str(value).strip().upper() not in _NOT_STATED


def _year_of(word: str, value: Any, place: Place) -> float:
    text = str(value).strip().upper()
    match = re.fullmatch(r"[JB]?\s*(\d+(?:\.\d*)?)", text)
    year = float(match[1]) if match else math.nan
    if not _YEARS[0] < year < _YEARS[1]:
        advice = (
            "the year of the equinox of RA and DEC, such as 2000.0; remove the word where they are in ICRS"
        )
        raise place.fail(f"{value!r} is no year", word, advice)
    return year


def _time_of(words: Mapping[str, Any], mjd: float, place: Place, word: str) -> float:
    for name in ("MJD", "MJD-OBS", "MJD-AVG", "DATE-OBS"):
        value: Any = words.get(name)
        if not _stated(value):
            continue
        try:
            return mjd_of(str(value)) if name == "DATE-OBS" else float(value)
        except (ValueError, TypeError):
            raise place.fail(f"{value!r} is no time", name, "give MJD in days") from None
    if math.isnan(mjd):
        raise place.fail("apparent places (GAPPT) need the time", word, "give MJD, or directions in ICRS")
    return mjd

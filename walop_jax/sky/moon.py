"""The full-Moon sky.

Single Rayleigh scattering (Paper II of WALOP-South, section on the Moon sky):

    p = δ sin²γ / (1 + cos²γ),    electric vector perpendicular to the scattering plane,

with γ the angle between the line of sight k and the direction m of the Moon. The vector v = k × m is
perpendicular to the scattering plane and |v| = sin γ; with a and b its components along north and east,
tan(position angle) = b / a, so that

    Q = δ (a² − b²) / (1 + cos²γ),    U = δ 2ab / (1 + cos²γ),

which needs no angle and stays smooth at γ = 0. All functions here give δ = 1; δ is a parameter of the fit.

North and east at a field point are those of the field centre, carried there by the smallest rotation
(the meridian convergence is thereby taken out), in the words of the instrument frame:

    n(k) = n − (k·n) / (1 + k·c) · (k + c).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.data.kinds import EPHEMERIS_MJD
from walop_jax.data.records import Exposures, Site
from walop_jax.io.errors import fail
from walop_jax.sky.position_angles import sky_to_instrument

Values = Float[np.ndarray, " e"]
"""One of every exposure; angles in degrees, times in UTC days (MJD)."""


@dataclasses.dataclass(frozen=True, eq=False)
class SkyOfExposures:
    """The sky of a list of exposures seen from a site: moonlit in those of the full Moon, unpolarised in all others.

    The direction of the Moon is worked out when the first sky is asked for, and only if there are exposures of it. It
    is no column of the exposures: whoever replaces their times, or the site, would have to replace that column too.
    """

    exposures: Exposures
    site: Site

    @functools.cached_property
    def _moonlit(self) -> tuple[np.ndarray, Values, Values]:
        """Rows of the exposures of the full Moon, and the direction of the Moon then."""
        rows = np.flatnonzero(self.exposures.direct("moon"))
        return rows, *_moon_at(tuple(self.exposures.mjd[rows].tolist()), self.site)

    def polarisation(
        self, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p e 2"]:
        """q and u (instrument frame) at field points (deg), for δ = 1. Raises `DataError` as `moon_sky` does."""
        e, sky = self.exposures, np.zeros((len(x), len(self.exposures), 2))
        rows, ra, dec = self._moonlit
        if rows.size:
            pair = rayleigh_sky(ra, dec, e.ra[rows], e.dec[rows], e.rotator[rows], x, y)
            sky[:, rows] = np.stack(pair, axis=-1)
        return sky


@functools.lru_cache(maxsize=32)
def _moon_at(mjd: tuple[float, ...], site: Site) -> tuple[Values, Values]:
    """Direction of the Moon, kept: the same set is brought together with many models."""
    return body_direction("moon", np.array(mjd), site) if mjd else (np.zeros(0), np.zeros(0))


def moon_sky(
    mjd: Values,
    ra: Values,
    dec: Values,
    rotator: Values,
    site: Site,
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "p e"], Float[np.ndarray, "p e"]]:
    """Return q and u of the moonlit sky for δ = 1, in the instrument frame.

    `mjd` UTC days at mid-exposure; `ra`, `dec` the field centre and `rotator` the position angle of +X,
    degrees; `x`, `y` degrees in the instrument frame. Memory is about ten arrays of points × exposures.

    Raises `DataError` if an input is not finite or the site or time is unusable.
    """
    return rayleigh_sky(*body_direction("moon", mjd, site), ra, dec, rotator, x, y)


def body_direction(name: str, mjd: Values, site: Site) -> tuple[Values, Values]:
    """Return right ascension and declination (degrees, GCRS axes) of the Moon, or the Sun, as seen from the site.

    The Moon is 60 Earth radii away: its parallax of up to a degree makes the site matter. `mjd` in UTC days.
    Astropy's `get_body` with the built-in ephemeris; nothing is ever downloaded, so Earth rotation comes
    from the tables that are installed and may be a second off in the future (0.3 arcsec of parallax).

    Raises `DataError` for a time outside the ephemeris and for a site that is not finite.
    """
    mjd = np.asarray(mjd, dtype=np.float64)
    low, high = EPHEMERIS_MJD
    if not np.all((mjd >= low) & (mjd <= high)):
        raise fail(
            "times must be Modified Julian Dates in 1900 … 2100",
            column="MJD",
            advice="subtract 2400000.5 from a Julian Date",
        )
    if not site.known:
        raise fail(
            "the site is not known",
            column="SITELAT, SITELONG, SITEELEV",
            advice="add them to the header, or [site] to the description of the instrument; a plan without the Moon "
            "has moon_patches = 0",
        )
    with _offline():
        # Imported here: coordinates take half a second, and only Moon exposures need them.
        from astropy.coordinates import EarthLocation, get_body
        from astropy.time import Time

        place = EarthLocation.from_geodetic(site.longitude, site.latitude, site.elevation)
        body: Any = get_body(name, Time(mjd, format="mjd", scale="utc"), place, ephemeris="builtin")
        return np.asarray(body.ra.deg, dtype=np.float64), np.asarray(body.dec.deg, dtype=np.float64)


def altitude(mjd: Values, ra: Values, dec: Values, site: Site) -> Values:
    """Return the altitude (deg) of directions (deg) at UTC days, without refraction, to the precession since 2000.

    sin h = sin φ sin δ + cos φ cos δ cos H, H the hour angle (Meeus 1998, Astronomical Algorithms, equation 13.6).
    """
    hour = np.deg2rad(local_sidereal_time(mjd, site.longitude) - ra)
    latitude, dec = np.deg2rad(site.latitude), np.deg2rad(dec)
    sine = np.sin(latitude) * np.sin(dec) + np.cos(latitude) * np.cos(dec) * np.cos(hour)
    return np.rad2deg(np.arcsin(np.clip(sine, -1.0, 1.0)))


def offset_direction(
    ra: Values, dec: Values, position_angle: Values, separation: Values
) -> tuple[Values, Values]:
    """Return right ascension and declination of the points that far from others, north through east; all in degrees."""
    from astropy.coordinates import offset_by

    direction = offset_by(*(np.deg2rad(angle) for angle in (ra, dec, position_angle, separation)))
    return np.mod(direction[0].deg, 360.0), np.asarray(direction[1].deg)


def local_sidereal_time(mjd: Values, longitude: float) -> Values:
    """Return the local mean sidereal time (deg) at UTC days and a longitude (deg, east positive), to a few arcsec.

    Source: Meeus 1998, Astronomical Algorithms, equation 12.4, without its terms in T². UTC stands for UT1, so that the
    same plan gives the same exposures whatever tables of Earth rotation are installed. With the terms in T², as astropy
    has them, it is 0.2 arcsec off; sets that have been published would change.
    """
    return np.mod(280.46061837 + 360.98564736629 * (mjd - 51544.5) + longitude, 360.0)


@contextlib.contextmanager
def _offline() -> Iterator[None]:
    """Keep astropy from the network, and from warning that its Earth-rotation tables end."""
    from astropy.utils import iers

    with (
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
        iers.earth_orientation_table.set(_earth_orientation()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield


_ORIENTATION = {"MJD": "d", "PM_x": "arcsec", "PM_y": "arcsec", "UT1_UTC": "s"}
"""Columns of astropy's table of Earth rotation that a direction needs, and their units: those behind the date."""


@functools.cache
def _earth_orientation() -> Any:
    """The Earth-rotation table that is installed with astropy, its 24 000 lines read by numpy.

    `IERS_B.open` reads all 21 columns word by word, which took as long as a tenth of a fit.
    """
    from astropy import units
    from astropy.utils import iers

    columns = np.loadtxt(iers.IERS_B_FILE, usecols=range(4, 4 + len(_ORIENTATION)), unpack=True)
    named = zip(_ORIENTATION.items(), columns, strict=True)
    return iers.IERS_B({name: values * units.Unit(unit) for (name, unit), values in named})


def rayleigh_sky(
    moon_ra: Values,
    moon_dec: Values,
    ra: Values,
    dec: Values,
    rotator: Values,
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "p e"], Float[np.ndarray, "p e"]]:
    """Return q and u (δ = 1, instrument frame) of a sky lit from a given direction; all angles in degrees.

    Raises `DataError` if an input is not finite. Source: see the head of this file.
    """
    inputs = {"MOON": moon_ra, "MOON DEC": moon_dec, "RA": ra, "DEC": dec, "ROTATOR": rotator, "X": x, "Y": y}
    for name, values in inputs.items():
        if not np.all(np.isfinite(values)):
            raise fail("is not finite", column=name, advice="give only exposures of the moonlit sky")

    # Components of the Moon's direction along north, east and line of sight of the field centre.
    alpha, delta, delta_moon = np.deg2rad(np.asarray(moon_ra) - ra), np.deg2rad(dec), np.deg2rad(moon_dec)
    moon_n = np.cos(delta) * np.sin(delta_moon) - np.sin(delta) * np.cos(delta_moon) * np.cos(alpha)
    moon_e = np.cos(delta_moon) * np.sin(alpha)
    moon_c = np.sin(delta) * np.sin(delta_moon) + np.cos(delta) * np.cos(delta_moon) * np.cos(alpha)

    # A field point on the tangent plane, then on the unit sphere.
    cos_r, sin_r = np.cos(np.deg2rad(rotator)), np.sin(np.deg2rad(rotator))
    x, y = np.deg2rad(x)[:, None], np.deg2rad(y)[:, None]
    north, east = x * cos_r - y * sin_r, x * sin_r + y * cos_r
    k_c = 1.0 / np.sqrt(1.0 + north**2 + east**2)
    k_n, k_e = north * k_c, east * k_c

    # v = k × m in the axes (north, east, line of sight). This triad is left-handed, which turns the sign of
    # the whole vector; only its orientation, modulo 180°, matters.
    v_n = k_e * moon_c - k_c * moon_e
    v_e = k_c * moon_n - k_n * moon_c
    v_c = k_n * moon_e - k_e * moon_n
    # The carried axes are n − k_n / (1 + k_c) · (k + c), and v ⟂ k, so only the part along c is corrected.
    a = v_n - k_n / (1.0 + k_c) * v_c
    b = v_e - k_e / (1.0 + k_c) * v_c

    cos_gamma = k_n * moon_n + k_e * moon_e + k_c * moon_c
    weight = 1.0 / (1.0 + cos_gamma**2)
    return sky_to_instrument(weight * (a**2 - b**2), weight * (2.0 * a * b), rotator)

"""The Moon sky against geometry done by hand, by another method, and against data made elsewhere."""

from __future__ import annotations

import dataclasses
import socket

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time
from astropy.utils import iers
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from science.truth import TrueInstrument

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import Site
from walop_jax.io.errors import DataError
from walop_jax.sky.moon import (
    SkyOfExposures,
    body_direction,
    local_sidereal_time,
    moon_sky,
    offset_direction,
    rayleigh_sky,
)
from walop_jax.sky.position_angles import sky_to_instrument

CENTRE = (np.zeros(1), np.zeros(1))


def one(moon_ra, moon_dec, ra, dec, rotator=0.0, xy=CENTRE):
    q, u_ = rayleigh_sky(*(np.array([float(v)]) for v in (moon_ra, moon_dec, ra, dec, rotator)), *xy)
    return q[:, 0], u_[:, 0]


@pytest.mark.parametrize(
    ("moon", "field", "rotator", "stokes"),
    [
        # Moon at the pole, field on the equator: γ = 90°, p = 1, vector east-west, q = −1 for +X to the north
        ((0, 90), (100, 0), 0, (-1, 0)),
        ((0, 90), (100, 0), 90, (1, 0)),
        ((0, 90), (100, 0), 45, (0, 1)),
        ((0, -90), (250, 0), 0, (-1, 0)),
        # Moon due east of a field on the equator: the vector stands north-south
        ((130, 0), (40, 0), 0, (1, 0)),
        # Moon at position angle +45° (north-east), 90° away: vector at −45°, u = −1
        ((90, 45), (0, 0), 0, (0, -1)),
        # Moon at the pole, 60° and 30° away: p = sin²γ / (1 + cos²γ) = 0.6 and 1/7
        ((0, 90), (10, 30), 0, (-0.6, 0)),
        ((0, 90), (10, 60), 0, (-1 / 7, 0)),
        # looking at the Moon, and away from it
        ((33, 20), (33, 20), 12, (0, 0)),
        ((33, 20), (213, -20), 12, (0, 0)),
    ],
)
def test_by_hand(moon, field, rotator, stokes):
    q, u_ = one(*moon, *field, rotator)
    np.testing.assert_allclose([q[0], u_[0]], stokes, atol=1e-15)


def by_angles(moon, field, rotator, x, y):
    """The same from spherical trigonometry of astropy: separation and position angle at the field point."""
    r = np.deg2rad(rotator)
    north, east = x * np.cos(r) - y * np.sin(r), x * np.sin(r) + y * np.cos(r)
    centre = SkyCoord(field[0] * u.deg, field[1] * u.deg)
    moon = SkyCoord(moon[0] * u.deg, moon[1] * u.deg)
    # gnomonic: the angular distance from the tangent point is the arc tangent of the plane's
    distance = np.arctan(np.hypot(np.deg2rad(north), np.deg2rad(east)))
    towards = np.arctan2(east, north)
    point = centre.directional_offset_by(towards * u.rad, distance * u.rad)
    gamma = point.separation(moon).rad
    # what the meridians turn between centre and point, along the great circle that joins them
    turn = point.position_angle(centre).rad - np.pi - towards
    angle = point.position_angle(moon).rad + np.pi / 2 - turn - r
    p = np.sin(gamma) ** 2 / (1 + np.cos(gamma) ** 2)
    return p * np.cos(2 * angle), p * np.sin(2 * angle)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    *(st.floats(low, high) for low, high in [(0, 360), (-80, 80), (0, 360), (-80, 80), (0, 360)]),
    st.floats(-0.35, 0.35),
    st.floats(-0.35, 0.35),
)
def test_against_spherical_trigonometry(moon_ra, moon_dec, ra, dec, rotator, x, y):
    assume(np.hypot(x, y) > 1e-3)  # closer than that astropy has no position angle to compare with
    q, u_ = one(moon_ra, moon_dec, ra, dec, rotator, (np.array([x]), np.array([y])))
    expected = by_angles((moon_ra, moon_dec), (ra, dec), rotator, x, y)
    np.testing.assert_allclose([q[0], u_[0]], expected, atol=1e-9)


def test_convergence_is_taken_out():
    """Near the pole meridians turn by degrees across the field; angles must not."""
    x = np.array([0.0, 0.0, 0.0])
    y = np.array([-0.3, 0.0, 0.3])
    q, u_ = one(0, 0, 180, 89.0, 0.0, (x, y))  # Moon near due south on the other side of the pole: PA ~ 0
    angle = np.rad2deg(0.5 * np.arctan2(u_, q))
    assert np.ptp(np.unwrap(angle, period=180)) < 0.02


def test_it_is_smooth_around_the_moon():
    """Around the Moon the pattern is tangential: q ≈ −γ² cos 2φ / 2, without a division by zero at γ = 0."""
    phi = np.deg2rad(np.arange(0, 360, 30.0))
    gamma = 0.3
    q, u_ = one(50, 0, 50, 0, 0.0, (gamma * np.cos(phi), gamma * np.sin(phi)))
    p = np.deg2rad(gamma) ** 2 / 2
    np.testing.assert_allclose(q, -p * np.cos(2 * phi), atol=1e-4 * p)
    np.testing.assert_allclose(u_, -p * np.sin(2 * phi), atol=1e-4 * p)
    assert one(50, 0, 50, 0)[0][0] == 0.0


def test_slabs_are_the_whole():
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-0.3, 0.3, (2, 50))
    setting = [rng.uniform(0, 80, 6) for _ in range(5)]
    q, u_ = rayleigh_sky(*setting, x, y)
    assert q.shape == (50, 6)
    parts = [rayleigh_sky(*setting, x[n : n + 7], y[n : n + 7]) for n in range(0, 50, 7)]
    np.testing.assert_array_equal(np.concatenate([part[0] for part in parts]), q)
    np.testing.assert_array_equal(np.concatenate([part[1] for part in parts]), u_)


def test_turn_to_the_instrument():
    # a vector at position angle 30° in an instrument whose +X lies at 30° is along +X
    q, u_ = sky_to_instrument(*(np.array([f(np.pi / 3)]) for f in (np.cos, np.sin)), np.array([30.0]))
    np.testing.assert_allclose([q[0], u_[0]], [1, 0], atol=1e-15)


SITE = Site("SAAO 1-m", -32.3795, 20.8107, 1798.0)


def test_the_moon_is_where_the_almanac_has_it():
    """Full Moon of 3 January 2026, 10:03 UT (published): opposite to the Sun; parallax of a degree."""
    mjd = np.array([61043.0 + (10 + 3 / 60) / 24])
    centre = Site("", 0.0, 0.0, -6378137.0)  # the centre of the Earth
    ra, dec = body_direction("moon", mjd, centre)
    # Sun at that moment: RA 18h 54.1m, Dec −22.8°; the Moon at full stands within 5.2° of the opposite point
    moon = SkyCoord(ra[0] * u.deg, dec[0] * u.deg)
    opposite = SkyCoord("6h54.1m", "22.8d")
    assert moon.separation(opposite).deg < 5.3
    assert abs((moon.geocentrictrueecliptic.lon - opposite.geocentrictrueecliptic.lon).deg) < 0.3
    shift = moon.separation(SkyCoord(*body_direction("moon", mjd, SITE), unit="deg")).deg[0]
    assert 0.05 < shift < 1.03


def test_nothing_is_downloaded(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("the network was asked for")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    # times before, inside and beyond the tables of Earth rotation
    ra, dec = body_direction("moon", np.array([40000.0, 61043.85, 75000.0]), SITE)
    assert np.all(np.isfinite([ra, dec]))


def test_bad_skies_are_refused():
    good = np.array([61043.85])
    with pytest.raises(DataError, match="MJD: times must be Modified"):
        body_direction("moon", np.array([2461044.35]), SITE)
    with pytest.raises(DataError, match=r"SITELAT.*moon_patches = 0"):
        body_direction("moon", good, dataclasses.replace(SITE, latitude=float("nan")))
    with pytest.raises(DataError, match="DEC: is not finite"):
        moon_sky(good, good, np.array([np.nan]), good, SITE, *CENTRE)


def test_moon_exposures_of_an_outside_simulator(either_south_set):
    """Set a: camera ratios of the Moon patches through the true matrix, to the photon noise."""
    calset = read_calibration_set(either_south_set("a").path)
    truth = TrueInstrument(either_south_set("a"))
    exposures = calset.exposures
    moon = np.flatnonzero(exposures.kind == "moon")
    block = calset.intensities.block(0, len(calset.points))
    rows = np.flatnonzero(block.used[:, moon].all(axis=1))
    x, y = block.x[rows], block.y[rows]

    matrix = {name: values[:, None] for name, values in truth.matrix(x, y).items()}

    def chi2(site):
        settings = (getattr(exposures, name)[moon] for name in ("mjd", "ra", "dec", "rotator"))
        q, u_ = (0.8 * part for part in moon_sky(*settings, site, x, y))
        total = 0.0
        for k, row in ((0, "2"), (2, "3")):
            n, s = (v[np.ix_(rows, moon)][..., k : k + 2] for v in (block.counts, block.sigma))
            both = n.sum(axis=-1)
            ratio = (n[..., 0] - n[..., 1]) / both
            sigma = 2 * np.hypot(n[..., 1] * s[..., 0], n[..., 0] * s[..., 1]) / both**2
            model = matrix[f"m{row}1"] + matrix[f"m{row}2"] * q + matrix[f"m{row}3"] * u_
            total += np.mean(((ratio - model) / sigma) ** 2)
        return total / 2

    assert abs(chi2(calset.site) - 1) < 5 * np.sqrt(2 / (2 * len(rows) * len(moon)))
    assert chi2(dataclasses.replace(calset.site, longitude=110.0)) > 3  # the parallax is seen


def test_offsets_are_those_of_astropy_and_sidereal_time_is_within_arc_seconds():
    from astropy import units
    from astropy.coordinates import SkyCoord

    random = np.random.default_rng(4)
    ra, dec, angle, far = random.uniform((0, -80, 0, 1), (360, 80, 360, 40), (50, 4)).T
    there = SkyCoord(ra, dec, unit="deg").directional_offset_by(angle * units.deg, far * units.deg)
    found = offset_direction(ra, dec, angle, far)
    np.testing.assert_allclose(found[0], there.ra.deg, atol=1e-10)
    np.testing.assert_allclose(found[1], there.dec.deg, atol=1e-10)
    mjd = 55000.0 + 3000.0 * random.random(20)
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("iers_degraded_accuracy", "ignore"):
        theirs = Time(mjd, format="mjd", scale="ut1").sidereal_time("mean", 20.8 * units.deg).deg
    away = np.mod(local_sidereal_time(mjd, 20.8) - theirs + 180.0, 360.0) - 180.0
    assert np.abs(away).max() < 5.0 / 3600.0


@pytest.fixture(scope="module")
def night():
    return read_calibration_set("fits_data/walop_south_small.fits")


def test_the_sky_of_a_list_of_exposures_is_moonlit_in_those_of_the_moon(night):
    e, (x, y) = night.exposures, np.array([[-0.1, 0.0, 0.2], [0.1, 0.0, -0.2]])
    moon = np.flatnonzero(e.kind == "moon")
    sky = SkyOfExposures(e, night.site).polarisation(x, y)
    expected = moon_sky(e.mjd[moon], e.ra[moon], e.dec[moon], e.rotator[moon], night.site, x, y)
    np.testing.assert_array_equal(sky[:, moon], np.stack(expected, axis=-1))
    assert (np.delete(sky, moon, axis=1) == 0).all()


def test_the_sky_follows_changed_times_places_and_kinds(night):
    """Time and site of a set may be replaced (as when one asks whether they were recorded wrongly): no sky is kept."""
    e, site, (x, y) = night.exposures, night.site, np.array([[0.0, 0.2], [0.0, -0.2]])
    moon = np.flatnonzero(e.kind == "moon")
    late, south = (
        dataclasses.replace(e, mjd=e.mjd + 0.1),
        dataclasses.replace(site, latitude=-site.latitude),
    )
    before = SkyOfExposures(e, site).polarisation(x, y)
    for exposures, place in ((late, site), (e, south), (late, south)):
        sky = SkyOfExposures(exposures, place).polarisation(x, y)
        times = exposures.mjd[moon]
        expected = moon_sky(times, e.ra[moon], e.dec[moon], e.rotator[moon], place, x, y)
        np.testing.assert_array_equal(sky[:, moon], np.stack(expected, axis=-1))
        assert (sky[:, moon] != before[:, moon]).all()
    lamps = dataclasses.replace(e, kind=np.where(e.kind == "moon", "lamp", e.kind))
    assert (SkyOfExposures(lamps, site).polarisation(x, y) == 0).all()


def test_a_sky_without_the_moon_needs_no_ephemeris(night):
    nowhere = Site("", np.nan, np.nan, np.nan)
    e = night.exposures[night.exposures.kind != "moon"]
    assert (SkyOfExposures(e, nowhere).polarisation(*CENTRE) == 0).all()
    with pytest.raises(DataError, match="site is not known"):
        SkyOfExposures(night.exposures, nowhere).polarisation(*CENTRE)

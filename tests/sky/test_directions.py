"""Field coordinates, position angles and Galactic frames against closed forms; positions registered and matched."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord

from walop_jax.sky.directions import Pointing, designations, galactic, mutual, registered, same_stars

FIELD = Pointing(83.0, -61.0, 35.0)


def stars(count=200, seed=2):
    return FIELD.sky_of(*np.random.default_rng(seed).uniform(-0.3, 0.3, (2, count)))


def test_the_centre_is_the_origin_and_the_plane_is_that_of_the_conventions():
    x, y = FIELD.field_of(
        np.array([83.0, 83.0, 83.0 + 1e-3 / np.cos(np.deg2rad(61.0))]), np.array([-61.0, -60.999, -61.0])
    )
    sin, cos = np.sin(np.deg2rad(35.0)), np.cos(np.deg2rad(35.0))
    # north = X cos R − Y sin R, east = X sin R + Y cos R
    np.testing.assert_allclose(x * cos - y * sin, [0, 1e-3, 0], atol=2e-8)
    np.testing.assert_allclose(x * sin + y * cos, [0, 0, 1e-3], atol=2e-8)


def test_there_and_back():
    x, y = np.random.default_rng(0).uniform(-0.35, 0.35, (2, 50))
    np.testing.assert_allclose(FIELD.field_of(*FIELD.sky_of(x, y)), (x, y), atol=1e-12)


def test_the_gnomonic_projection():
    ra, dec = stars()
    x, y = FIELD.field_of(ra, dec)
    a, d, d0 = np.deg2rad(ra - 83.0), np.deg2rad(dec), np.deg2rad(-61.0)
    down = np.sin(d0) * np.sin(d) + np.cos(d0) * np.cos(d) * np.cos(a)
    east = np.cos(d) * np.sin(a) / down
    north = (np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * np.cos(a)) / down
    r = np.deg2rad(35.0)
    np.testing.assert_allclose(np.deg2rad(x), north * np.cos(r) + east * np.sin(r), atol=1e-14)
    np.testing.assert_allclose(np.deg2rad(y), east * np.cos(r) - north * np.sin(r), atol=1e-14)


def test_meridians_converge_by_napiers_analogy():
    """tan ½(φ' − φ) = tan ½Δα · sin ½(δ + δ') / cos ½(δ − δ')."""
    ra, dec = stars()
    a, d, d0 = np.deg2rad(ra - 83.0), np.deg2rad(dec), np.deg2rad(-61.0)
    turned = 2.0 * np.arctan(np.tan(a / 2) * np.sin((d + d0) / 2) / np.cos((d - d0) / 2))
    assert np.ptp(turned) > np.deg2rad(1.0)
    np.testing.assert_allclose(FIELD.rotator_at(ra, dec) - 35.0, np.rad2deg(turned), atol=1e-8)
    assert FIELD.rotator_at(np.array([83.0]), np.array([-61.0])) == 35.0


def test_galactic_north_by_spherical_trigonometry():
    """Its position angle: tan ψ = cos δ_G sin(α_G − α) / (sin δ_G cos δ − cos δ_G sin δ cos(α_G − α))."""
    ra, dec = np.random.default_rng(1).uniform((0, -80), (360, 80), (40, 2)).T
    longitude, latitude, north = galactic(ra, dec)
    a, d, pole = np.deg2rad(192.8594812 - ra), np.deg2rad(dec), np.deg2rad(27.1282512)
    psi = np.arctan2(
        np.cos(pole) * np.sin(a), np.sin(pole) * np.cos(d) - np.cos(pole) * np.sin(d) * np.cos(a)
    )
    np.testing.assert_allclose(np.mod(north - np.rad2deg(psi) + 180, 360) - 180, 0, atol=1e-5)
    place = SkyCoord(longitude, latitude, unit="deg", frame="galactic").icrs
    np.testing.assert_allclose(place.dec.deg, dec, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 20.0, 77.0, 130.0])
def test_an_angle_goes_to_the_galactic_frame_as_a_step_on_the_sky_does(angle):
    star = SkyCoord(97.5, -44.0, unit="deg")
    step = star.directional_offset_by(angle * units.deg, 1 * units.arcsec)
    there = star.galactic.position_angle(step.galactic).deg
    *_, north = galactic(np.array([97.5]), np.array([-44.0]))
    assert np.mod(angle - north[0] - there + 180, 360) - 180 == pytest.approx(0, abs=1e-5)


def test_names_are_cut_off_not_rounded():
    assert designations(
        np.array([97.79416016514, 359.9999999, 0.0]), np.array([-44.18037606, 0.99999, -0.5])
    ).tolist() == ["J063110.59-441049.3", "J235959.99+005959.9", "J000000.00-003000.0"]
    # Less than rounding from 0 h: there is no hour 24.
    assert designations(np.array([-1e-14, 360.0 - 1e-11]), np.zeros(2)).tolist() == 2 * [
        "J000000.00+000000.0"
    ]


def test_a_shift_and_a_rotation_are_recovered():
    rng = np.random.default_rng(3)
    place = rng.uniform(-0.3, 0.3, (800, 2))
    flux = rng.lognormal(size=800)
    angle = np.deg2rad(0.04)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = place @ turn.T + np.array([41.0, -7.5]) / 3600 + rng.normal(0, 0.1 / 3600, place.shape)
    found = registered(moved[50:], place[:750], flux[50:], flux[:750], 1.0)
    np.testing.assert_allclose(found.shift, [41.0, -7.5], atol=0.03)
    assert found.rotation == pytest.approx(0.04, abs=1e-4)
    np.testing.assert_allclose(3600 * (found.apply(moved) - place), 0, atol=0.6)
    assert registered(rng.uniform(-0.3, 0.3, (800, 2)), place, flux, flux, 1.0).pairs == 0


def test_pairs_are_nearest_to_each_other_and_ambiguous_ones_are_marked():
    one = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]])
    other = np.array(
        [[0.1, 0.00002], [0.0, 0.0001], [0.0, -0.00015], [0.3, 0.3]]
    )  # 0.36 and 0.54 arcsec of the first
    ambiguous, rows, numbers = mutual(one, other, 1.0)
    assert list(zip(rows.tolist(), numbers.tolist(), strict=True)) == [(0, 1), (1, 0)]
    assert ambiguous.tolist() == [True, False, False]


def test_positions_within_the_tolerance_are_one_star_across_the_zero_of_right_ascension():
    numbers = same_stars(np.array([359.99999, 0.00001, 10.0, 10.0]), np.array([10.0, 10.0, 5.0, 5.001]), 1.0)
    assert numbers[0] == numbers[1]
    assert len(set(numbers.tolist())) == 3

"""Places of the field where stars disagree together: found anywhere, of any size, in any camera; never by chance."""

from __future__ import annotations

import numpy as np
import pytest
from star_tables import read, stars

from walop_jax.fit.verdict import Quality
from walop_jax.science.apply import apply
from walop_jax.science.star_residuals import StarResiduals
from walop_jax.science.star_search import places_of

CAMERAS = ("O1", "E1", "O2", "E2")


def ideal_stars(count, rng, settings=(0.0,)):
    """Stars of an ideal polarimeter, one row for each angle (deg) by which its analysers are turned; no residuals."""
    star = np.repeat(np.arange(count), len(settings))
    x, y = (np.repeat(values, len(settings)) for values in rng.uniform(-0.28, 0.28, (2, count)))
    turn = 2.0 * np.deg2rad(np.tile(settings, count)[:, None] + np.array([0.0, 90.0, 45.0, 135.0]))
    a = 0.5 * np.stack([np.ones_like(turn), np.cos(turn), np.sin(turn)], axis=2)
    s = np.concatenate([np.ones((count, 1)), rng.normal(0.0, 0.02, (count, 2))], axis=1)[star]
    counts = np.repeat(10 ** rng.uniform(5.5, 7.0, count), len(settings))[:, None] * np.einsum(
        "rks,rs->rk", a, s
    )
    root = counts**-0.5
    model = counts * root
    tangent = np.moveaxis((model / np.einsum("rks,rs->rk", a, s))[:, :, None] * a[:, :, 1:], 2, 1)
    unit = model / np.linalg.norm(model, axis=1, keepdims=True)
    tangent = tangent - np.einsum("rik,rk,rl->ril", tangent, unit, unit)
    information = np.zeros((count, 2, 2))
    np.add.at(information, star, tangent @ tangent.swapaxes(1, 2))
    rows, nothing = len(star), np.zeros((len(star), 4, 0))
    return StarResiduals(
        star=star, residual=np.zeros((rows, 4)), model=model, tangent=tangent, photon=np.linalg.inv(information),
        root=root, x=x, y=y, time=np.full(rows, np.nan), plain=nothing, throughput=np.zeros((rows, 4, 4)),
        basis=np.ones((rows, 1)), colour=np.zeros((rows, 4, 2)),
    )  # fmt: skip


def noisy(sky, rng, change=0.0):
    return sky.left(change + rng.standard_normal(sky.model.shape))


def dust(sky, camera, x, y, size, depth):
    change = np.zeros(sky.model.shape)
    far = ((sky.x - x) ** 2 + (sky.y - y) ** 2) / size**2
    change[:, camera] = -depth * np.exp(-0.5 * far) * sky.model[:, camera]
    return change


def alarms(catalogues, alarm, *, outliers=0.0, count=300, settings=(0.0,)):
    """Catalogues of sound stars, some of them far off alone, of which a place is told."""
    rng = np.random.default_rng(7)
    sky, number = ideal_stars(count, rng, settings), 0
    for _ in range(catalogues):
        off = np.zeros(sky.model.shape)
        bad = rng.random(count) < outliers
        off[np.arange(len(sky)), rng.integers(0, 4, len(sky))] = (bad * rng.normal(0.0, 20.0, count))[
            sky.star
        ]
        number += bool(places_of(sky, CAMERAS, noisy(sky, rng, off), alarm=alarm))
    return number


def test_noise_and_single_outliers_make_no_place():
    assert alarms(12, 0.1) <= 2
    assert alarms(12, 0.1, outliers=0.05) <= 2


@pytest.mark.long
@pytest.mark.parametrize("settings", [(0.0,), (0.0, 45.0)])
def test_false_alarms_are_fewer_than_stated(settings):
    """Of 400 catalogues at 0.05 fewer than 20 + 2 √20; none at the 10⁻⁴ of `apply`."""
    for outliers in (0.0, 0.05):
        assert alarms(400, 0.05, outliers=outliers, settings=settings) < 29
        assert alarms(400, 1e-4, outliers=outliers, settings=settings) == 0


@pytest.mark.parametrize(
    ("count", "camera", "x", "y", "size", "depth", "settings"),
    [
        (400, 2, 0.11, -0.08, 0.03, 0.015, (0.0,)),
        (400, 0, -0.2, 0.22, 0.05, 0.01, (0.0,)),
        (300, 3, 0.0, 0.0, 0.1, 0.004, (0.0, 45.0)),
        (300, 1, 0.15, 0.15, 0.07, -0.01, (0.0, 45.0)),
        (3000, 1, -0.1, 0.05, 0.012, 0.02, (0.0,)),
    ],
)
def test_a_camera_that_lost_light_at_a_place_is_found(count, camera, x, y, size, depth, settings):
    rng = np.random.default_rng(11)
    sky = ideal_stars(count, rng, settings)
    place, *others = places_of(sky, CAMERAS, noisy(sky, rng, dust(sky, camera, x, y, size, depth)))
    assert not others
    assert np.hypot(place.x - x, place.y - y) < size
    assert 0.5 < place.size / size < 2.0
    (share,) = [entry for entry in place.alike if entry.name == CAMERAS[camera]]
    assert abs(share.size + depth) < 0.3 * abs(depth) + 3.0 * share.error
    assert f"{CAMERAS[camera]} {'fainter' if depth > 0 else 'brighter'} by" in place.words()


def test_single_settings_do_not_tell_the_cameras_and_several_do():
    """The residual of one row is one number: (1, 1, −1, −1) of an ideal instrument."""
    rng = np.random.default_rng(12)
    for settings, names in (((0.0,), set(CAMERAS)), ((0.0, 22.5, 45.0, 67.5), {"O2"})):
        sky = ideal_stars(400, rng, settings)
        (place,) = places_of(sky, CAMERAS, noisy(sky, rng, dust(sky, 2, 0.1, 0.1, 0.04, 0.01)))
        assert {entry.name for entry in place.alike} == names


def test_three_stars_are_no_place_however_far_they_lie():
    rng = np.random.default_rng(13)
    sky = ideal_stars(300, rng)
    change = np.zeros(sky.model.shape)
    change[np.argsort(np.hypot(sky.x, sky.y))[:3], 0] = 100.0
    assert not places_of(sky, CAMERAS, noisy(sky, rng, change))


@pytest.mark.usefixtures("tabulated_once")
def test_stars_on_dust_are_flagged_and_their_errors_hold_it(vectors, calibration, tmp_path):
    table, qu = stars(vectors, 500, np.random.default_rng(5), teff=5500.0)
    sound = apply(calibration, read(table, tmp_path))
    far = np.hypot(table["X"] - 0.1, table["Y"] + 0.1)
    table["N"][:, 2] *= 1.0 - 0.02 * np.exp(-0.5 * (far / 0.035) ** 2)
    found = apply(calibration, read(table, tmp_path))
    assert not found.check.holds
    assert found.check.holds_elsewhere
    (place,) = found.check.places
    assert np.hypot(place.x - 0.1, place.y + 0.1) < 0.035
    inside, outside = far < 0.05, far > 0.25
    assert np.all(found.flag[inside] & Quality.PLACE)
    assert not np.any(found.flag[outside] & (Quality.PLACE | Quality.CATALOGUE))
    np.testing.assert_allclose(found.covariance[outside], sound.covariance[outside], rtol=1e-9)

    def pulls(made):
        return (made.qu - qu) / np.sqrt(np.einsum("sii->si", made.covariance))

    assert np.abs((found.qu - qu) / np.sqrt(np.einsum("sii->si", sound.covariance)))[inside].max() > 5.0
    assert np.abs(pulls(found))[inside].max() < 3.0
    (sentence,) = found.check.warnings()
    assert "disagree with the calibration together" in sentence

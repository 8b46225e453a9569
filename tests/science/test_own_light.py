"""q and u of stars that follow the instrument: what the balance of an arm does to them, its size, and false alarms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from star_tables import setting

from walop_jax.science.estimate import estimate
from walop_jax.science.star_light import OwnLight, OwnLightCheck, own_light_check, unpolarised

ARMS = [("O1", "E1"), ("O2", "E2")]


@pytest.fixture(scope="module")
def field(vectors):
    """Places of 400 stars, and their analysis vectors."""
    x, y = np.random.default_rng(4).uniform(-0.28, 0.28, (2, 400))
    return x, y, vectors.coloured(setting(), x, y)


def interstellar(x, y, rng):
    """A mean, a gradient and waves of 0.2 to 0.5 degree, of half a per cent each; stars differ by 0.7 %."""
    qu = rng.normal(0.0, 0.01, 2) + 0.007 * rng.standard_normal((len(x), 2))
    qu += np.stack([x, y], axis=1) @ rng.normal(0.0, 0.02, (2, 2))
    for length in (0.5, 0.3, 0.2):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        wave = np.cos(2.0 * np.pi / length * (x * np.cos(angle) + y * np.sin(angle)) + phase)
        qu += 0.005 * wave[:, None] * rng.standard_normal(2)
    return qu


def seen(field, rng, gains=(1.0, 1.0, 1.0, 1.0), electrons=2e5) -> OwnLight:
    x, y, a = field
    s = np.concatenate([np.ones((len(x), 1)), interstellar(x, y, rng)], axis=1)
    counts = electrons * np.einsum("rks,rs->rk", a, s) * np.array(gains)
    sigma = np.sqrt(counts)
    counts = counts + sigma * rng.standard_normal(counts.shape)
    light = unpolarised(a, counts, sigma, np.arange(len(x)), [(0, 1), (2, 3)])
    group, nothing = np.zeros(len(x), int), np.zeros((len(x), 2, 0))
    return OwnLight(light.qu, light.noise, x, y, group, light.shifts, nothing, light.cameras)


def test_shifts_are_the_derivatives_of_q_and_u_and_qu_those_of_the_estimate(field):
    """By the exact estimate of `estimate`, from counts that are changed by a thousandth to either side."""
    _, _, a = field
    star = np.arange(len(a))
    counts, sigma = 1e6 * a[..., 0], np.sqrt(1e6 * a[..., 0])
    light = unpolarised(a, counts, sigma, star, [(0, 1), (2, 3)])
    clear = np.trace(light.noise, axis1=1, axis2=2) < 0.003**2
    for arm, (first, second) in enumerate(((0, 1), (2, 3))):
        moved = []
        for sign in (0.5e-3, -0.5e-3):
            gain = np.ones(4)
            gain[[first, second]] = 1.0 + sign, 1.0 - sign
            moved.append(estimate(a, counts * gain, sigma, star).qu)
        slope = (moved[0] - moved[1]) / 2e-3
        scale = np.abs(slope[clear]).max()
        np.testing.assert_allclose(light.shifts[clear, :, arm], slope[clear], atol=0.01 * scale)
    # An unpolarised star has q = u = 0; a slightly polarised one its own.
    np.testing.assert_allclose(light.qu, 0.0, atol=1e-9)
    s = np.array([1.0, 1e-4, -2e-4])
    light = unpolarised(a, 1e6 * a @ s, sigma, star, [(0, 1), (2, 3)])
    np.testing.assert_allclose(light.qu[clear], np.tile(s[1:], (int(clear.sum()), 1)), atol=2e-6)


@pytest.mark.parametrize(("arm", "size"), [(0, 0.05), (1, -0.02)])
def test_a_change_inside_an_arm_is_found_with_its_size(field, arm, size):
    """Of four hundred stars, with interstellar polarisation that is structured like the field."""
    gains = np.ones(4)
    gains[[2 * arm, 2 * arm + 1]] = 1.0 + 0.5 * size, 1.0 - 0.5 * size
    check = own_light_check(seen(field, np.random.default_rng(1), gains), ARMS)
    assert isinstance(check, OwnLightCheck)
    assert check.found
    mine = next(test for test in check.alike if test.cameras == ARMS[arm])
    assert mine.size == pytest.approx(size, abs=4.0 * mine.error)
    assert abs(size) > check.smallest or abs(mine.sigma) > 4.0
    assert ("brighter" if size > 0 else "fainter") in mine.words()
    assert "follow the pattern of the instrument" in check.words()


def test_sound_stars_are_quiet_and_errors_are_those_of_the_sizes(field):
    """Two hundred skies, of few and many stars, faint and bright: no alarm, and sizes scatter by their errors."""
    sigma = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        light = seen(field, rng, electrons=10.0 ** rng.uniform(3.5, 6.5))
        count = int(rng.choice([30, 60, 120, 400]))
        check = own_light_check(light.of(np.arange(400) < count), ARMS)
        if check is not None:
            assert not check.found, check.words()
            sigma += [test.sigma for test in check.tests if np.isfinite(test.error)]
    assert len(sigma) > 150
    assert np.std(sigma) < 1.15


def test_few_stars_are_not_asked(field):
    assert own_light_check(seen(field, np.random.default_rng(0)).of(np.arange(400) < 11), ARMS) is None


def test_the_mean_of_a_field_is_no_evidence(field):
    """A polarisation of the whole field of 30 % is no change of the instrument."""
    light = seen(field, np.random.default_rng(2))
    light = dataclasses.replace(light, qu=light.qu + np.array([0.2, -0.25]))
    check = own_light_check(light, ARMS)
    assert isinstance(check, OwnLightCheck)
    assert not check.found

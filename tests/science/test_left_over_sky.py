"""Polarised light of the sky left in the stars: found as q, u against sky over light, and not otherwise."""

import numpy as np
import pytest
from star_tables import read, setting
from star_tables import stars as table_of

from walop_jax.fit.verdict import Quality
from walop_jax.science.apply import apply
from walop_jax.science.star_light import SKY_CHANCE, left_over_sky
from walop_jax.science.stokes_columns import stokes_columns

SKY, SCATTER = 1e4, 0.004


def stars(rng, number=200, share=(0.0, 0.0), trend=0.0):
    """Stars of 10³ to 10⁶ electrons over a sky of 10⁴: noise of photons, a scatter, and what faintness brings along."""
    light = 10 ** rng.uniform(3.0, 6.0, number)
    variance = 2.0 * (light + SKY) / light**2
    ratio = SKY / light
    own = np.array([0.006, -0.002]) + SCATTER * rng.standard_normal((number, 2))
    own = own + trend * np.log10(light / 1e6)[:, None]
    qu = (
        own + np.sqrt(variance)[:, None] * rng.standard_normal((number, 2)) + ratio[:, None] * np.array(share)
    )
    return qu, variance[:, None, None] * np.eye(2), light, ratio


def test_none_in_five_hundred_sound_catalogues():
    """Half of them with stars that are more polarised where they are fainter, as distance makes them."""
    rng = np.random.default_rng(1)
    found = [left_over_sky(*stars(rng, trend=0.002 * (n % 2))) for n in range(500)]
    assert not any(one.found for one in found)
    # Errors are what they say: both components of 500, against a Gaussian.
    pulls = np.abs(np.concatenate([one.share / one.errors for one in found]))
    assert np.mean(pulls < 1.0) == pytest.approx(0.683, abs=0.05)
    assert np.mean(pulls < 1.96) == pytest.approx(0.95, abs=0.025)


def test_found_at_the_bound():
    """One per cent of the sky's level, polarised by a tenth of it; then what is found in 99 of 100 catalogues."""
    rng = np.random.default_rng(2)
    error = left_over_sky(*stars(rng)).errors.mean()
    limit = error * (np.sqrt(-2.0 * np.log(SKY_CHANCE)) + 2.33)
    found = [left_over_sky(*stars(rng, share=(0.6 * limit, -0.8 * limit))) for _ in range(100)]
    assert sum(one.found for one in found) >= 96
    assert np.mean([one.share for one in found], axis=0) == pytest.approx(
        [0.6 * limit, -0.8 * limit], abs=0.5 * error
    )
    large = left_over_sky(*stars(rng, 2000, share=(0.01, 0.0)))
    assert large.found
    assert large.share == pytest.approx([0.01, 0.0], abs=4 * large.errors.max())
    assert "1.0" in large.words()


def test_the_shift_is_in_the_errors():
    """Covariances cover what the sky did; a sound catalogue has a bound and no shift."""
    rng = np.random.default_rng(3)
    qu, photon, light, ratio = stars(rng, 1000, share=(0.006, 0.008))
    found = left_over_sky(qu, photon, light, ratio)
    whole = found.covariance(ratio)
    assert np.sqrt(np.trace(whole, axis1=1, axis2=2)) == pytest.approx(0.01 * ratio, rel=0.1)
    sound = left_over_sky(*stars(rng))
    assert sound.covariance(ratio).max() == 0.0
    assert 0.0 < sound.bound < 0.01


def test_too_few_or_all_alike():
    rng = np.random.default_rng(4)
    assert left_over_sky(*stars(rng, 30)) is None
    qu, photon, light, ratio = stars(rng)
    assert left_over_sky(qu, photon, np.full_like(light, 1e5), np.full_like(ratio, 0.1)) is None


@pytest.mark.usefixtures("tabulated_once")
def test_a_catalogue_with_the_level_of_its_sky(vectors, calibration, tmp_path):
    """Through the optics: stars of 10³ to 10⁶ electrons, polarised sky of 2 % of the level left in the counts."""
    rng = np.random.default_rng(6)
    flux = 4.0 * 10 ** rng.uniform(3.0, 6.0, 500)
    table, qu = table_of(vectors, 500, flux=flux[:, None], teff=5500.0)
    a = vectors.exact(setting(), table["X"], table["Y"], [5500.0])[:, 0]
    table["SKY"] = 4e4 * a[..., 0]
    table["N_ERR"] = np.sqrt(np.maximum(table["N"] + table["SKY"], 0.0) + 900.0)
    sound = table["N"] + table["N_ERR"] * rng.standard_normal(table["N"].shape)
    for left in (0.0, 0.02):
        table["N"] = sound + left * 4e4 * (0.6 * a[..., 1] + 0.8 * a[..., 2])
        found = apply(calibration, read(table, tmp_path))
        assert found.check.sky is not None
        assert found.check.sky.found == (left > 0)
        assert np.all((found.flag & Quality.CATALOGUE > 0) == (left > 0))
        assert any("polarised light of the sky" in text for text in found.check.warnings()) == (left > 0)
        assert "SKY_BOUND" in stokes_columns(found, np.arange(500), "MAS")
        off = (found.qu - qu) / np.sqrt(np.einsum("sii->si", found.covariance))
        assert np.mean(np.abs(off) < 1.96) > 0.9
        shift = left * 4e4 / flux
        assert np.mean(shift <= found.sky_bound) > 0.95
    del table["SKY"]
    assert apply(calibration, read(table, tmp_path)).sky_bound is None

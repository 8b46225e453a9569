"""TEFF from BP − RP: published numbers, and their error in q and u; columns of colours under other names."""

from __future__ import annotations

import numpy as np
import pytest
from star_tables import SOUTH, read, stars

from walop_jax.data.user_tables import in_memory
from walop_jax.io.errors import DataError
from walop_jax.science.apply import _Application
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.colours import DWARFS, GIANTS, temperature, temperature_of


def test_numbers_of_the_relation():
    """5040 K / T = 0.4929 + 0.5092 C − 0.0353 C² of dwarfs: 5683.9 K at 0.82; giants at 1.23: 4721 K."""
    assert temperature(np.array([0.82]), DWARFS)[0] == pytest.approx(5683.94, abs=0.01)
    assert temperature(np.array([1.23]), GIANTS)[0] == pytest.approx(4720.95, abs=0.01)


def test_the_error_has_scatter_kinds_and_the_error_of_the_colour():
    mean, error = temperature_of(
        np.array([0.82, 0.82, 0.3, 1.6, np.nan]), np.array([0.0, 0.1, 0.0, 0.0, 0.0])
    )
    giant = 5040 / (0.5323 + 0.4775 * 0.82 - 0.0344 * 0.82**2)
    assert mean[0] == pytest.approx((5683.94 + giant) / 2, abs=0.01)
    assert error[0] == pytest.approx(np.hypot(83.0, (giant - 5683.94) / 2), abs=0.1)
    slope = 5683.94**2 / 5040 * (0.5092 - 2 * 0.0353 * 0.82)  # K per mag
    assert error[1] ** 2 - error[0] ** 2 == pytest.approx((0.1 * slope) ** 2, rel=1e-3)
    assert np.isnan(mean[2:]).all()


def table(**columns):
    given = {
        "X": [0.1, 0.0, 0.05],
        "Y": [0.0, 0.0, 0.1],
        "N": np.full((3, 4), 1e5),
        "N_ERR": np.full((3, 4), 400.0),
    }
    return in_memory(given | columns)


def test_a_colour_stands_in_where_there_is_no_temperature():
    source = table(bp_rp=[0.82, 0.82, -99.0], TEFF=[7000.0, np.nan, np.nan], TEFF_ERR=[50.0, np.nan, np.nan])
    rows = read_catalogue(source, SOUTH)
    teff = rows.points.settings.teff
    assert teff[0] == 7000.0
    assert rows.teff_err[0] == 50.0
    assert 5600 < teff[1] < 5800
    assert rows.teff_err[1] > 83.0
    assert np.isnan(teff[2])
    assert rows.teff_err[2] == 0.0
    said = "; ".join(rows.remarks)
    assert "TEFF of 1 rows is made of BP_RP (Mucciarelli et al. 2021)" in said
    assert "BP_RP of 1 rows lies beyond 0.39 … 1.5 mag" in said
    assert "not used" not in said
    with pytest.raises(DataError, match="TEFF_ERR: is below 0 in row 1"):
        read_catalogue(table(TEFF=[5e3] * 3, TEFF_ERR=[1.0, -1.0, 1.0]), SOUTH)


@pytest.mark.parametrize(
    "name", ["T_EFF", "BP-RP", "g-r", "B_V", "COLOR", "teff_gspphot", "Spectral_Type", "Temperature"]
)
def test_a_colour_under_an_unknown_name_is_named(name):
    said = "; ".join(read_catalogue(table(**{name: [1.0, 1.0, 1.0]}), SOUTH).remarks)
    assert f"{name.upper()}: the colour of a star is read from TEFF (K) or BP_RP (mag, of Gaia)" in said


@pytest.mark.parametrize("name", ["IMAGE", "GAIN", "X_IMAGE", "SNR", "JITTER"])
def test_other_columns_are_no_colours(name):
    assert "colour" not in "; ".join(read_catalogue(table(**{name: [1.0, 1.0, 1.0]}), SOUTH).remarks)


def test_identities_go_with_the_stars_without_a_remark():
    source = table(RA=[110.0, 111.0, 112.0], DEC=[0.0] * 3, SOURCE_ID=[1, 2, 3], parallax=[1.0] * 3)
    assert read_catalogue(source, SOUTH).remarks == ()


def test_the_error_of_a_temperature_is_that_of_q_and_u(vectors, tmp_path):
    """Against q, u that temperatures one error higher and lower give; a star without has twelve times as much."""
    made, _ = stars(vectors, 40, teff=5200.0)
    qu = {}
    for name, teff, error in (
        ("mid", 5200.0, 100.0),
        ("up", 5300.0, 0.0),
        ("down", 5100.0, 0.0),
        ("none", np.nan, 0.0),
    ):
        made["TEFF"], made["TEFF_ERR"] = teff, error
        work = _Application(vectors, read(made, tmp_path), force=False)
        qu[name] = work.block(np.arange(40)).stars
    spectrum = qu["mid"].spectrum
    half = 0.5 * (qu["up"].qu - qu["down"].qu)
    np.testing.assert_allclose(np.sqrt(np.einsum("sii->si", spectrum)), np.abs(half), rtol=0.02, atol=1e-9)
    assert not qu["up"].spectrum.any()
    none = np.einsum("sii->s", qu["none"].spectrum)
    assert np.median(none / np.einsum("sii->s", spectrum)) > 2.0**2


def test_one_star_in_two_fields_is_found_by_its_position():
    """By RA and DEC; two stars of one exposure stay two, however close."""
    close = 0.5 / 3600
    source = table(RA=[10.0, 10.0, 10.0 + close], DEC=[0.0, 0.1 * close, 0.0], MJD=[1.0, 2.0, 1.0])
    assert len(set(read_catalogue(source, SOUTH).star.tolist())) == 3
    source = table(RA=[10.0, 10.0, 11.0], DEC=[0.0, 0.1 * close, 0.0], MJD=[1.0, 2.0, 1.0])
    rows = read_catalogue(source, SOUTH)
    assert rows.star[0] == rows.star[1] != rows.star[2]
    assert "1 rows are further rows of stars at the same RA and DEC" in "; ".join(rows.remarks)
    source = table(RA=[10.0, 10.0, 11.0], DEC=[0.0, 0.1 * close, 0.0])  # no time: by the place in the field
    assert read_catalogue(source, SOUTH).star[:2].tolist() == [0, 0]
    source = table(RA=[10.0, 10.0, 11.0], DEC=[0.0] * 3, SOURCE_ID=[5, 6, 5], MJD=[1.0, 2.0, 3.0])
    assert read_catalogue(source, SOUTH).star.tolist() == [0, 1, 0]

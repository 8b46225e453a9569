"""The table of standard stars: what it holds, what SOURCES takes of it."""

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.commands.command import UsageError
from walop_jax.data.checks import make_sources
from walop_jax.data.schema import SOURCES, table_of
from walop_jax.data.standards import shipped_standards
from walop_jax.data.units import Place

TABLE = shipped_standards()


def row(name, band):
    """The row of a star in a band."""
    return TABLE[(TABLE["NAME"] == name) & (TABLE["FILTER"] == band)][0]


def test_every_value_has_a_source_and_a_date():
    assert TABLE.meta["version"] == 2
    assert TABLE.meta["date"] == "2026-11-27"
    assert all(str(one["REFERENCE"]) and one["P_ERR"] > 0 for one in TABLE)
    assert set(TABLE["FILTER"]) <= {"B", "V", "R"}
    assert set(np.asarray(TABLE["EPOCH"])) <= {0, 1982, 1990, 1992, 2007, 2023}


def test_rows_go_into_sources_as_they_are():
    columns = {
        name: np.asarray(TABLE[name].value if name == "TEFF" else TABLE[name])
        for name in SOURCES
        if name in TABLE.colnames
    }
    place = Place("set.fits", "SOURCES")
    sources = make_sources(table_of(columns, SOURCES, place), place)
    assert sources.stars.tolist()[1:3] == [1, 1]  # HD 14069 in V and B


def test_stokes_parameters_worked_out_by_hand():
    """VI Cyg 12 in R: 7.893 % at 116.23°; its angle may vary by 0.27°, which is 0.075 % across."""
    star = row("VI Cyg 12", "R")
    assert float(star["Q"]) == pytest.approx(0.07893 * np.cos(np.deg2rad(232.46)), abs=1e-12)
    assert float(star["U"]) == pytest.approx(-0.06259, abs=2e-5)
    assert float(np.hypot(star["Q_ERR"], star["U_ERR"])) == pytest.approx(
        np.hypot(3.7e-4, 2 * 0.07893 * np.deg2rad(np.hypot(0.14, 0.27))), rel=1e-12
    )
    nothing = row("HD 154892", "B")
    assert [float(nothing[name]) for name in ("Q", "U")] == [0.0, 0.0]
    assert float(nothing["Q_ERR"]) == pytest.approx(np.sqrt((5e-4**2 + 3e-4**2) / 2))
    faint = row("HD 14069", "V")
    assert float(faint["Q_ERR"]) == pytest.approx(1.9e-4)
    assert float(faint["U_ERR"]) == pytest.approx(1.9e-4)


def test_a_polarised_standard_of_the_south():
    """Hiltner 652 (CD−28 13479): 17:43:19.6 −28:40:33, 6.07 % at 179.39° in R, so that U is −0.13 %."""
    star = row("Hiltner 652", "R")
    assert float(star["RA"].value) == pytest.approx(15 * (17 + 43 / 60 + 19.6 / 3600), abs=1e-3)
    assert float(star["DEC"].value) == pytest.approx(-(28 + 40 / 60 + 33 / 3600), abs=1e-3)
    assert (float(star["Q"]), float(star["U"])) == pytest.approx((0.0607, -0.0013), abs=1e-4)
    assert "Hiltner 652" in walop.standards(near=(266.0, -29.0))["NAME"][:2]


def test_a_star_that_varies_has_the_larger_error():
    varies, stable = row("HD 183143", "R"), row("HD 161056", "R")
    assert float(varies["U_ERR"]) > 1.5e-3  # 2 · 5.9 % · 0.84°: near 180° the angle is in U
    assert float(np.hypot(stable["Q_ERR"], stable["U_ERR"])) < 6e-4


def test_nearest_and_above_the_horizon():
    assert list(walop.standards(near="308.2,41.3")["NAME"][:2]) == ["VI Cyg 12", "Hiltner 960"]
    high = walop.standards(up=61041.9)
    assert np.all(high["ALTITUDE"].value >= 30.0)
    assert np.all(np.diff(high["ALTITUDE"].value) <= 0.0)
    for wrong in ("308", "a,b", "10,95"):
        with pytest.raises(UsageError, match="near"):
            walop.standards(near=wrong)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"near": "nan,0"}, "a right ascension is between 0 and 360 degrees"),
        ({"near": "400,0"}, "a right ascension is between 0 and 360 degrees"),
        ({"up": float("nan")}, "up = nan must be a time"),
        ({"up": 2461000.5}, "is this a Julian Date"),
    ],
)
def test_directions_and_times_that_are_none_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        walop.standards(**options)

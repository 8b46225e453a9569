"""Who the stars are: proper motions to the time of the exposure, several candidates, one of another magnitude."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.table import Table, vstack
from astropy.time import Time
from camera_files import CENTRE, four, some_stars

import walop_jax as walop
from walop_jax.io.errors import DataError
from walop_jax.science.identification import moved

MJD = 61220.85
STARS = some_stars(100, seed=4)
MAGNITUDE = 25.0 - 2.5 * np.log10(np.asarray(STARS["N"]).mean(axis=1))


def known(**columns) -> Table:
    made = STARS["RA", "DEC", "SOURCE_ID", "BP_RP"].copy()
    made["PHOT_G_MEAN_MAG"] = MAGNITUDE + np.random.default_rng(0).normal(0, 0.15, len(STARS))
    for name, values in columns.items():
        made[name] = values
    return made


def beside(table, arcsec, magnitudes, rows=slice(None)) -> Table:
    """Other stars, so many arcsec to the north, with identifiers from 777 on."""
    made = table[rows].copy()
    made["DEC"] += arcsec / 3600
    made["SOURCE_ID"], made["PHOT_G_MEAN_MAG"], made["BP_RP"] = 777 + np.arange(len(made)), magnitudes, 1.4
    return made


def identified(folder, caplog, table, words=None):
    bare = STARS["RA", "DEC", "N", "N_ERR"]
    files = four(bare, folder, words={**CENTRE, "MJD": MJD} if words is None else words)
    with caplog.at_level("WARNING", logger="walop_jax"):
        made = walop.gather(files, gaia=table)
    order = [
        int(np.argmin(np.hypot(made["RA"] - ra, made["DEC"] - dec)))
        for ra, dec in STARS["RA", "DEC"].iterrows()
    ]
    return made[order], caplog.text


def right(made) -> np.ndarray:
    return np.asarray(made["SOURCE_ID"]) == np.asarray(STARS["SOURCE_ID"])


@pytest.mark.parametrize("dec", [0.0, -44.0, 89.99])
def test_proper_motions_are_those_of_astropy(dec):
    """Against apply_space_motion, which needs a distance; without a radial velocity that does not matter."""
    star = SkyCoord(
        ra=359.9999 * units.deg,
        dec=dec * units.deg,
        pm_ra_cosdec=250 * units.mas / units.yr,
        pm_dec=-170 * units.mas / units.yr,
        distance=100 * units.pc,
        obstime=Time(2016.0, format="jyear", scale="tdb"),
    )
    later = star.apply_space_motion(new_obstime=Time(2026.5, format="jyear", scale="tdb"))
    ra, dec_later = moved([359.9999], [dec], [250.0], [-170.0], [10.5])
    off = later.separation(SkyCoord(ra[0], dec_later[0], unit="deg"))
    assert off.mas < 1e-3
    assert moved([10.0], [dec], [np.nan], [np.nan], [10.0])[0][0] == pytest.approx(10.0, abs=1e-12)


def test_places_of_gaia_are_moved_to_the_time_of_the_exposure(tmp_path, caplog):
    """2.1 arcsec in ten years; a faint star stands where the bright one is seen today."""
    motion = np.where(np.arange(len(STARS)) < 20, 200.0, 0.0)
    table = known(PMRA=0.0 * motion, PMDEC=motion, REF_EPOCH=np.full(len(STARS), 2016.0))
    behind = beside(table, 0.0, 20.5, slice(20))
    behind["PMDEC"] = 0.0
    years = Time(MJD, format="mjd").jyear - 2016.0
    table["DEC"] -= motion * years / 3.6e6
    made, _ = identified(tmp_path, caplog, vstack([table, behind]))
    assert right(made).all()
    assert set(made["ID_FLAG"][:20]) == {1}
    assert not made["ID_FLAG"][20:].any()


def test_what_is_missing_for_proper_motions_is_said(tmp_path, caplog):
    _, said = identified(tmp_path, caplog, known())
    assert "has no PMRA and no PMDEC: its places are taken as they are" in said


@pytest.mark.parametrize(
    ("columns", "words", "message"),
    [
        ({"PMRA": 0.0, "PMDEC": 0.0}, None, "no REF_EPOCH: taken as 2016"),
        (
            {"PMRA": 0.0, "PMDEC": 0.0, "REF_EPOCH": 2016.0},
            CENTRE,
            "state no MJD: PMRA and PMDEC are not used",
        ),
        ({"PMRA": np.nan, "PMDEC": 0.0, "REF_EPOCH": 2016.0}, None, "100 of 100 stars have no proper motion"),
    ],
)
def test_what_else_is_missing_is_said(columns, words, message, tmp_path, caplog):
    _, said = identified(tmp_path, caplog, known(**columns), words)
    assert message in said


def test_an_epoch_that_is_no_year_is_refused(tmp_path, caplog):
    with pytest.raises(DataError, match=r"REF_EPOCH: is no year in .*Julian years"):
        identified(tmp_path, caplog, known(PMRA=0.0, PMDEC=0.0, REF_EPOCH=57388.0))


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.7])
def test_a_faint_star_that_is_nearer_is_not_the_star(shift, tmp_path, caplog):
    """Both within the tolerance: the light is that of the bright one, whatever the astrometry of a tenth of arcsec."""
    table = known()
    table["DEC"] += np.random.default_rng(1).normal(0, 0.15, len(table)) / 3600
    made, said = identified(tmp_path, caplog, vstack([table, beside(known(), shift, MAGNITUDE + 5.0)]))
    assert right(made).all()
    assert set(made["ID_FLAG"]) == {1}
    assert "100 stars have several candidates within 1 arcsec: decided by place and magnitude" in said
    assert not made["N_FLAG"].any()


def test_two_candidates_that_cannot_be_told_apart_are_none(tmp_path, caplog):
    """Of ten stars: as bright and as near."""
    table = known()
    table["DEC"][:10] -= 0.03 / 3600
    made, said = identified(
        tmp_path, caplog, vstack([table, beside(table, 0.06, table["PHOT_G_MEAN_MAG"][:10], slice(10))])
    )
    assert np.flatnonzero(made["ID_FLAG"]).tolist() == list(range(10))
    assert set(made["ID_FLAG"][:10]) == {2}
    assert set(made["SOURCE_ID"][:10]) == {-1}
    assert np.isnan(made["BP_RP"][:10]).all()
    assert right(made)[10:].all()
    assert "10 stars have several candidates within 1 arcsec that cannot be told apart" in said


def test_the_only_candidate_of_quite_another_magnitude_is_another_star(tmp_path, caplog):
    table = known()
    missing = beside(table, 0.0, MAGNITUDE[:4] + 6.0, slice(4))
    made, said = identified(tmp_path, caplog, vstack([table[4:], missing]))
    assert made["ID_FLAG"][:5].tolist() == [4, 4, 4, 4, 0]
    assert set(made["SOURCE_ID"][:4]) == {-1}
    assert "4 stars have a single candidate of quite another magnitude: not taken" in said


def test_without_magnitudes_the_place_decides_where_it_can(tmp_path, caplog):
    table = vstack([known(), beside(known(), 0.8, 0.0)])
    del table["PHOT_G_MEAN_MAG"]
    made, said = identified(tmp_path, caplog, table)
    assert right(made).all()
    assert "by place alone: the table has no PHOT_G_MEAN_MAG" in said


def test_apply_carries_the_flags_of_the_identity(tmp_path, caplog, calibration):
    stars = walop.simulate(seed=3, stars=20)
    stars["ID_FLAG"], stars["BLENDED"] = np.arange(20), np.arange(20) > 10
    with caplog.at_level("WARNING", logger="walop_jax"):
        made = walop.apply(calibration, stars)
    assert made["ID_FLAG"].tolist() == list(range(20))
    assert "not used" not in caplog.text

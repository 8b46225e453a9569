"""Words of all headers of a catalogue: the instrument, the exposure, the pointing and its reference system."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import FK4, FK5, TETE, SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from astropy.wcs import WCS
from camera_files import CAMERAS, CENTRE, ldac, of_camera, some_stars

import walop_jax as walop
from walop_jax.data.celestial import Frame, frame_of
from walop_jax.data.units import Place
from walop_jax.io.errors import DataError

STARS = some_stars(60)
MJD = 61220.85


def files_with(folder, primary=None, of_table=None, change=lambda k, columns: None):
    """FITS catalogues of the cameras with words in the primary header and in that of the table."""
    files = []
    for k, name in enumerate(CAMERAS):
        columns = of_camera(STARS, k, np.random.default_rng(k))
        change(k, columns)
        first, table = fits.PrimaryHDU(), fits.table_to_hdu(Table(columns))
        first.header.update(primary(k) if callable(primary) else primary or {})
        table.header.update(of_table(k) if callable(of_table) else of_table or {})
        fits.HDUList([first, table]).writeto(folder / f"{name}.fits", overwrite=True)
        files.append(folder / f"{name}.fits")
    return files


def gathered(caplog, files, **options):
    caplog.clear()
    with caplog.at_level("WARNING", logger="walop_jax"):
        made = walop.gather(files, **options)
    made.sort("SOURCE_ID")
    return made, caplog.text


def test_words_of_the_primary_header_are_read(tmp_path, caplog):
    words = {**CENTRE, "FILTER": "SDSS-i", "INSTRUME": "WALOP-NORTH", "MJD": MJD}
    made, _ = gathered(caplog, files_with(tmp_path, words))
    assert set(made["FILTER"]) == {"SDSS-i"}
    assert set(made["MJD"]) == {MJD}
    assert made.meta["INSTRUME"] == "WALOP-NORTH"
    np.testing.assert_allclose(made["X"], STARS["X"], atol=0.5 / 3600)


@pytest.mark.parametrize("spelled", ["WALOP-NORTH", "walop north"])
@pytest.mark.parametrize("where", ["primary", "of_table"])
def test_another_instrument_than_asked_is_refused_with_the_remedy(where, spelled, tmp_path):
    files = files_with(tmp_path, **{where: {**CENTRE, "INSTRUME": spelled}})
    with pytest.raises(
        DataError, match=rf"INSTRUME: is {spelled}, WALOP-SOUTH is asked .*--instrument WALOP-NORTH"
    ):
        walop.gather(files, instrument="WALOP-SOUTH")
    assert walop.gather(files, instrument="WALOP-NORTH").meta["INSTRUME"] == "WALOP-NORTH"


def test_the_stars_of_another_instrument_or_filter_are_not_corrected(tmp_path, calibration):
    north = files_with(tmp_path, {**CENTRE, "INSTRUME": "WALOP-NORTH"})
    with pytest.raises(DataError, match=r"WALOP-SOUTH is asked for; .* a calibration of it"):
        walop.apply(calibration, north)
    other = files_with(tmp_path, {**CENTRE, "FILTER": "SDSS-i"})
    with pytest.raises(DataError, match="SDSS-i"):
        walop.apply(calibration, other)


def test_an_instrument_that_is_not_known_is_refused_unless_it_is_said_which_it_is(tmp_path, caplog):
    files = files_with(tmp_path, {**CENTRE, "INSTRUME": "ANDOR 7"})
    with pytest.raises(DataError, match=r"INSTRUME: is 'ANDOR 7', which is not known; .*--instrument"):
        walop.gather(files)
    made, said = gathered(caplog, files, instrument="WALOP-SOUTH")
    assert "INSTRUME is 'ANDOR 7', which is no instrument that is known: taken as WALOP-SOUTH" in said
    assert made.meta["INSTRUME"] == "WALOP-SOUTH"


@pytest.mark.parametrize(
    ("name", "one", "other"),
    [
        ("FILTER", "SDSS-r", "SDSS-i"),
        ("MJD", MJD, MJD + 0.5),
        ("INSTRUME", "WALOP-SOUTH", "WALOP-NORTH"),
        ("RA", 97.5, 97.9),
    ],
)
def test_headers_and_cameras_that_contradict_each_other_are_refused(name, one, other, tmp_path):
    contradicting = files_with(tmp_path, {**CENTRE, name: other}, {**CENTRE, name: one})
    with pytest.raises(
        DataError, match=rf"{name}: is {one} in the header of the table and {other} in the (header )?prim"
    ):
        walop.gather(contradicting)
    of_cameras = files_with(tmp_path, lambda k: {**CENTRE, name: other if k == 2 else one})
    with pytest.raises(DataError, match=rf"{name} is {one} \(.*O1.fits\) and {other} \(.*O2.fits\) in"):
        walop.gather(of_cameras)
    if name == "RA":  # what is said on the command line settles it
        assert len(walop.gather(of_cameras, ra=97.5)) == len(STARS)


def test_headers_that_agree_as_cameras_do_are_one(tmp_path):
    files = files_with(tmp_path, {**CENTRE, "MJD": MJD + 1e-4, "RA": "06:30:00"}, {**CENTRE, "MJD": MJD})
    assert set(walop.gather(files)["MJD"]) == {MJD}


def test_a_column_that_contradicts_the_header_is_refused(tmp_path):
    def with_filter(k, columns):
        columns["FILTER"] = np.full(len(columns["FLAGS"]), "SDSS-r")

    with pytest.raises(DataError, match="FILTER: is SDSS-r in the column and SDSS-i in the header"):
        walop.gather(files_with(tmp_path, {**CENTRE, "FILTER": "SDSS-i"}, change=with_filter))


SYSTEMS = {
    "FK5 of date": ({"RADESYS": "FK5", "EQUINOX": 2026.9}, FK5(equinox="J2026.9")),
    "EQUINOX alone": ({"EQUINOX": 2026.9}, FK5(equinox="J2026.9")),
    "FK4": ({"RADESYS": "FK4", "EQUINOX": 1950.0}, FK4(equinox="B1950")),
    "old EQUINOX alone": ({"EQUINOX": "B1950.0"}, FK4(equinox="B1950")),
    "apparent": ({"RADESYS": "GAPPT", "MJD": MJD}, TETE(obstime=Time(MJD, format="mjd"))),
}


@pytest.mark.parametrize("system", SYSTEMS)
def test_pointings_of_other_systems_are_made_icrs(system, tmp_path, caplog):
    """Field coordinates are those of the same sky: 0.1 to 0.8 deg of precession are none of them."""
    words, frame = SYSTEMS[system]
    centre = SkyCoord(CENTRE["RA"], CENTRE["DEC"], unit="deg").transform_to(frame)
    pointing = {"RA": centre.ra.deg, "DEC": centre.dec.deg, "ROTATOR": CENTRE["ROTATOR"], **words}
    made, said = gathered(caplog, files_with(tmp_path, pointing))
    assert "RA and DEC of the header are in" in said
    for name in "XY":
        np.testing.assert_allclose(made[name], STARS[name], atol=0.6 / 3600)


@pytest.mark.parametrize("system", SYSTEMS)
def test_columns_in_the_system_of_the_image_or_table_are_made_icrs(system, tmp_path, caplog):
    words, frame = SYSTEMS[system]

    def native(names):
        def change(k, columns):
            of_2000 = columns.pop("ALPHA_J2000"), columns.pop("DELTA_J2000")
            stars = SkyCoord(*of_2000, unit="deg").transform_to(frame)
            columns |= dict(zip(names, (stars.ra.deg, stars.dec.deg), strict=True))

        return change

    options = {name.lower(): value for name, value in CENTRE.items()}
    for names in (("ALPHA_SKY", "DELTA_SKY"), ("RA", "DEC")):
        made, said = gathered(caplog, files_with(tmp_path, of_table=words, change=native(names)), **options)
        assert f"{names[0]}, {names[1]} are in" in said
        np.testing.assert_allclose(made["RA"], STARS["RA"], atol=1.0 / 3600)
        np.testing.assert_allclose(made["DEC"], STARS["DEC"], atol=0.5 / 3600)


def test_columns_of_j2000_stay_whatever_the_equinox_of_the_image(tmp_path):
    options = {name.lower(): value for name, value in CENTRE.items()}
    files = files_with(tmp_path, of_table={"EQUINOX": 2026.9, "RADESYS": "FK5"})
    made = walop.gather(files, **options)
    made.sort("SOURCE_ID")
    np.testing.assert_allclose(made["DEC"], STARS["DEC"], atol=0.5 / 3600)


def wcs_in(frame, words) -> fits.Header:
    """The header of an image of the field with north of another system."""
    centre = SkyCoord(CENTRE["RA"], CENTRE["DEC"], unit="deg").transform_to(frame)
    plane, turn = WCS(naxis=2), np.deg2rad(CENTRE["ROTATOR"])
    plane.wcs.ctype, plane.wcs.crpix = ["RA---TAN", "DEC--TAN"], [2048.0, 2048.0]
    plane.wcs.crval = [centre.ra.deg, centre.dec.deg]
    plane.wcs.cd = 0.5 / 3600 * np.array([[np.sin(turn), np.cos(turn)], [np.cos(turn), -np.sin(turn)]])
    header = plane.to_header()
    del header["RADESYS"]
    header.update({"NAXIS": 2, "NAXIS1": 4096, "NAXIS2": 4096, **words})
    return header


@pytest.mark.parametrize("system", SYSTEMS)
def test_pixels_of_a_wcs_of_another_system_are_made_icrs(system, tmp_path, caplog):
    words, frame = SYSTEMS[system]
    header = wcs_in(frame, words)
    plain = WCS({key: header[key] for key in header if key not in ("RADESYS", "EQUINOX")})
    files = []
    for k, name in enumerate(CAMERAS):
        columns = of_camera(STARS, k, np.random.default_rng(k))
        sky = SkyCoord(columns.pop("ALPHA_J2000"), columns.pop("DELTA_J2000"), unit="deg").transform_to(frame)
        columns["X_IMAGE"], columns["Y_IMAGE"] = plain.wcs_world2pix(sky.ra.deg, sky.dec.deg, 1)
        files.append(ldac(tmp_path / f"{name}.fits", columns, header))
    options = {name.lower(): value for name, value in CENTRE.items()}
    made, said = gathered(caplog, files, **options)
    assert "the WCS of the header is in" in said
    np.testing.assert_allclose(made["X"], STARS["X"], atol=0.6 / 3600)
    np.testing.assert_allclose(made["Y"], STARS["Y"], atol=0.6 / 3600)
    made, _ = gathered(caplog, files)  # the centre of the image is the pointing
    assert made.meta["RA"] == pytest.approx(CENTRE["RA"], abs=1.0 / 3600)
    assert made.meta["DEC"] == pytest.approx(CENTRE["DEC"], abs=1.0 / 3600)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"RADESYS": "XYZ"}, r"RADESYS: 'XYZ' is no reference system .*FK5"),
        ({"EQUINOX": "now"}, r"EQUINOX: 'now' is no year"),
        ({"RADESYS": "GAPPT"}, r"RADESYS: apparent places \(GAPPT\) need the time; give MJD"),
    ],
)
def test_systems_that_are_none_are_refused(words, message, tmp_path):
    with pytest.raises(DataError, match=message):
        walop.gather(files_with(tmp_path, {**CENTRE, **words}))


def test_frames_of_headers():
    """FITS standard 4.0, section 8.3.1: FK4 before 1984 where RADESYS is absent, ICRS where both are."""
    place = Place("x", "")
    assert frame_of({}, place) == Frame()
    assert frame_of({"EQUINOX": 1975}, place) == Frame("FK4", 1975.0)
    assert frame_of({"EQUINOX": 2000.0}, place).is_icrs
    assert frame_of({"RADECSYS": "FK4"}, place) == Frame("FK4", 1950.0)
    assert frame_of({"EPOCH": 2016.0}, place) == Frame()  # of a table of Gaia: the time of its places
    assert frame_of({"EPOCH": 1950.0, "CTYPE1": "RA---TAN"}, place) == Frame("FK4", 1950.0)


@pytest.mark.parametrize(
    ("off", "said"),
    [
        ({"RA": 0.25 / 60, "DEC": 0.25 / 60}, "apart; which one is wrong"),
        ({"ROTATOR": 1.0}, "ROTATOR 36 deg as stated, axis x of the image at 3"),
        ({"ROTATOR": -70.0}, "70 deg apart"),
        ({}, ""),
    ],
)
def test_a_pointing_that_contradicts_the_wcs_is_said(off, said, tmp_path, caplog):
    header = wcs_in("icrs", {})
    header.update({name: value + off.get(name, 0.0) for name, value in CENTRE.items()})
    rng = np.random.default_rng(5)
    files = [ldac(tmp_path / f"{c}.fits", of_camera(STARS, k, rng), header) for k, c in enumerate(CAMERAS)]
    _, told = gathered(caplog, files)
    assert said in told
    assert ("by its WCS" in told) == bool(off)


def test_stars_without_a_position_are_left_out_and_named(tmp_path, caplog):
    def lose(k, columns):
        columns["ALPHA_J2000"][np.isin(columns["SOURCE_ID"], STARS["SOURCE_ID"][[3, 5]])] = np.nan

    made, said = gathered(caplog, files_with(tmp_path, CENTRE, change=lose))
    assert len(made) == len(STARS) - 2
    assert "ALPHA_J2000, DELTA_J2000 is not finite in rows" in said
    assert "these stars are left out" in said
    with pytest.raises(DataError, match="is finite in no row"):
        walop.gather(files_with(tmp_path, CENTRE, change=lambda k, c: c["DELTA_J2000"].fill(np.nan)))


def test_neighbours_and_blends_are_used_and_marked_unless_it_is_asked_for(tmp_path, caplog):
    """Bits 1 and 2 of SExtractor: a fifth of a crowded field; 4 (saturated) is no matter of taste."""

    def crowd(k, columns):
        order = np.argsort(columns["SOURCE_ID"])
        columns["FLAGS"][order[:12]] = 3 if k < 2 else 2
        columns["FLAGS"][order[12]] = 4

    files = files_with(tmp_path, CENTRE, change=crowd)
    made, said = gathered(caplog, files)
    assert "FLAGS: of 60 stars 12 have a bright neighbour (bit 1) and 12 were deblended (bit 2): used" in said
    assert "--drop-blends" in said
    assert np.flatnonzero(made["BLENDED"]).tolist() == list(range(12))
    assert np.flatnonzero(made["N_FLAG"].any(axis=1)).tolist() == [12]
    made, said = gathered(caplog, files, drop_blends=True)
    assert np.flatnonzero(made["N_FLAG"].all(axis=1)).tolist() == list(range(13))
    assert "left out" in said


def test_stars_in_another_spelling_of_the_filter_are_of_it(calibration, caplog):
    stars = walop.simulate(seed=3, stars=20)
    whole = walop.apply(calibration, stars)
    stars["FILTER"] = "sdss r"
    caplog.clear()
    with caplog.at_level("WARNING", logger="walop_jax"):
        made = walop.apply(calibration, stars)
    assert "FILTER 'sdss r' is taken as 'SDSS-r'" in caplog.text
    np.testing.assert_array_equal(made["Q"], whole["Q"])


def test_a_night_that_cannot_be_is_named_in_catalogues_and_tables(tmp_path, caplog, calibration):
    _, said = gathered(caplog, files_with(tmp_path, {**CENTRE, "MJD": 40587.0, "TEMP": 85.0}))
    assert "MJD is 40587 in row 0 (counted from 0): a clock that was not set (1970)?" in said
    assert "TEMP is 85 Celsius" in said
    stars = walop.simulate(seed=3, stars=20)
    stars["MJD"], stars["N"][:5, 1] = 40587.0, 4e6
    caplog.clear()
    with caplog.at_level("WARNING", logger="walop_jax"):
        walop.apply(calibration, stars)
    assert "MJD is 40587" in caplog.text
    assert "N is exactly 4000000, the largest, in rows 0, 1, 2, 3, 4 (counted from 0) of E1" in caplog.text


def test_stars_without_a_place_in_a_table_have_no_result_and_are_named(calibration, caplog):
    stars = walop.simulate(seed=3, stars=30)
    whole = walop.apply(calibration, stars)
    spoilt = stars.copy()
    spoilt["X"][[4, 17]] = np.nan
    caplog.clear()
    with caplog.at_level("WARNING", logger="walop_jax"):
        made = walop.apply(calibration, spoilt)
    assert "X or Y is not finite in rows 4, 17 (counted from 0): these rows are left out" in caplog.text
    assert np.flatnonzero(~np.isfinite(made["Q"])).tolist() == [4, 17]
    others = np.setdiff1d(np.arange(30), [4, 17])
    np.testing.assert_allclose(made["Q"][others], whole["Q"][others], atol=1e-12)
    assert units.Unit("deg") == stars["X"].unit

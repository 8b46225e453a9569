"""Four catalogues of cameras become one: formats, names, flags, positions, and inputs that cannot be meant."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
from astropy import units
from astropy.table import QTable, Table, vstack
from astropy.wcs import WCS
from camera_files import CAMERAS, CENTRE, ascii_head, four, ldac, of_camera, photutils, some_stars

import walop_jax as walop
from walop_jax.data.camera_catalogues import read_camera_catalogue, read_map
from walop_jax.io.errors import DataError
from walop_jax.sky.directions import Pointing

POINTING = {name.lower(): value for name, value in CENTRE.items()}
STARS = some_stars()


def by_source(table) -> Table:
    table = table.copy()
    table.sort("SOURCE_ID")
    return table


def remarks(caplog, *args, **options):
    with caplog.at_level("WARNING", logger="walop_jax"):
        made = walop.gather(*args, **options)
    return made, "\n".join(record.message for record in caplog.records)


@pytest.mark.parametrize("write", [ldac, ascii_head, photutils])
def test_every_format_gives_the_same_stars(write, tmp_path):
    made = by_source(walop.gather(four(STARS, tmp_path, write), **({} if write is ldac else POINTING)))
    assert made["SOURCE_ID"].tolist() == STARS["SOURCE_ID"].tolist()
    np.testing.assert_allclose(made["N"], STARS["N"], rtol=1e-12)
    np.testing.assert_allclose(made["N_ERR"], STARS["N_ERR"], rtol=1e-12)
    np.testing.assert_allclose(made["BP_RP"], STARS["BP_RP"])
    for name in "XY":  # 0.1 arcsec of scatter, the mean of four
        assert 3600 * np.std(made[name] - STARS[name]) == pytest.approx(0.05, rel=0.15)
    assert np.ptp(made["ROTATOR"]) > 0.3  # at each star: meridians converge
    assert (made.meta["RA"], made.meta["ROTATOR"]) == (CENTRE["RA"], CENTRE["ROTATOR"])
    assert all(made[name].description for name in made.colnames)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"RA": CENTRE["RA"] / 15.0}, "is RA in hours?"),
        ({"DEC": -CENTRE["DEC"]}, "has DEC lost its sign?"),
        ({"RA": CENTRE["RA"] / 15.0, "DEC": -CENTRE["DEC"]}, "is RA in hours, and has DEC lost its sign?"),
        ({"RA": 200.0}, "is it of another field?"),
    ],
)
def test_a_centre_far_from_its_stars_is_told_what_would_put_it_among_them(wrong, words, tmp_path):
    with pytest.raises(DataError, match=r"from the field centre") as caught:
        walop.gather(four(STARS, tmp_path, words={**CENTRE, **wrong}))
    assert words in str(caught.value)


def test_a_shifted_and_rotated_camera_is_named_and_put_right(tmp_path, caplog):
    files = four(STARS, tmp_path)
    moved = STARS.copy()
    turn = np.deg2rad(3.0 / 60.0)
    x = np.cos(turn) * STARS["X"] - np.sin(turn) * STARS["Y"] + 20.0 / 3600
    y = np.sin(turn) * STARS["X"] + np.cos(turn) * STARS["Y"] - 5.0 / 3600
    moved["RA"], moved["DEC"] = Pointing(**POINTING).sky_of(np.asarray(x), np.asarray(y))
    for k, name in ((1, "E1"), (0, "O1")):  # the first camera is no better than others
        files[k].unlink()
        ldac(files[k], of_camera(moved, k, np.random.default_rng(0)))
        caplog.clear()
        made, said = remarks(caplog, files)
        assert re.search(
            rf"{name} is shifted by \+(19|20).\d and -(4|5).\d arcsec .* rotated by \+3.?0? arcmin", said
        )
        assert said.count("is shifted") == 1
        np.testing.assert_allclose(by_source(made)["X"], STARS["X"], atol=0.5 / 3600)
        files[k].unlink()
        ldac(files[k], of_camera(STARS, k, np.random.default_rng(0)))


def test_a_wcs_that_is_off_by_ten_minutes_and_another_field_are_refused(tmp_path):
    files = four(STARS, tmp_path)
    shifted = STARS.copy()
    shifted["DEC"] = STARS["DEC"] + 10.0 / 60.0
    files[2].unlink()
    ldac(files[2], of_camera(shifted, 2, np.random.default_rng(0)))
    with pytest.raises(
        DataError, match=r"O2.fits.*no stars in common with .*O1.fits within 5 arcmin.*10 arcmin apart"
    ):
        walop.gather(files)
    with pytest.raises(
        DataError, match=r"O1.fits.*stars lie 16.* deg from the field centre RA 97.5, DEC -60"
    ):
        walop.gather(files, dec=-60.0)
    other = some_stars(seed=9)
    files[2].unlink()
    ldac(files[2], of_camera(other, 2, np.random.default_rng(0)))
    with pytest.raises(DataError, match=r"O2.fits.*no stars in common"):
        walop.gather(files)


def test_half_of_the_stars_missing_in_one_camera_is_said(tmp_path, caplog):
    files = four(STARS, tmp_path)
    files[3].unlink()
    ldac(files[3], of_camera(STARS, 3, np.random.default_rng(0), keep=np.arange(300) % 2 == 0))
    made, said = remarks(caplog, files)
    assert "E2 lacks 150 of the 300 stars" in said
    assert np.isnan(made["N"]).sum(axis=0).tolist() == [0, 0, 0, 150]
    assert len(made) == 300


def test_stars_that_two_cameras_see_are_left_out_and_close_ones_are_marked(tmp_path, caplog):
    close = STARS.copy()
    close["DEC"][1], close["RA"][1] = close["DEC"][0] + 0.7 / 3600, close["RA"][0]
    keep = np.arange(300) != 7
    rng = np.random.default_rng(2)
    files = [
        ldac(tmp_path / f"{name}.fits", of_camera(close, k, rng, 0.05, keep if k > 1 else None))
        for k, name in enumerate(CAMERAS)
    ]
    made, said = remarks(caplog, files)
    assert "1 stars that too few cameras see are left out of 300" in said
    assert "2 stars have two candidates within 1 arcsec" in said
    made = by_source(made)
    assert made["N_FLAG"][:2].tolist() == [[8] * 4] * 2
    assert not made["N_FLAG"][2:].any()
    np.testing.assert_allclose(made["N"][:2], STARS["N"][:2])


def test_flags_are_those_of_the_package_and_others_are_refused(tmp_path):
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    columns["FLAGS"][:6] = [3, 4, 8, 16, 32, 5]
    one = read_camera_catalogue(ldac(tmp_path / "a.fits", columns), drop_blends=True)
    assert one.flag[:7].tolist() == [8, 1, 4, 2, 0, 9, 0]
    columns["FLAGS"][3] = 1024
    with pytest.raises(DataError, match=r"FLAGS: is 1024 in row 3 .*no flag of SExtractor; .*--columns"):
        read_camera_catalogue(ldac(tmp_path / "b.fits", columns))
    del columns["FLAGS"]
    columns["MASK_FLAG"] = np.zeros(300, int)
    said = "; ".join(read_camera_catalogue(ldac(tmp_path / "c.fits", columns)).remarks)
    assert "no flags of the stars" in said
    assert "MASK_FLAG: flags are read from" in said


def test_truth_values_of_flags_name_no_cause(tmp_path):
    """The bit 1 of SExtractor is a neighbour (8); a column that is true says only that a star is not to be used."""
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    columns["FLAGS"] = np.arange(300) == 3
    catalogue = read_camera_catalogue(ldac(tmp_path / "a.fits", columns))
    assert np.flatnonzero(catalogue.flag).tolist() == [3]
    assert catalogue.flag[3] == 2
    assert "FLAGS holds truth values: true is taken as a bad pixel" in catalogue.remarks


def test_right_ascensions_in_hours_are_converted_once(tmp_path):
    """1 h is 15°, a number that could itself be hours."""
    columns = {
        "ALPHA_J2000": [1.0, 1.1] * units.hourangle, "DELTA_J2000": [-44.0, -44.1] * units.deg,
        "FLUX_AUTO": [1e5, 2e5], "FLUXERR_AUTO": [300.0, 400.0], "FLAGS": [0, 0],
    }  # fmt: skip
    QTable(columns).write(tmp_path / "O1.ecsv")
    assert read_camera_catalogue(tmp_path / "O1.ecsv").ra == pytest.approx([15.0, 16.5])


def _hours(tmp_path, ra, unit=None, count=40):
    rng = np.random.default_rng(3)
    columns = {
        "RAJ2000": ra(6.5 + rng.uniform(-0.02, 0.02, count)), "DEJ2000": rng.uniform(-44.3, -43.7, count),
        "FLUX_AUTO": np.full(count, 1e5), "FLUXERR_AUTO": np.full(count, 300.0), "FLAGS": np.zeros(count, int),
    }  # fmt: skip
    table = Table(columns)
    table["RAJ2000"].unit = unit
    names = tmp_path / "names.toml"
    names.write_text(
        'program = "mine"\nflux = [["FLUX_AUTO", "FLUXERR_AUTO"]]\nsky = [["RAJ2000", "DEJ2000"]]\n'
        'flag = ["FLAGS"]\n'
    )
    table.write(tmp_path / "O1.ecsv", overwrite=True)
    return table, lambda: read_camera_catalogue(tmp_path / "O1.ecsv", names)


def test_right_ascensions_in_hours_without_a_unit_are_refused(tmp_path):
    """A field of half a degree at 6.5 h is 0.04 h wide: read as degrees it would be a strip."""
    _, read = _hours(tmp_path, lambda hours: hours)
    with pytest.raises(DataError, match=r"RAJ2000: lies between 6.48.* looks like hours; .*multiply by 15"):
        read()
    table, read = _hours(tmp_path, lambda hours: hours, "hourangle")
    assert read().ra == pytest.approx(15.0 * np.asarray(table["RAJ2000"]))
    table, read = _hours(tmp_path, lambda hours: 15.0 * (hours - 6.0))  # at 7.5 deg: a field, not a strip
    assert read().ra == pytest.approx(np.asarray(table["RAJ2000"]))
    _, read = _hours(tmp_path, lambda hours: hours, count=4)
    assert "RAJ2000 has no unit: taken as degrees" in "; ".join(read().remarks)


def test_sexagesimal_right_ascensions_are_hours_and_declinations_degrees(tmp_path):
    columns = {
        "ra": ["06:30:00", "06 30 36.0", "6h31m12s"], "dec": ["-44:00:00", "-00:30:00", "-44d06m00s"],
        "FLUX_AUTO": [1e5] * 3, "FLUXERR_AUTO": [300.0] * 3, "FLAGS": [0] * 3,
    }  # fmt: skip
    Table(columns).write(tmp_path / "O1.ecsv")
    made = read_camera_catalogue(tmp_path / "O1.ecsv")
    np.testing.assert_allclose(made.ra, [97.5, 97.65, 97.8], atol=1e-9)
    np.testing.assert_allclose(made.dec, [-44.0, -0.5, -44.1], atol=1e-9)
    columns["ra"][1] = "06:75:00"
    Table(columns).write(tmp_path / "O1.ecsv", overwrite=True)
    with pytest.raises(DataError, match=r"RA: .*write hh:mm:ss"):
        read_camera_catalogue(tmp_path / "O1.ecsv")


# PSF_FLAGS of photutils 3.0; with them bits of FLAG: 2 a bad pixel, 4 the edge.
PSF_FLAGS = {
    "n_pixels_fit_partial": (1, 2), "outside_bounds": (2, 4), "negative_flux": (4, 2), "no_convergence": (8, 2),
    "no_covariance": (16, 2), "near_bound": (32, 2), "no_overlap": (64, 4), "fully_masked": (128, 2),
    "too_few_pixels": (256, 2), "non_finite_position": (512, 2), "non_finite_flux": (1024, 2),
    "non_finite_localbkg": (2048, 2),
}  # fmt: skip


def test_flags_of_point_spread_functions_of_photutils(tmp_path):
    given, meaning = np.array([*PSF_FLAGS.values(), (0, 0), (64 + 1024, 6)]).T
    count = len(given)
    columns = {
        "ra": np.linspace(97.4, 97.6, count), "dec": np.linspace(-44.1, -43.9, count), "flags": given,
        "flux_fit": np.full(count, 1e5), "flux_err": np.full(count, 300.0),
    }  # fmt: skip
    Table(columns).write(tmp_path / "a.ecsv")
    assert read_camera_catalogue(tmp_path / "a.ecsv").flag.tolist() == meaning.tolist()
    columns["flags"] = given * 4096
    Table(columns).write(tmp_path / "b.ecsv")
    with pytest.raises(DataError, match="no flag of photutils"):
        read_camera_catalogue(tmp_path / "b.ecsv")


@pytest.mark.parametrize("error", ["kron_flux_err", "kron_fluxerr"])  # photutils 3.0, and before
def test_fluxes_of_the_source_catalogue_of_photutils(error, tmp_path):
    columns = {"ra": [97.5, 97.6], "dec": [-44.0, -44.1], "kron_flux": [1e5, 2e5], error: [3e2, 4e2]}
    Table(columns).write(tmp_path / "a.ecsv")
    made = read_camera_catalogue(tmp_path / "a.ecsv")
    assert (made.flux.tolist(), made.error.tolist()) == ([1e5, 2e5], [3e2, 4e2])


def test_magnitudes_are_refused_whatever_their_name(tmp_path):
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    columns["MAG_AUTO"] = 25.0 - 2.5 * np.log10(columns.pop("FLUX_AUTO"))
    columns["MAGERR_AUTO"] = 0.01 * columns.pop("FLUXERR_AUTO") / columns["MAG_AUTO"]
    file = ldac(tmp_path / "a.fits", columns)
    with pytest.raises(
        DataError, match=r"has magnitudes and no fluxes with errors \(MAG_AUTO\); write FLUX_APER"
    ):
        read_camera_catalogue(file)
    own = tmp_path / "own.toml"
    own.write_text(
        'program = "mine"\nflux = [["MAG_AUTO", "MAGERR_AUTO"]]\nsky = [["ALPHA_J2000", "DELTA_J2000"]]\n'
    )
    with pytest.raises(DataError, match=r"MAG_AUTO: lies between .* these are magnitudes"):
        read_camera_catalogue(file, own)


def test_a_map_of_ones_own_with_an_aperture_of_several(tmp_path):
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    flux, error = columns.pop("FLUX_AUTO"), columns.pop("FLUXERR_AUTO")
    columns["FLUX_APER"], columns["FLUXERR_APER"] = (
        np.stack([0.5 * flux, flux], 1),
        np.stack([error, error], 1),
    )
    columns["QUALITY"] = columns.pop("FLAGS") + 2
    file = ldac(tmp_path / "a.fits", columns)
    with pytest.raises(DataError, match=r"FLUX_APER: has 2 apertures; name it .*FLUX_APER\[1\]"):
        read_camera_catalogue(file)
    own = tmp_path / "own.toml"
    own.write_text(
        'program = "mine"\nflux = [["FLUX_APER[2]", "FLUXERR_APER[2]"]]\nflag = ["QUALITY"]\n'
        'sky = [["ALPHA_J2000", "DELTA_J2000"]]\n[bits]\n2 = 0\n'
    )
    one = read_camera_catalogue(file, own, gain=2.0)
    np.testing.assert_allclose(one.flux, 2.0 * flux)
    np.testing.assert_allclose(one.error, 2.0 * error)
    assert not one.flag.any()


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ('flux = [["A", "B"]]', "program is missing"),
        ('program = "x"', "flux is missing"),
        ('program = "x"\nflux = ["A"]', "must be a list of names"),
        ('program = "x"\nflux = [["A", "B"]]\nsyk = [["C", "D"]]', "did you mean 'sky'"),
        ('program = "x"\nflux = [["A", "B"]]\n[bits]\n3 = 1', "'3' is no single bit"),
        ('program = "x"\nflux = [["A", "B"]]\n[bits]\n4 = 3', "give a bit of FLAG"),
        ('program = "x', "x.toml"),
    ],
)
def test_a_map_that_is_wrong_is_refused(text, what, tmp_path):
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(DataError, match=re.escape(what)):
        read_map(tmp_path / "x.toml")


def test_pixels_go_to_the_sky_by_the_wcs_of_the_image_which_gives_the_pointing_too(tmp_path, caplog):
    plane = WCS(naxis=2)
    plane.wcs.ctype, plane.wcs.crval, plane.wcs.crpix = (
        ["RA---TAN", "DEC--TAN"],
        [97.5, -44.0],
        [1000.5, 1000.5],
    )
    r = np.deg2rad(35.0)
    plane.wcs.cd = 0.3 / 1000 * np.array([[np.sin(r), np.cos(r)], [np.cos(r), -np.sin(r)]])
    header = {**plane.to_header(), "NAXIS1": 2000, "NAXIS2": 2000}
    files = []
    for k, name in enumerate(CAMERAS):
        columns = of_camera(STARS, k, np.random.default_rng(k))
        x, y = plane.wcs_world2pix(columns.pop("ALPHA_J2000"), columns.pop("DELTA_J2000"), 1)
        columns["X_IMAGE"], columns["Y_IMAGE"] = x * units.pix, y * units.pix  # as SExtractor states it
        files.append(ldac(tmp_path / f"{name}.fits", columns, header))
    with pytest.raises(DataError, match="neither ALPHAWIN_J2000"):
        read_camera_catalogue(ascii_head(tmp_path / "x.cat", columns))
    made, said = remarks(caplog, files)
    assert "RA 97.5, DEC -44, ROTATOR 35 deg from the WCS" in said
    np.testing.assert_allclose(by_source(made)["X"], STARS["X"], atol=0.5 / 3600)
    np.testing.assert_allclose(by_source(made)["Y"], STARS["Y"], atol=0.5 / 3600)


def test_unknown_colours_are_named(tmp_path):
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    for name in ("T_EFF", "BP-RP", "g-r", "COLOR"):
        columns[name] = columns["BP_RP"]
    del columns["BP_RP"]
    said = "; ".join(read_camera_catalogue(ldac(tmp_path / "a.fits", columns)).remarks)
    for name in ("T_EFF", "BP-RP", "G-R", "COLOR"):
        assert f"{name}: the colour of a star is read from TEFF (K) or BP_RP" in said


def test_a_table_of_gaia_says_who_the_stars_are(tmp_path, caplog):
    known = STARS["RA", "DEC", "SOURCE_ID", "BP_RP"][:280]
    known["PHOT_G_MEAN_MAG"] = 25 - 2.5 * np.log10(STARS["N"][:280].sum(axis=1))
    known["parallax"] = 1.5
    bare = STARS["RA", "DEC", "N", "N_ERR"]
    bare["DEC"] = bare["DEC"] + 4.0 / 3600
    made, said = remarks(caplog, four(bare, tmp_path), gaia=known)
    assert "280 of 300 stars are in" in said
    assert re.search(r"all cameras are shifted by .* arcsec along X and Y against", said)
    named = made["SOURCE_ID"] > 0
    assert named.sum() == 280
    assert set(made["SOURCE_ID"][named].tolist()) == set(known["SOURCE_ID"].tolist())
    assert np.all(made["PARALLAX"][named] == 1.5)
    assert made["PARALLAX"].unit == "mas"


def test_the_number_of_catalogues_and_a_missing_pointing_are_said(tmp_path):
    files = four(STARS, tmp_path, ascii_head)
    with pytest.raises(
        ValueError, match="3 catalogues for the 4 cameras of WALOP-SOUTH: give those of O1, E1, O2, E2"
    ):
        walop.gather(files[:3])
    with pytest.raises(
        DataError, match=r"has no RA and no DEC and no ROTATOR .* give --ra … --dec … --rotator …"
    ):
        walop.gather(files)


def rewritten(files, k, change, words=CENTRE):
    """The catalogue of a camera, changed."""
    columns = of_camera(STARS, k, np.random.default_rng(k))
    change(columns)
    files[k].unlink()
    ldac(files[k], columns, words)


def test_a_catalogue_that_is_given_twice_or_in_the_wrong_place_is_refused(tmp_path):
    """Two cameras with the same fluxes, and the ordinary beams before the extraordinary ones: both give wrong q, u."""
    files = four(STARS, tmp_path)
    copy = shutil.copy(files[0], tmp_path / "copy.fits")
    with pytest.raises(DataError, match=r"copy.fits: has the fluxes of .*O1.fits: it is the same catalogue"):
        walop.gather([files[0], copy, *files[2:]])
    with pytest.raises(
        ValueError, match=r"O2.fits is given in the place of camera E1: the order is O1, E1, O2, E2"
    ):
        walop.gather([files[0], files[2], files[1], files[3]])


def test_catalogues_of_different_exposures_are_refused(tmp_path):
    files = four(STARS, tmp_path)
    for k, mjd in enumerate((61000.1, 61000.1001, 61000.1, 61000.1)):
        rewritten(files, k, lambda columns: None, {**CENTRE, "MJD": mjd})
    assert np.all(walop.gather(files)["MJD"] == 61000.1)
    rewritten(files, 3, lambda columns: None, {**CENTRE, "MJD": 61000.2})
    with pytest.raises(
        DataError,
        match=r"MJD is 61000.1 \(.*O1.fits\) and 61000.1001 .* and 61000.2 \(.*\) in catalogues of one exp",
    ):
        walop.gather(files)
    for k, temperature in enumerate((10.0, 10.1, 10.0, 9.9)):  # of sensors beside each other
        rewritten(files, k, lambda columns: None, {**CENTRE, "TEMP": temperature})
    assert np.all(walop.gather(files)["TEMP"] == 10.0)
    rewritten(files, 3, lambda columns: None, {**CENTRE, "TEMP": "cold"})
    with pytest.raises(DataError, match=r"TEMP is 10.0 .* and cold \(.*E2.fits\) in catalogues of one"):
        walop.gather(files)


def test_fluxes_in_different_apertures_are_refused(tmp_path):
    files = four(STARS, tmp_path)
    rewritten(files, 2, lambda c: c.update(FLUX_APER=c.pop("FLUX_AUTO"), FLUXERR_APER=c.pop("FLUXERR_AUTO")))
    with pytest.raises(DataError, match=r"different fluxes: FLUX_AUTO \(.*\) and FLUX_APER \(.*O2.fits\)"):
        walop.gather(files)


@pytest.mark.parametrize("count", [1, 2])
def test_a_field_with_one_or_two_stars(count, tmp_path):
    """A bright standard in a short exposure: nothing to register by."""
    made = walop.gather(four(STARS[:count], tmp_path))
    np.testing.assert_allclose(by_source(made)["N"], STARS["N"][:count])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"RA": "06:30:00.0", "DEC": "-44:00:00.0", "ROTATOR": 35.0}, ""),
        ({"RA": "97.5", "DEC": "-44", "ROTATOR": "35"}, ""),
        ({**CENTRE, "ROTATOR": "north up"}, r"\[header\] ROTATOR: 'north up' is no angle; give --rotator"),
        ({**CENTRE, "DEC": -444.0}, "DEC of the field centre is -444 deg; at most 90 deg"),
    ],
)
def test_the_pointing_of_a_header(words, message, tmp_path):
    files = four(STARS, tmp_path)
    for k in range(4):
        rewritten(files, k, lambda columns: None, words)
    if message:
        with pytest.raises(DataError, match=message):
            walop.gather(files)
    else:
        assert walop.gather(files).meta["RA"] == pytest.approx(97.5, abs=1e-9)


@pytest.mark.parametrize("option", ["gain", "tolerance"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_numbers_that_are_none_are_refused(option, value, tmp_path):
    with pytest.raises(ValueError, match=f"{option} = .* must be a number above 0"):
        walop.gather(four(STARS[:3], tmp_path), **{option: value})


def test_identifiers_in_floats_are_refused(tmp_path):
    """Neighbouring floats are 1024 apart where identifiers of Gaia are."""
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    columns["SOURCE_ID"] = columns["SOURCE_ID"].astype(float)
    with pytest.raises(DataError, match=r"SOURCE_ID: is a float beyond 2\*\*53"):
        read_camera_catalogue(ldac(tmp_path / "a.fits", columns))
    columns["SOURCE_ID"] = np.arange(300.0)
    assert read_camera_catalogue(ldac(tmp_path / "b.fits", columns)).of_stars["SOURCE_ID"][7] == "7"


def test_columns_of_stars_that_are_rounded_in_one_camera_agree(tmp_path, caplog):
    files = four(STARS, tmp_path)
    rewritten(files, 1, lambda columns: columns.update(BP_RP=columns["BP_RP"].round(3)))
    made, text = remarks(caplog, files)
    assert "BP_RP" not in text
    assert np.isfinite(made["BP_RP"]).all()


def test_flags_that_are_empty_are_remarked_on(tmp_path):
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    columns["FLAGS"] = np.where(np.arange(300) < 5, np.nan, 0.0)
    text = "; ".join(read_camera_catalogue(ldac(tmp_path / "a.fits", columns)).remarks)
    assert "FLAGS is empty in 5 rows: taken as good" in text


def test_the_background_of_every_camera_is_the_level_of_the_sky(tmp_path):
    files = four(STARS, tmp_path)
    for k in range(4):
        rewritten(files, k, lambda columns, k=k: columns.update(BACKGROUND=np.full(300, 40.0 + k)))
    made = walop.gather(files, gain=2.0)
    np.testing.assert_allclose(made["SKY"][0], [80.0, 82.0, 84.0, 86.0])
    rewritten(files, 1, lambda columns: None)
    with pytest.raises(DataError, match="SKY: only some cameras have a level of the sky"):
        walop.gather(files)


def test_words_of_the_header_of_an_observatory(tmp_path):
    """Begin of the exposure and its length, a filter by number, a pointing in sexagesimal texts."""
    files = four(STARS, tmp_path)
    header = {
        "DATE-OBS": "2026-11-26T01:00:00", "EXPTIME": 240.0, "FILTNUM": 3, "IMAGETYP": "SCIENCE",
        "TELRA": "06:30:00", "TELDEC": "-44:00:00", "PA": 35.0,
    }  # fmt: skip
    for k in range(4):
        rewritten(files, k, lambda columns: None, header)
    words = tmp_path / "words.toml"
    words.write_text(
        '[KIND]\nword = "IMAGETYP"\nvalues = { MOON = "moon" }\n'
        '[MJD]\nword = "DATE-OBS"\nexpression = "x + EXPTIME / 2 / 86400"\n[EXPTIME]\nword = "EXPTIME"\n'
        '[FILTER]\nword = "FILTNUM"\nvalues = { "3" = "NB-660" }\n'
        '[RA]\nword = "TELRA"\nunit = "hourangle"\n[DEC]\nword = "TELDEC"\nunit = "deg"\n[ROTATOR]\nword = "PA"\n'
    )
    made = walop.gather(files, words=words)
    assert set(made["FILTER"]) == {"NB-660"}
    assert made["MJD"][0] == pytest.approx(61370.0 + (3600 + 120) / 86400, abs=1e-9)
    assert made.meta["RA"] == pytest.approx(97.5)
    assert np.max(np.abs(by_source(made)["X"] - STARS["X"])) < 0.5 / 3600


def test_a_text_without_names_of_columns_is_told_from_a_catalogue(tmp_path):
    (tmp_path / "O1.cat").write_text("1 97.5 -44.0 1000.0 30.0\n")
    with pytest.raises(DataError, match=r"neither as ASCII_HEAD nor as FITS_LDAC .*CATALOG_TYPE"):
        read_camera_catalogue(tmp_path / "O1.cat")


@pytest.mark.parametrize(
    ("units_of", "gain", "factor", "message"),
    [
        (("electron", ""), None, 1.0, None),
        (("", "electron"), None, 1.0, None),
        (("ADU", "ct"), 2.0, 2.0, None),
        (("kct", "kct"), None, 1e3, None),
        (("electron", "electron"), 2.0, 1.0, "is in electrons: the gain is not used"),
        (("electron", "ct"), 2.0, None, "FLUXERR_AUTO: is in ct, FLUX_AUTO in electron; give both in"),
        (("ct / s", "ct / s"), None, None, "multiply by the exposure time"),
        (("Jy", "Jy"), None, None, "the unit 'Jy' cannot be converted to 'ct'"),
        (("mag", "mag"), None, None, r"is logarithmic \(mag\); counts in electrons are needed"),
    ],
)
def test_units_of_fluxes_and_errors(tmp_path, units_of, gain, factor, message):
    columns = Table(of_camera(STARS, 0, np.random.default_rng(0)))
    for name, unit in zip(("FLUX_AUTO", "FLUXERR_AUTO"), units_of, strict=True):
        columns[name].unit = unit or None
    columns.write(tmp_path / "a.ecsv")
    if factor is None:
        with pytest.raises(DataError, match=message):
            read_camera_catalogue(tmp_path / "a.ecsv", gain=gain)
        return
    read = read_camera_catalogue(tmp_path / "a.ecsv", gain=gain)
    np.testing.assert_allclose(read.flux, factor * columns["FLUX_AUTO"], rtol=1e-12)
    np.testing.assert_allclose(read.error, factor * columns["FLUXERR_AUTO"], rtol=1e-12)
    assert message is None or message in "; ".join(read.remarks)


@pytest.mark.parametrize(
    ("unit", "gain", "factor"),
    [
        ("", 2.0, 2.0),
        ("kct", 2.0, 2e3),
        ("ct / pixel", 2.0, 2.0),
        ("electron", 2.0, None),
        ("electron", None, None),
    ],
)
def test_units_of_the_level_of_the_sky(tmp_path, unit, gain, factor):
    """The level is in counts or in electrons as the fluxes are, in a unit of its own."""
    columns = Table(of_camera(STARS, 0, np.random.default_rng(0)))
    columns["BACKGROUND"] = np.full(len(columns), 40.0)
    columns["BACKGROUND"].unit = unit or None
    for name in ("FLUX_AUTO", "FLUXERR_AUTO"):
        columns[name].unit = "ct"
    columns.write(tmp_path / "a.ecsv")
    if factor is None:
        with pytest.raises(
            DataError, match="BACKGROUND: is in electron, FLUX_AUTO in ct; give both in counts"
        ):
            read_camera_catalogue(tmp_path / "a.ecsv", gain=gain)
    else:
        read = read_camera_catalogue(tmp_path / "a.ecsv", gain=gain)
        np.testing.assert_allclose(read.sky, 40.0 * factor, rtol=1e-12)


def test_rows_that_are_there_twice_are_one_star(tmp_path):
    """All rows of all cameras: no star is ambiguous, none is lost."""
    made = by_source(walop.gather(four(vstack([STARS, STARS]), tmp_path, scatter=0.0)))
    np.testing.assert_allclose(made["N"], STARS["N"], rtol=1e-12)
    assert not made["N_FLAG"].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["FLUX_AUTO"].__imul__(-1.0), "300 of 300 fluxes are below 0 by more than 5 errors"),
        (lambda c: c["FLUX_AUTO"].__setitem__(3, np.inf), "1 of 300 fluxes are not finite, or have no error"),
        (
            lambda c: c.update(PHOT_BP_MEAN_MAG=c.pop("BP_RP")),
            "PHOT_BP_MEAN_MAG: the colour of a star is read",
        ),
        (
            lambda c: c.update(GaiaDR3=c.pop("SOURCE_ID")),
            "GAIADR3: the identity of a star is read from SOURCE_ID",
        ),
        (lambda c: c.update(gaia_source_id=c.pop("SOURCE_ID")), "GAIA_SOURCE_ID: the identity of a star"),
    ],
)
def test_what_is_odd_or_not_used_is_remarked_on(tmp_path, change, message):
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    change(columns)
    assert message in "; ".join(read_camera_catalogue(ldac(tmp_path / "a.fits", columns)).remarks)


def test_fluxes_without_any_error_are_refused(tmp_path):
    columns = of_camera(STARS, 0, np.random.default_rng(0))
    columns["FLUXERR_AUTO"] *= 0.0
    with pytest.raises(DataError, match="FLUXERR_AUTO: has no flux with an error above 0"):
        read_camera_catalogue(ldac(tmp_path / "a.fits", columns))


def test_columns_of_gaia_under_other_names_and_replaced_ones_are_named(tmp_path, caplog):
    known = STARS["RA", "DEC", "SOURCE_ID", "BP_RP"].copy()
    known["SOURCE_ID"] += 1
    known.rename_column("BP_RP", "BP-RP")
    made, said = remarks(caplog, four(STARS["RA", "DEC", "N", "N_ERR", "SOURCE_ID"], tmp_path), gaia=known)
    assert set(made["SOURCE_ID"].tolist()) == set(known["SOURCE_ID"].tolist())
    assert "SOURCE_ID of the cameras: replaced by those of" in said
    assert "BP-RP: the colour of a star is read from TEFF (K) or BP_RP" in said

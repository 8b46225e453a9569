"""RA and DEC of exposures and tables in another reference system than ICRS: converted, and said."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.coordinates import FK5, SkyCoord
from astropy.io import fits
from astropy.table import Table

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.header_words import exposures_table, of_header, words_of
from walop_jax.data.user_tables import in_memory, sky_positions

OF_DATE = {"RADESYS": "FK5", "EQUINOX": 2026.9}
TRUE = SkyCoord([97.5, 10.0], [-44.0, 20.0], unit="deg")
DATE = TRUE.transform_to(FK5(equinox="J2026.9"))
WORDS = words_of(
    {"KIND": {"value": "moon"}, "MJD": {"word": "MJD"}, "RA": {"word": "TELRA"}, "DEC": {"word": "TELDEC"}}
)


def test_precession_is_that_of_the_textbook():
    """m + n sin α tan δ of a year, 46.12 and 20.04 arcsec (Explanatory Supplement), 26.9 times: 0.200° in RA."""
    seconds = 26.9 * (46.12 + 20.04 * np.sin(np.deg2rad(97.5)) * np.tan(np.deg2rad(-44.0)))
    assert DATE.ra.deg[0] - 97.5 == pytest.approx(seconds / 3600, abs=0.002)


def test_words_of_headers(tmp_path):
    files = []
    for k in range(2):
        header = {"MJD": 61220.0 + k, "TELRA": DATE.ra.deg[k], "TELDEC": DATE.dec.deg[k], **OF_DATE}
        files.append(tmp_path / f"{k}.fits")
        fits.PrimaryHDU(header=fits.Header(header)).writeto(files[-1])
    table, remarks = exposures_table(files, WORDS)
    np.testing.assert_allclose(table["RA"], TRUE.ra.deg, atol=1e-5)
    np.testing.assert_allclose(table["DEC"], TRUE.dec.deg, atol=1e-5)
    assert "RA and DEC of 2 exposures are in FK5, equinox 2026.9: converted to ICRS" in remarks
    pointing = of_header(fits.getheader(files[0]), WORDS, ("RA", "DEC"), files[0])
    assert pointing["RA"] == pytest.approx(97.5, abs=1e-5)


def test_right_ascensions_that_a_file_of_words_states_are_icrs():
    fixed = words_of({"RA": {"value": 97.5}, "DEC": {"value": -44.0}})
    assert of_header(OF_DATE, fixed, ("RA", "DEC"), "x")["RA"] == 97.5


@pytest.mark.parametrize("extension", [0, "EXPOSURES"])
def test_exposures_of_a_set(extension, handmade):
    plain = read_calibration_set(handmade.write()).exposures
    path = handmade.write()
    with fits.open(path, mode="update") as opened:
        opened[extension].header.update(OF_DATE)
    read = read_calibration_set(path)
    known = np.isfinite(plain.ra)
    assert known.any()
    wanted = SkyCoord(plain.ra[known], plain.dec[known], unit="deg", frame=FK5(equinox="J2026.9")).icrs
    np.testing.assert_allclose(read.exposures.ra[known], wanted.ra.deg, atol=1e-9)
    np.testing.assert_allclose(read.exposures.dec[known], wanted.dec.deg, atol=1e-9)
    assert any(
        "[EXPOSURES] RA, DEC: are in FK5, equinox 2026.9: converted to ICRS" in r for r in read.remarks
    )


def test_tables_of_stars():
    table = Table({"RA": DATE.ra.deg, "DEC": DATE.dec.deg}, meta=OF_DATE)
    source = in_memory(table)
    ra, dec = sky_positions(source)
    np.testing.assert_allclose(ra, TRUE.ra.deg, atol=1e-5)
    np.testing.assert_allclose(dec, TRUE.dec.deg, atol=1e-5)
    assert any("RA, DEC are in FK5, equinox 2026.9" in remark for remark in source.remarks)

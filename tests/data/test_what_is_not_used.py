"""What is given and not used is said: curves, other spellings of filters, words of headers, keys of files of words."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import walop_jax as walop
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.header_words import exposures_table, words_of
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import same_filters
from walop_jax.data.user_tables import read_input_table
from walop_jax.io.errors import DataError

RED = np.linspace(0.60, 0.74, 60), np.exp(-(((np.linspace(0.60, 0.74, 60) - 0.67) / 0.03) ** 4))
"""A curve 50 nm redder than SDSS-r."""


def read(names, exposures="SDSS-r", **more):
    """A set in memory with one curve under several names."""
    counts = 1e5 * (1 + np.random.default_rng(1).random((2, 4, 4)))
    filters = {name: FilterCurve(name, *RED) for name in names}
    return walop.from_arrays(
        counts, np.sqrt(counts), x=[0.0, 0.1], y=[0.0, 0.0], angles=[0.0, 30.0, 60.0, 90.0],
        filter=exposures, filters=filters, **more,
    )  # fmt: skip


@pytest.mark.parametrize("spelled", ["sdss-r", "SDSS r", "SDSS_R", "sdssr"])
def test_a_curve_under_another_spelling_counts_before_the_built_in_one(spelled):
    made = read([spelled])
    np.testing.assert_array_equal(made.filters["SDSS-r"].wavelength, RED[0])
    assert list(made.filters) == ["SDSS-r"]
    assert set(made.exposures.filter) == {"SDSS-r"}
    assert any(f"the curve {spelled!r} is taken as that of SDSS-r" in remark for remark in made.remarks)
    np.testing.assert_array_equal(
        read(["SDSS-r"]).filters["SDSS-r"].throughput, made.filters["SDSS-r"].throughput
    )


def test_exposures_under_another_spelling_have_the_name_of_the_curve():
    made = read(["Halpha-656"], "HALPHA 656")
    assert set(made.exposures.filter) == {"Halpha-656"}
    assert any("FILTER: 'HALPHA 656' is taken as 'Halpha-656'" in remark for remark in made.remarks)
    built_in = read([], "sdss-r")
    assert set(built_in.exposures.filter) == {"SDSS-r"}


def test_what_is_not_one_name_is_not_taken_for_it():
    """r of SDSS is not R of Cousins; two curves that could be meant are an error."""
    assert same_filters("r", ["R", "V"]) == []
    assert same_filters("SDSS-r", ["sdss-r", "SDSS-r"]) == ["SDSS-r"]
    with pytest.raises(DataError, match="'R' is neither a row of FILTERS nor built in"):
        read(["r"], "R")
    with pytest.raises(
        DataError, match="'sdss-r' and 'sdss r' may be SDSS-r of EXPOSURES; rename all but one"
    ):
        read(["sdss-r", "sdss r"])


def test_a_curve_that_nothing_uses_is_named():
    made = read(["SDSS-r", "SDSS-i"])
    assert any(
        "[FILTERS] FILTER: the curve of SDSS-i is used by no exposure (FILTER is SDSS-r there)" in r
        for r in made.remarks
    )
    assert not any("used by no exposure" in remark for remark in read(["SDSS-r"]).remarks)


def test_sets_in_two_spellings_are_not_joined():
    first, second = read(["Halpha-656"], "Halpha-656"), read(["halpha 656"], "halpha 656")
    with pytest.raises(DataError, match="'halpha 656' is 'Halpha-656' in an earlier file"):
        merge_calibration_sets(first, second)


def test_words_of_headers_of_a_set_that_are_columns_are_named(handmade):
    path = handmade.write()
    with fits.open(path, mode="update") as opened:
        opened[0].header["FILTER"] = "SDSS-i"
        opened["EXPOSURES"].header["TEMP"] = 3.0
    remarks = read_calibration_set(path).remarks
    assert any("[PRIMARY] FILTER: = SDSS-i in the header is not used" in remark for remark in remarks)
    assert any("[EXPOSURES] TEMP: = 3.0 in the header is not used" in remark for remark in remarks)


def test_words_of_the_headers_of_a_table_that_are_asked_for_as_columns_are_named(tmp_path):
    table = fits.table_to_hdu(Table({"X": [0.0], "Y": [0.0]}))
    first = fits.PrimaryHDU()
    first.header["FILTER"], first.header["INSTRUME"] = "SDSS-i", "WALOP-NORTH"
    fits.HDUList([first, table]).writeto(tmp_path / "t.fits")
    source = read_input_table(tmp_path / "t.fits")
    assert source.table.meta["INSTRUME"] == "WALOP-NORTH"
    assert source.column("FILTER") is None
    assert "FILTER = SDSS-i of the header is not used: give a column FILTER" in source.about()
    table.header["INSTRUME"] = "WALOP-SOUTH"
    fits.HDUList([first, table]).writeto(tmp_path / "u.fits")
    with pytest.raises(
        DataError, match="INSTRUME: is WALOP-SOUTH in the header of the table and WALOP-NORTH in the"
    ):
        read_input_table(tmp_path / "u.fits")


def test_keys_of_words_that_do_not_fit_the_files_are_named(tmp_path):
    fits.PrimaryHDU(header=fits.Header({"MJD": 61220.0})).writeto(tmp_path / "a.fits")
    words = {"KIND": {"value": "moon"}, "MJD": {"word": "MJD"}}
    _, remarks = exposures_table([tmp_path / "a.fits"], words_of({**words, "rows": "data.exposures"}))
    assert "rows = 'data.exposures' of the words is not used: no file is JSON" in remarks
    (tmp_path / "a.csv").write_text("MJD\n61220\n")
    _, remarks = exposures_table([tmp_path / "a.csv"], words_of({**words, "extension": 1}))
    assert "extension = 1 of the words is not used: no file is FITS" in remarks

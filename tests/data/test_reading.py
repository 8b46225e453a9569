"""What a good file becomes: native arrays in the record's units, odd things remarked on."""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np
import pytest
from astropy.io import fits

from walop_jax.data.calset import from_arrays, read_calibration_set
from walop_jax.data.inspection import inspect
from walop_jax.data.records import DataFlag
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.io.errors import DataError

NAN = float("nan")


def test_good_set(handmade):
    path = handmade.write()
    calset = read_calibration_set(path)
    assert (calset.instrument, calset.origin) == ("WALOP-SOUTH", "by hand")
    assert calset.site.longitude == 20.8107
    assert calset.exposures.kind.tolist() == ["clp"] * 5 + ["flux", "moon", "standard"]
    assert calset.exposures.exposure.tolist() == list(range(10, 18))
    assert set(calset.filters) == {"NARROW", "SDSS-r"}
    assert calset.filters["NARROW"].wavelength.tolist() == [0.57, 0.58, 0.59]
    assert calset.remarks == ()
    assert calset.inputs[0].sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert calset.intensities.rows == 24
    block = calset.intensities.block(1, 3)
    assert block.counts.shape == (2, 8, 4)
    # exposure 16 (row 6) at point 7 (row 2 of the points, row 1 of the block), by the formula of the fixture
    assert block.counts[1, 6].tolist() == [106200.0, 106210.0, 106220.0, 106230.0]
    assert block.source[:, 6:].tolist() == [[-1, 0], [-1, 0]]  # SOURCE 3 is row 0


def test_everything_is_native(handmade):
    calset = read_calibration_set(handmade.write())
    arrays = list(calset.exposures.columns().values())
    for record in (calset.points, calset.sources, calset.intensities.block(0, 3)):
        arrays += [getattr(record, name) for name in record.__dataclass_fields__]
    for array in arrays:
        assert array.dtype.isnative
        assert array.dtype.kind in "iUb" or array.dtype == np.float64


def test_units_are_converted(handmade):
    plain = read_calibration_set(handmade.write("plain.fits"))
    for table, column, unit, factor in [
        ("POINTS", "X", "arcmin", 60.0),
        ("EXPOSURES", "CLP_ANGLE", "rad", np.pi / 180),
        ("EXPOSURES", "EXPTIME", "min", 1 / 60),
        ("EXPOSURES", "HA", "deg", 15.0),
        ("FILTERS", "WAVELENGTH", "nm", 1000.0),
        *(("SOURCES", name, "%", 100.0) for name in ("Q", "U", "Q_ERR", "U_ERR")),
    ]:
        entry = handmade[table][column]
        entry[1], entry[2] = unit, entry[2] * factor
    handmade["EXPOSURES"]["TEMP"][1:] = ["K", np.full(8, 283.15)]
    other = read_calibration_set(handmade.write())
    assert any("[POINTS] X: is in arcmin, converted to deg" in remark for remark in other.remarks)
    np.testing.assert_allclose(other.points.x, plain.points.x, rtol=1e-15)
    for name in ("clp_angle", "exptime", "ha", "temp"):
        one, two = getattr(plain.exposures, name), getattr(other.exposures, name)
        np.testing.assert_allclose(two, one, rtol=1e-5 if name == "temp" else 1e-7)  # float32 columns
    np.testing.assert_allclose(other.filters["NARROW"].wavelength, [0.57, 0.58, 0.59], rtol=1e-14)
    for name in ("q", "u", "q_err", "u_err"):
        np.testing.assert_allclose(getattr(other.sources, name), getattr(plain.sources, name), rtol=1e-14)


@pytest.mark.parametrize(
    ("table", "column", "unit", "other"),
    [
        ("SOURCES", "Q", "%", "Q_ERR"),
        ("SOURCES", "U_ERR", "%", "U"),
        ("SOURCES", "U", "%", "Q"),
        ("POINTS", "Y", "arcmin", "X"),
        ("INTENSITIES", "N", "1000 electron", "N_ERR"),
    ],
)
def test_columns_that_belong_together_have_units_together(handmade, table, column, unit, other):
    """A value in per cent beside an error without a unit: the error could be a fraction, or per cent as well."""
    for name, entry in handmade[table].items():
        if name[0] in "QUXYN" and name != "NAME":
            entry[1] = None if name == other else unit
    with pytest.raises(
        DataError, match=rf"\[{table}\] {other}: has no unit, .* is in .*; give all in one unit"
    ):
        read_calibration_set(handmade.write())
    handmade[table][other][1] = unit
    read_calibration_set(handmade.write("all.fits"))


def test_a_missing_unit_is_the_usual_one(handmade):
    plain = read_calibration_set(handmade.write("plain.fits"))
    for table in handmade.tables.values():
        for entry in table.values():
            entry[1] = None
    other = read_calibration_set(handmade.write())
    np.testing.assert_array_equal(other.points.x, plain.points.x)
    assert other.remarks == ()


def test_columns_go_by_name_not_by_place_or_case(handmade):
    plain = read_calibration_set(handmade.write("plain.fits"))
    handmade.tables["INTENSITIES"] = {
        name.lower(): entry for name, entry in reversed(handmade["INTENSITIES"].items())
    }
    other = read_calibration_set(handmade.write())
    one, two = plain.intensities.block(0, 3), other.intensities.block(0, 3)
    np.testing.assert_array_equal(one.counts, two.counts)
    np.testing.assert_array_equal(one.source, two.source)


def test_optional_columns_may_be_absent(handmade):
    for name in ("TEFF", "TEMP", "HA", "EXPTIME", "CHWP_IN", "CHWP_ANGLE", "FILTER"):
        del handmade["EXPOSURES"][name]
    del handmade["INTENSITIES"]["FLAG"]
    calset = read_calibration_set(handmade.write())
    assert np.all(np.isnan(calset.exposures.teff))
    assert not np.any(calset.exposures.position("CHWP").inside)
    assert set(calset.exposures.filter.tolist()) == {"SDSS-r"}
    # One for each value that is used instead, an element may be absent; and the curve that nothing uses now.
    assert len(calset.remarks) == 4
    unknown = "[EXPOSURES] EXPTIME, TEMP, HA, TEFF: columns missing; using nan"
    assert any(unknown in remark for remark in calset.remarks)


def test_unknown_columns_and_extensions_are_remarked_on(handmade):
    handmade["POINTS"]["XX"] = ["D", "deg", np.zeros(3)]
    path = handmade.folder / "set.fits"
    fits.HDUList([*handmade.hdus(), fits.ImageHDU(np.zeros((2, 2)), name="PREVIEW")]).writeto(
        path, checksum=True
    )
    calset = read_calibration_set(path)
    assert len(calset.remarks) == 2
    assert "[PREVIEW]: unknown extension" in calset.remarks[0]
    assert "[POINTS] XX: unknown column, not used (did you mean 'X'?)" in calset.remarks[1]


def test_flagged_and_spoilt_rows_are_not_used(handmade):
    handmade.values("INTENSITIES", "FLAG")[4] = 3
    handmade.values("INTENSITIES", "N_ERR")[4] = 0.0  # nobody gives errors of flagged rows
    handmade.values("INTENSITIES", "N")[5, 2] = NAN
    handmade.values("INTENSITIES", "N_ERR")[6, 0] = np.inf
    handmade.values("INTENSITIES", "N")[8, 0] = -1e4  # far below what noise explains
    calset = read_calibration_set(handmade.write())
    block = calset.intensities.block(0, 3)
    assert calset.intensities.rows == 20
    assert np.argwhere(~block.used.T).tolist() == [[1, 1], [1, 2], [2, 0], [2, 2]]
    assert np.all(block.counts[~block.used] == 0.0)
    assert np.all(block.sigma[~block.used] == 1.0)
    assert len(calset.remarks) == 2
    assert "rows 5, 6, 8 (counted from 0), not used" in calset.remarks[0]
    assert "FLAG: set in 1 of 24 rows" in calset.remarks[1]


def test_truth_values_of_flags_are_bad_pixels(handmade):
    """True says that a row is not to be used; it does not say that it is saturated, as bit 1 does."""
    flags = np.arange(24) == 4
    handmade["INTENSITIES"]["FLAG"] = ["L", None, flags]
    calset = read_calibration_set(handmade.write())
    assert calset.intensities.flag.tolist() == [2 * int(flag) for flag in flags]
    assert "FLAG: holds truth values: true is taken as 2, bad pixel" in "; ".join(calset.remarks)
    assert inspect(calset).flags == {"bad pixel": 1}


@pytest.mark.parametrize(("share", "doubted"), [(0.02, False), (0.08, True)])
def test_the_share_of_saturated_rows_is_that_of_all_rows(share, doubted):
    """Of 4096 field points a quarter is looked at, flags are counted at all."""
    rng = np.random.default_rng(0)
    counts = 1e5 * (1.0 + rng.random((4096, 4, 4)))
    x, y = rng.uniform(-0.25, 0.25, (2, 4096))
    calset = from_arrays(counts, np.sqrt(counts), x, y, np.arange(4) * 45.0)
    table = TableIntensities.of(calset.intensities, calset.points)
    table = table.flagged(np.arange(len(table.flag)) < share * len(table.flag), DataFlag.SATURATED)
    found = inspect(dataclasses.replace(calset, intensities=table)).findings
    assert any("rows are saturated" in finding.what for finding in found) == doubted


def test_plates_out_of_the_beam_have_no_angle(handmade):
    handmade.values("EXPOSURES", "CLP_ANGLE")[6] = 12.0
    calset = read_calibration_set(handmade.write())
    assert np.isnan(calset.exposures.clp_angle[6])


@pytest.mark.parametrize(
    "angles",
    [np.arange(5.0), 0.5 * np.arange(5), 1.25 * np.arange(5), np.array([0.1, 36.2, 72.3, 108.4, 144.5])],
)
def test_small_polariser_angles_in_degrees_are_believed(handmade, angles):
    handmade.values("EXPOSURES", "CLP_ANGLE")[:5] = angles
    assert read_calibration_set(handmade.write()).exposures.clp_angle[:5].tolist() == angles.tolist()


def test_the_bench_has_other_limits(handmade):
    handmade.values("POINTS", "X")[:] = [0.0, 12.0, 20.0]
    handmade.header["INSTRUME"] = "WALOP-LAB"
    assert read_calibration_set(handmade.write()).points.x.tolist() == [0.0, 12.0, 20.0]
    handmade.values("POINTS", "X")[2] = 60.0
    with pytest.raises(DataError, match=r"\[POINTS\] X: lies outside ±45° of WALOP-LAB in row 2"):
        read_calibration_set(handmade.write())


def test_only_the_moon_needs_a_site(handmade):
    for name in ("SITELAT", "SITELONG", "SITEELEV"):
        del handmade.header[name]
    handmade.values("EXPOSURES", "KIND")[6] = "flux"
    assert np.isnan(read_calibration_set(handmade.write()).site.latitude)


def test_a_file_overrides_a_builtin_filter(handmade):
    handmade.values("FILTERS", "FILTER")[0] = "SDSS-r"
    handmade.values("EXPOSURES", "FILTER")[:] = "SDSS-r"
    calset = read_calibration_set(handmade.write())
    assert calset.filters["SDSS-r"].wavelength.tolist() == [0.57, 0.58, 0.59]


def test_a_copied_exposure_is_used_once(handmade):
    made = handmade["EXPOSURES"]
    for name, entry in made.items():
        if name != "EXPOSURE":
            entry[2][1] = entry[2][0]
    counts, errors = (handmade.values("INTENSITIES", name) for name in ("N", "N_ERR"))
    with pytest.raises(DataError, match=r"MJD: exposures 10 and 11 \(rows 0 and 1, .*different counts"):
        read_calibration_set(handmade.write())
    times = handmade.values("EXPOSURES", "MJD").copy()
    handmade.values("EXPOSURES", "MJD")[:] = 61043.0  # known to the night: two exposures may well share that
    similar = read_calibration_set(handmade.write())
    assert similar.intensities.rows == 24
    assert "exposures 10 and 11 have the same time and settings" in similar.remarks[0]
    handmade.values("EXPOSURES", "MJD")[:] = times
    counts[3:6], errors[3:6] = counts[:3], errors[:3]
    calset = read_calibration_set(handmade.write())
    assert calset.intensities.rows == 21
    assert any("exposures 10 and 11 are the same to the last bit" in remark for remark in calset.remarks)


# ---- several files ----


def test_merging(handmade):
    one = handmade.write("one.fits")
    other = handmade.copy()
    other.values("POINTS", "X")[1] = 0.05  # the other two points are the same places
    other.values("POINTS", "POINT")[:] = [6, 5, 7]
    table = other.values("INTENSITIES", "POINT")
    table[:] = np.array([6, 5, 7] * 8)
    other.values("SOURCES", "SOURCE")[:] = [4, 3]  # the same stars under other numbers
    other.values("INTENSITIES", "SOURCE")[21:] = 4
    other.values("EXPOSURES", "MJD")[:] += 1.0
    two = other.write("two.fits")
    calset = read_calibration_set(one, two)
    assert len(calset.exposures) == 16
    assert len(np.unique(calset.exposures.exposure)) == 16
    assert len(calset.points) == 4
    assert len(np.unique(calset.points.point)) == 4
    assert calset.sources.name.tolist() == ["BD+25", "HD 1"]
    assert calset.intensities.rows == 48
    assert [entry.path for entry in calset.inputs] == [one, two]
    assert any("raised by 8" in remark for remark in calset.remarks)

    block = calset.intensities.block(0, 4)
    a = read_calibration_set(one).intensities.block(0, 3)
    b = read_calibration_set(two).intensities.block(0, 3)
    np.testing.assert_array_equal(block.counts[:3, :8], a.counts)
    np.testing.assert_array_equal(block.counts[[0, 3, 2], 8:], b.counts)
    assert not np.any(block.used[3, :8])
    assert not np.any(block.used[1, 8:])
    assert np.all(block.source[[0, 3, 2], 15] == 0)


def test_merging_refuses_what_does_not_fit(handmade):
    one = handmade.write("one.fits")
    for change, fragment in [
        (lambda made: made.header.update(INSTRUME="WALOP-NORTH"), "is WALOP-NORTH"),
        (lambda made: made.header.update(SITELAT=35.0), "is another site"),
        (lambda made: made.values("SOURCES", "Q").__setitem__(0, 0.5), "'BD\\+25' has other values"),
        (
            lambda made: made.values("FILTERS", "THROUGHPUT").__setitem__((0, 0), 0.5),
            "'NARROW' is another curve",
        ),
    ]:
        other = handmade.copy()
        change(other)
        with pytest.raises(DataError, match=fragment):
            read_calibration_set(one, other.write("two.fits"))


def test_blocks_are_slices(handmade):
    intensities = read_calibration_set(handmade.write()).intensities
    assert isinstance(intensities, TableIntensities)
    whole = intensities.block(0, 3)
    for start, stop in [(0, 1), (1, 1), (1, 3), (2, 99), (3, 5)]:
        part = intensities.block(start, stop)
        for name in whole.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[start:stop])


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        (lambda made: made.header.update(SITELAT=-31.3795), ["[PRIMARY] SITELAT: is -31.3795°", "-32.3795°"]),
        (lambda made: made.header.update(SITEELEV=179.8), ["SITEELEV: is 179.8 m", "stands at 1798 m"]),
        (lambda made: made.header.update(SITELONG=20.85), []),
        (
            lambda made: made.values("EXPOSURES", "MJD").__setitem__(3, 41043.85),
            ["MJD: is before 1990 in row 3"],
        ),
        (
            lambda made: made.values("EXPOSURES", "MJD").__setitem__(3, 61543.85),
            ["MJD: is more than 400", "row 3"],
        ),
    ],
)
def test_implausible_place_and_time_are_remarked_on(handmade, change, fragments):
    change(handmade)
    remarks = "\n".join(read_calibration_set(handmade.write()).remarks)
    for fragment in fragments:
        assert fragment in remarks
    assert ("SITE" in remarks or "MJD" in remarks) == bool(fragments)


@pytest.mark.parametrize(
    ("angles", "half"),
    [
        (np.arange(0.0, 180.0, 20.0), True),
        (np.arange(-80.0, 90.0, 20.0), True),
        (np.arange(0.0, 360.0, 20.0), False),
        ([0.0, 120.0, 240.0], False),
        ([30.0], True),
    ],
)
def test_half_a_turn_of_the_polariser_is_that_on_both_sides_of_zero(angles, half):
    counts = 1e5 * (1.0 + np.random.default_rng(0).random((20, len(angles), 4)))
    x, y = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 20))
    findings = inspect(from_arrays(counts, np.sqrt(counts), x, y, angles)).findings
    assert half == any("half a turn only" in finding.what for finding in findings)

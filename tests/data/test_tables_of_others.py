"""Tables as the programs of others write them: flags, identifiers, undefined values, times, masks, units."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units
from astropy.io import fits
from astropy.table import MaskedColumn, QTable
from astropy.time import Time
from astropy.utils.masked import Masked
from tables_in_memory import ROWS, SOUTH, read, remarks, table

from walop_jax.data.calset import from_arrays
from walop_jax.data.user_tables import extended, in_memory, read_input_table
from walop_jax.io.errors import DataError
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.field_points import field_points

pd = pytest.importorskip("pandas")


def written(path, given):
    given.write(path, overwrite=True)
    return read_catalogue(read_input_table(path), SOUTH)


# -------------------------------------------------------------------------------------------------------------- flags


@pytest.mark.parametrize(
    "flags",
    [
        [0, 0, 1, 0, 0],
        np.array([0, 0, 1, 0, 0], np.uint16),
        [False, False, True, False, False],
        [0.0, 0.0, 4.0, np.nan, 0.0],
        ["0", "0", "1", "", "0"],
        ["F", "F", "T", "F", "F"],
        ["0000", "0000", "0100", "0000", "0b0"],
        ["0x0", "0x0", "0x10", "0x00", "none"],
        MaskedColumn([0, 7, 1, 0, 0], mask=[0, 1, 0, 0, 0]),
        (np.arange(5) == 2)[:, None] * np.ones(4, int),
    ],
)
@pytest.mark.parametrize("name", ["FLAG", "N_FLAG", "flag"])
def test_any_bit_of_a_flag_leaves_the_counts_out(name, flags):
    found = read(table(**{name: flags}))
    assert found.spoilt.tolist() == [False, False, True, False, False]
    assert np.isnan(found.counts[2]).all()
    assert np.isfinite(np.delete(found.counts, 2, axis=0)).all()


@pytest.mark.parametrize("name", ["O2_FLAG", "N2_FLAG", "N_FLAG2"])
def test_a_camera_has_a_flag_of_its_own(name):
    found = read(table(**{name: [0, 3, 0, 0, 0]}))
    assert np.argwhere(np.isnan(found.counts)).tolist() == [[1, 2]]


def test_bits_of_fits_are_flags(tmp_path):
    columns = [
        fits.Column(n, f, array=table()[n]) for n, f in (("X", "D"), ("Y", "D"), ("N", "4D"), ("N_ERR", "4D"))
    ]
    bits = np.zeros((ROWS, 16), bool)
    bits[3, 9] = True
    fits.BinTableHDU.from_columns([*columns, fits.Column("FLAG", "16X", array=bits)]).writeto(
        tmp_path / "b.fits"
    )
    found = read_catalogue(read_input_table(tmp_path / "b.fits"), SOUTH)
    assert found.spoilt.tolist() == [False, False, False, True, False]


@pytest.mark.parametrize(
    ("flags", "message"), [(["good"] * 5, "'good' is neither"), ([0.5] * 5, "neither one integer")]
)
def test_what_is_no_flag_is_refused(flags, message):
    with pytest.raises(DataError, match=message):
        read(table(FLAG=flags))


def test_the_flags_of_the_user_stay_and_those_of_an_earlier_result_are_no_flags():
    source = in_memory(table(FLAG=[0, 0, 1, 0, 0], Q=1.0))
    source.table["N_ERR"][0] += 1.0  # the same error in all rows would be remarked on as a placeholder
    read_catalogue(source, SOUTH)
    made = extended(source, {name: np.full(ROWS, 16) for name in ("Q", "QU_COV", "P_DEBIASED", "FLAG")})
    assert made["N_FLAG"].tolist() == [0, 0, 1, 0, 0]
    assert made["FLAG"].tolist() == [16] * 5
    assert made.meta["REMARK"] == [
        "FLAG of the table is N_FLAG in the result",
        "column Q is replaced by the result",
    ]
    assert read(made).spoilt.tolist() == [False, False, True, False, False]


def test_columns_that_are_not_used_are_named():
    said = remarks(read(table(FLAGS=[0, 4, 0, 0, 0], note="a", ROTATR=3.0)))
    assert "columns FLAGS, NOTE, ROTATR are not used" in said
    assert "FLAGS: flags are read from N_FLAG" in said
    assert "ROTATR: did you mean ROTATOR?" in said
    points = in_memory(table())
    field_points(points, SOUTH)
    assert points.about() == ("columns N, N_ERR are not used",)


# -------------------------------------------------------------------------------------------------------- identifiers

GAIA = 4658219876543210000 + np.array([0, 64, 128, 192, 256])


@pytest.mark.parametrize(
    "ids",
    [
        GAIA,
        GAIA.astype(np.uint64),
        GAIA.astype(str),
        [f"{n}  " for n in GAIA],
        np.array([-1, -1, -1, 7, 8]),
        [-1.0, np.nan, -99.0, 7.0, 8.0],
        ["", " ", "nan", "a", "b"],
        ["-1", "N/A", "None", "a", "b"],
        ["-5", "-5", "-5", "007", "7"],
        MaskedColumn([5, 5, 5, 5, 6], mask=[1, 1, 1, 0, 0]),
        np.array([np.iinfo(np.uint64).max] * 3 + [1, 2], np.uint64),
        np.array([None, None, None, "a", "b"], object),
        pd.array([None, None, None, 1, 2], dtype="Int64"),
    ],
)
def test_rows_without_a_common_identifier_are_stars_of_their_own(ids):
    columns = {name: list(values) for name, values in table().items()}
    frame = pd.DataFrame(columns | {"ID": ids}) if isinstance(ids, pd.arrays.IntegerArray) else None
    found = read(table(ID=ids)) if frame is None else None
    if frame is not None:
        for k in range(4):
            frame[f"N{k}"], frame[f"N{k}_ERR"] = (np.asarray(table()[n])[:, k] for n in ("N", "N_ERR"))
        found = read(frame.drop(columns=["N", "N_ERR"]))
    assert found is not None
    assert len(set(found.star.tolist())) == ROWS


@pytest.mark.parametrize(
    "ids",
    [
        ["a ", "a", "b", "c", "d"],
        [1.0, 1.0, 2.0, 3.0, 4.0],
        np.array([b"x", b"x ", b"y", b"z", b"w"]),
        [0, 0, 1, 2, 3],
    ],
)
def test_rows_of_one_identifier_are_one_star(ids):
    star = read(table(ID=ids)).star.tolist()
    assert star[0] == star[1]
    assert len(set(star)) == 4


def test_unknown_identifiers_are_said():
    assert "ID is -1 in rows 0, 2" in remarks(read(table(ID=[-1, 4, -1, 5, 6])))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_floats_that_cannot_hold_an_identifier_are_refused(dtype):
    with pytest.raises(DataError, match=r"ID: is a float beyond 2\*\*.*integers or as text"):
        read(table(ID=GAIA.astype(dtype)))


# ------------------------------------------------------------------------------------------------------------- copies


def twice(row=0, **changes):
    given = table(ID=np.arange(ROWS))
    given.add_row(given[row])
    for name, value in changes.items():
        given[name][-1] = value
    return given


def test_a_row_that_is_there_twice_counts_once():
    found = read(twice())
    assert found.copy.tolist() == [False] * 5 + [True]
    assert not found.spoilt.any()
    assert not found.repeated.any()
    assert "row 5 (counted from 0): copies of another row" in remarks(found)


def test_a_copy_in_single_precision_is_a_copy():
    given = twice()
    given["N"][-1] = given["N"][-1].astype(np.float32)
    assert read(given).copy.tolist() == [False] * 5 + [True]


@pytest.mark.parametrize("lacking", [0, 5], ids=["the first", "the copy"])
def test_a_copy_that_lacks_a_camera_is_a_copy(lacking):
    """What is left of it is the row with all cameras."""
    given = twice()
    given["N"][lacking, 2] = np.nan
    found = read(given)
    assert np.flatnonzero(found.copy).tolist() == [lacking]
    assert not found.repeated.any()


def test_the_same_counts_under_another_identifier_or_setting_are_flagged():
    assert read(twice(ID=77)).repeated.tolist() == [True, False, False, False, False, True]
    given = twice()
    given["CHWP_ANGLE"] = np.where(np.arange(6) == 5, 45.0, 0.0)
    found = read(given)
    assert found.repeated.tolist() == [True, False, False, False, False, True]
    assert not found.copy.any()


def test_other_measurements_are_no_copies():
    given = twice()
    given["N"][-1, 3] += 1.0
    found = read(given)
    assert not found.copy.any()
    assert not found.repeated.any()
    empty = table()
    empty["N"] = np.nan
    assert not read(empty).copy.any()


# ------------------------------------------------------------------------------------------------------------- angles


def test_a_row_without_rotator_is_named_and_turns_are_turns():
    found = read(table(ROTATOR=[370.0, 10.0, np.nan, 10.0, -350.0]))
    assert "ROTATOR is missing in row 2" in remarks(found)
    np.testing.assert_array_equal(found.rotator, [370.0, 10.0, np.nan, 10.0, -350.0])
    with pytest.raises(DataError, match="ROTATOR: exceeds ±720 in row 1"):
        read(table(ROTATOR=[0.0, -999.0, 0.0, 0.0, 0.0]))


def test_radians_are_converted_where_they_say_so_and_refused_where_they_must_be():
    angle = np.deg2rad([30.0, 30.0, 75.0, 120.0, 0.0])
    np.testing.assert_allclose(
        read(table(ROTATOR=angle * units.rad)).rotator, [30, 30, 75, 120, 0], atol=1e-12
    )
    for name in ("ROTATOR", "CHWP_ANGLE"):
        with pytest.raises(
            DataError, match=rf"{name}: has no unit and is a whole number of degrees in radians.*30°"
        ):
            read(table(**{name: angle}))
    assert "are these radians?" in remarks(read(table(ROTATOR=[0.1234, 1.2, 3.3, 4.1, 6.2])))
    for plain in (
        [0.0, 1.0, 2.0, 3.0, 0.0],
        [0.1, 22.5, 45.0, 0.0, 0.0],
        [0.1, 0.2, 0.3, 0.4, 0.5] * units.deg,
    ):
        assert "radians" not in remarks(read(table(ROTATOR=plain)))


def test_an_angle_alone_puts_no_plate_into_the_beam_that_was_never_there():
    with pytest.raises(DataError, match=r"CHWP_ANGLE: has values, but no exposure.*add CHWP_IN"):
        read(table(CHWP_ANGLE=0.0), never_in=("CHWP",))
    assert np.isnan(
        read(table(CHWP_ANGLE=0.0, CHWP_IN=False), never_in=("CHWP",)).points.settings.position("CHWP")
    ).all()
    assert np.isnan(read(table(CHWP_ANGLE=np.nan), never_in=("CHWP",)).points.settings.position("CHWP")).all()
    assert (
        read(table(CHWP_ANGLE=45.0, CHWP_IN=True), never_in=("CHWP",)).points.settings.position("CHWP")[0]
        == 45.0
    )


# -------------------------------------------------------------------------------------------- undefined, masked, times


def scaled(path, name, form, raw, *, scale=1.0, zero=0.0, null, given=None):
    """The table with a column of scaled integers, TNULL where it is undefined."""
    given = table() if given is None else given
    columns = [
        fits.Column(n, "D" if given[n].ndim == 1 else "4D", array=given[n])
        for n in given.colnames
        if n != name
    ]
    fits.BinTableHDU.from_columns([*columns, fits.Column(name, form, array=raw)]).writeto(
        path, overwrite=True
    )
    with fits.open(path, mode="update") as hdus:
        number = hdus[1].columns.names.index(name) + 1
        hdus[1].header[f"TSCAL{number}"], hdus[1].header[f"TZERO{number}"] = scale, zero
        hdus[1].header[f"TNULL{number}"] = null
    return path


@pytest.mark.parametrize(
    ("form", "raw", "scale", "zero", "null"),
    [
        ("J", np.array([3000, -9999, 1000, 0, 500], "i4"), 0.01, 0.0, -9999),
        ("I", np.array([3000, -32768, 1000, 0, 500], "i2"), 0.01, 0.0, -32768),
        ("I", np.array([30 - 100, 32767, 10 - 100, -100, 5 - 100], "i2"), 1.0, 100.0, 32767),
        ("B", np.array([30, 255, 10, 0, 5], "u1"), 1.0, 0.0, 255),
    ],
)
def test_undefined_numbers_of_scaled_columns_are_missing(tmp_path, form, raw, scale, zero, null):
    path = scaled(tmp_path / "s.fits", "ROTATOR", form, raw, scale=scale, zero=zero, null=null)
    found = read_catalogue(read_input_table(path), SOUTH)
    np.testing.assert_allclose(found.rotator, [30.0, np.nan, 10.0, 0.0, 5.0], atol=1e-9)


def test_undefined_counts_of_a_camera_are_missing(tmp_path):
    raw = np.full((ROWS, 4), 100000, "i4")
    raw[1, 2] = -1
    path = scaled(
        tmp_path / "n.fits", "N", "4J", raw + np.arange(ROWS)[:, None] * 7 * (raw > 0), scale=10.0, null=-1
    )
    assert np.argwhere(np.isnan(read_catalogue(read_input_table(path), SOUTH).counts)).tolist() == [[1, 2]]


def test_masked_values_are_missing():
    given = table()
    given["N"] = MaskedColumn(given["N"], mask=np.eye(5, 4, dtype=bool))
    assert np.argwhere(np.isnan(read(given).counts)).tolist() == [[0, 0], [1, 1], [2, 2], [3, 3]]
    turned = QTable(table())
    turned["ROTATOR"] = Masked([1.0, 2.0, 3.0, 4.0, 99.0] * units.deg, mask=[0, 0, 0, 0, 1])
    np.testing.assert_array_equal(read(turned).rotator, [1.0, 2.0, 3.0, 4.0, np.nan])
    hidden = table(X=MaskedColumn(np.zeros(ROWS), mask=[0, 0, 0, 1, 0]))
    lost = read(hidden)
    assert any("X or Y is not finite in row 3" in remark for remark in lost.remarks)
    assert np.flatnonzero(lost.points.outside).tolist() == [3]


def test_masked_arrays_of_a_calibration_set_are_missing():
    counts = np.random.default_rng(0).normal(1e5, 300, (3, 4, 4))
    angles, x = np.arange(4) * 45.0, np.arange(3) / 10
    masked = np.ma.masked_array(counts, mask=np.zeros(counts.shape, bool))
    masked.mask[1, 2, 3] = True
    made = from_arrays(masked, np.sqrt(counts), x, 0 * x, angles)
    assert made.intensities.counts.shape == (11, 4)
    with pytest.raises(DataError, match="kind"):
        from_arrays(
            counts,
            np.sqrt(counts),
            x,
            0 * x,
            angles,
            kinds=np.ma.masked_array(["clp"] * 4, mask=[0, 1, 0, 0]),
        )
    temp = from_arrays(
        counts, np.sqrt(counts), x, 0 * x, angles, temp=np.ma.masked_array([1.0, 2, 3, 99], mask=[0, 0, 0, 1])
    )
    np.testing.assert_array_equal(temp.exposures.temp, [1.0, 2.0, 3.0, np.nan])


def test_arrays_of_the_user_are_copied():
    counts = np.random.default_rng(0).normal(1e5, 300, (3, 4, 4))
    x = np.arange(3) / 10
    made = from_arrays(counts, np.sqrt(counts), x, 0 * x, np.arange(4) * 45.0)
    before = made.intensities.counts.copy()
    counts *= 2.0
    x += 1.0
    np.testing.assert_array_equal(made.intensities.counts, before)
    assert made.points.x.max() < 0.5
    given = table()
    result = extended(in_memory(given), {"Q": np.zeros(ROWS)})
    for name in given.colnames:
        assert not np.shares_memory(np.asarray(given[name]), np.asarray(result[name]))


TIME = Time(np.linspace(61220.5, 61220.7, ROWS), format="mjd", scale="tai")


@pytest.mark.parametrize("suffix", ["", ".ecsv", ".fits"])
def test_times_become_dates(tmp_path, suffix):
    given = table(MJD=TIME)
    found = written(tmp_path / f"t{suffix}", given) if suffix else read(given)
    np.testing.assert_allclose(found.time, TIME.utc.mjd, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.time + 37 / 86400, TIME.mjd, rtol=0, atol=1e-9)  # TAI − UTC since 2017


def test_dates_of_pandas_and_of_numpy_are_times():
    dates = np.array(["2026-07-01T12:00", "2026-07-02", "NaT", "2026-07-01", "2026-07-01"], "datetime64[ns]")
    expected = [61222.5, 61223.0, np.nan, 61222.0, 61222.0]
    np.testing.assert_allclose(read(table(MJD=dates)).time, expected, atol=1e-9)
    with pytest.raises(DataError, match=r"MJD: is not a Modified Julian Date.*Julian Date"):
        read(table(MJD=np.full(ROWS, 2461221.5)))
    with pytest.raises(DataError, match="X: holds times"):
        read(table(X=TIME))


# ------------------------------------------------------------------------------------------------------ units, shapes


@pytest.mark.parametrize(
    ("unit", "message"),
    [
        ("mag", "logarithmic.*counts in electrons are needed"),
        ("dex", "logarithmic.*counts in electrons are needed"),
        (units.mag(units.electron), "logarithmic"),
        ("adu", "multiply by the gain"),
        ("electron/s", "multiply by the exposure time"),
    ],
)
def test_units_that_are_no_counts_are_refused_with_advice(unit, message):
    given = table()
    given["N"].unit = unit
    with pytest.raises(DataError, match=f"N: .*{message}"):
        read(given)


@pytest.mark.parametrize("name", ["N", "N_ERR"])
def test_counts_in_a_unit_and_errors_without_one_are_refused(name):
    given = table()
    given[name] = given[name] / 1e3
    given[name].unit = "1000 electron"
    other = "N_ERR" if name == "N" else "N"
    with pytest.raises(DataError, match=rf"{other}: has no unit, {name} is in 1000 electron"):
        read(given)
    given[other].unit = "electron"
    np.testing.assert_allclose(read(given).counts, table()["N"], rtol=1e-14)


def test_columns_of_one_value_are_numbers_and_structures_are_refused():
    given = table()
    given["X"] = np.asarray(given["X"])[:, None]
    np.testing.assert_array_equal(read(given).points.x, np.linspace(-0.2, 0.2, ROWS))
    given["Y"] = np.zeros(ROWS, [("a", float), ("b", float)])
    with pytest.raises(DataError, match="Y: is no plain column"):
        read(given)


# ---------------------------------------------------------------------------------------------- other forms of tables


def test_the_index_of_a_data_frame_is_a_column():
    """Identifiers that are an index, as `set_index` makes it, hold rows together as a column does."""
    columns = {f"N{k}": np.full(ROWS, 1e6) + np.arange(ROWS) + k for k in range(4)}
    columns |= {f"N{k}_ERR": np.full(ROWS, 1e3) for k in range(4)} | {"X": 0.1, "Y": 0.1}
    frame = pd.DataFrame(columns | {"ID": ["a", "a", "b", "b", "c"]})
    assert read(frame.set_index("ID")).star.tolist() == [0, 0, 1, 1, 2]
    assert read(frame.set_index("ID", drop=False)).star.tolist() == [0, 0, 1, 1, 2]
    assert read(frame.assign(FRAME=1).set_index(["FRAME", "ID"])).star.tolist() == [0, 0, 1, 1, 2]
    assert "index" not in in_memory(frame).table.colnames


@pytest.mark.parametrize(
    "form",
    [
        lambda t: t.as_array(),
        lambda t: t.as_array().view(np.recarray),
        fits.BinTableHDU,
        lambda t: fits.BinTableHDU(t).data,
    ],
    ids=["structured", "recarray", "hdu", "fits data"],
)
def test_structured_arrays_and_tables_of_open_files_are_tables(form):
    given = table(
        ID=[7, 7, 8, 8, 9], CHWP_ANGLE=[0.0, 22.5, 0.0, 22.5, 0.0], CHWP_IN=[True, False] * 2 + [True]
    )
    found = read(form(given))
    assert found.star.tolist() == [0, 0, 1, 1, 2]
    np.testing.assert_array_equal(found.counts, given["N"])
    np.testing.assert_array_equal(found.points.settings.positions["CHWP"], [0.0, np.nan, 0.0, np.nan, 0.0])


def test_undefined_numbers_of_an_open_file_are_missing():
    """TNULL holds for data that a user has opened as well."""
    column = fits.Column("ID", "J", null=-7, array=np.array([5, -7, -7, 5, 6]))
    parts = [column, *fits.BinTableHDU(table()).columns]
    assert read(fits.BinTableHDU.from_columns(parts).data).star.tolist() == [0, 2, 3, 0, 1]


def test_a_plate_whose_place_is_not_given_is_where_its_angle_says():
    """An undefined CHWP_IN is as if the column were absent, also where the calibration forbids that."""
    stated = MaskedColumn([True, True, False, False, True], mask=[0, 1, 0, 1, 0])
    angles = [10.0, 20.0, 30.0, 40.0, 50.0]
    for place in (stated, ["T", "", "F", "n/a", "T"]):
        positions = read(table(CHWP_ANGLE=angles, CHWP_IN=place)).points.settings.positions["CHWP"]
        np.testing.assert_array_equal(positions, [10.0, 20.0, np.nan, 40.0, 50.0])
        with pytest.raises(DataError, match=r"no exposure .* in rows 1, 3"):
            read(table(CHWP_ANGLE=angles, CHWP_IN=place), never_in=["CHWP"])


def test_flags_of_field_points_are_no_flags_of_cameras():
    """FLAG of an earlier `matrix` is about a place of the field."""
    results = {name: np.zeros(ROWS) for name in ("M21", "M21_ERR", "M22_ERR", "P_ERR")}
    assert not read(table(**results, FLAG=[16, 32, 0, 0, 64])).spoilt.any()


def test_a_column_is_renamed_whatever_names_there_are():
    given = in_memory(table(FLAG=np.zeros(ROWS, int), N_FLAG=0, OLD_FLAG=1, OLDER_FLAG=2))
    read_catalogue(given, SOUTH)
    names = extended(given, {"FLAG": np.ones(ROWS, int)}).colnames
    assert len(set(names)) == len(names) == 9
    assert "OLD_OLD_FLAG" in names


@pytest.mark.parametrize("counts", ["N{k}", "{camera}"])
@pytest.mark.parametrize("sky", ["SKY{k}", "{camera}_SKY"])
def test_the_level_of_the_sky_has_a_column_for_each_camera(counts, sky):
    """Of counts by the names of the cameras no sky is made, and of a table without levels none."""

    def side_by_side(**columns):
        made = table()["X", "Y"]
        for form, values in columns.items():
            for k, camera in enumerate(SOUTH.cameras.names):
                made[form.format(k=k, camera=camera)] = values[:, k]
        return made

    plain = table()
    numbers = {counts: plain["N"], f"{counts}_ERR": plain["N_ERR"]}
    assert read(side_by_side(**numbers)).sky is None
    level = 100.0 + np.arange(4.0) * np.ones((ROWS, 1))
    found = read(side_by_side(**numbers, **{sky: level}))
    np.testing.assert_array_equal(found.sky, level)
    np.testing.assert_allclose(found.counts, plain["N"])


def test_a_position_in_hours_or_beyond_the_sky_is_refused():
    """Rows are stars by RA and DEC: 15 arcsec of a right ascension in hours would be one."""
    rng = np.random.default_rng(1)
    many = table()[np.zeros(40, int)]
    many["X"], many["Y"] = rng.uniform(-0.2, 0.2, (2, 40))
    many["DEC"] = -20.0 + many["Y"]
    many["RA"] = (100.0 + many["X"]) / 15.0
    with pytest.raises(DataError, match=r"RA: lies between .* looks like hours"):
        read(many)
    with pytest.raises(DataError, match="DEC: is beyond ±90°"):
        read(table(RA=np.arange(5.0), DEC=np.full(5, 100.0)))


@pytest.mark.parametrize("name", ["GaiaID", "Gaia", "gaia_dr3_source_id", "ID_GAIA", "DR3Name"])
def test_an_identity_under_an_unknown_name_is_named(name):
    assert f"{name.upper()}: the identity of a star is read from SOURCE_ID" in remarks(
        read(table(**{name: range(5)}))
    )

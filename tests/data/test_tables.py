"""Tables of field points: FITS, CSV and ECSV, with what is wrong in them named by file, column and row."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy import units
from astropy.table import MaskedColumn, Table
from small_run import SMALL

from walop_jax.data.user_tables import extended, read_input_table
from walop_jax.io.errors import DataError
from walop_jax.io.plain_tables import write_table
from walop_jax.model.effects import effect_by_name
from walop_jax.model.instrument import nominal_instrument
from walop_jax.science.field_points import field_points

SOUTH = nominal_instrument("WALOP-SOUTH")


def read(path):
    return field_points(read_input_table(path), SOUTH)


@pytest.mark.parametrize("name", ["p.fits", "p.csv", "p.ecsv", "p.fits.gz"])
def test_formats_agree(tmp_path, name):
    table = Table({"x": [0.1, -0.2], "Y": [0.0, 0.3], "TEFF": [5000.0, np.nan], "CHWP_IN": [True, False]})
    table["CHWP_ANGLE"] = [45.0, 0.0]
    table["FILTER"] = ["SDSS-r", "NB"]
    table["note"] = ["a", "b"]
    table.write(tmp_path / name)
    points = read(tmp_path / name)
    np.testing.assert_array_equal(points.x, [0.1, -0.2])
    np.testing.assert_array_equal(points.settings.teff, [5000.0, np.nan])
    np.testing.assert_array_equal(points.settings.position("CHWP"), [45.0, np.nan])
    assert points.settings.filter.tolist() == ["SDSS-r", "NB"]
    np.testing.assert_array_equal(points.settings.temperature, [10.0, 10.0])


def test_units_are_converted(tmp_path):
    table = Table({"X": [6.0, 12.0] * units.arcmin, "Y": [0.0, 0.1] * units.deg})
    table["TEMP"] = [283.15, 293.15] * units.K
    table.write(tmp_path / "p.ecsv")
    points = read(tmp_path / "p.ecsv")
    np.testing.assert_allclose(points.x, [0.1, 0.2], rtol=1e-14)
    np.testing.assert_allclose(points.settings.temperature, [10.0, 20.0], rtol=1e-10)


def test_empty_cells_are_the_defaults(tmp_path):
    (tmp_path / "p.csv").write_text("X,Y,TEFF,FILTER,CHWP_ANGLE,TEMP\n0.1,0,,,,\n0.2,0,4000,NB,45,20\n")
    points = read(tmp_path / "p.csv")
    assert points.settings.filter.tolist() == ["SDSS-r", "NB"]
    np.testing.assert_array_equal(points.settings.teff, [np.nan, 4000.0])
    np.testing.assert_array_equal(points.settings.position("CHWP"), [np.nan, 45.0])
    np.testing.assert_array_equal(points.settings.temperature, [10.0, 20.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("X,Z\n0,0\n", "Y: the column is missing"),
        ("X,Y\n0,0\n0,up\n", "Y: 'up' is not a number, in row 1"),
        ("X,Y\n0,0\n,0.1\n", "X: is not finite in row 1"),
        ("X,Y\n", "no rows"),
        ("X,x,Y\n0,1,0\n", "X: the column is there twice"),
        ("X,Y\n6,3\n12,-3\n", "arcmin or pixels"),
        ("X,Y,TEFF\n0,0,5\n", "TEFF: is not a temperature"),
        ("X,Y,CHWP_IN\n0,0,T\n", "CHWP_ANGLE: is not finite in row 0"),
        ("X,Y,CHWP_IN\n0,0,perhaps\n", "CHWP_IN: 'perhaps' is neither true nor false, in row 0"),
        ("X,Y,TEMP\n0,0,283\n", "kelvin"),
        ("X,Y,HA\n0,0,90\n", "degrees"),
        ("", "p.csv"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read(tmp_path / "p.csv")
    assert "p.csv" in str(caught.value)


def test_files_that_are_no_tables(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read(tmp_path / "none.csv")
    (tmp_path / "points.h5").write_bytes(b"\x89HDF")
    with pytest.raises(DataError, match=r"\.ecsv"):
        read(tmp_path / "points.h5")
    (tmp_path / "p.fits").write_bytes(b"not FITS")
    with pytest.raises(DataError, match="FITS"):
        read(tmp_path / "p.fits")
    (tmp_path / "p.csv").write_bytes(b"X,Y\n\xff\xfe,0\n")
    with pytest.raises(DataError):
        read(tmp_path / "p.csv")


def test_single_points_outside_are_marked(tmp_path):
    (tmp_path / "p.csv").write_text("X,Y\n0,0\n0.1,0\n0.4,0\n")
    assert read(tmp_path / "p.csv").outside.tolist() == [False, False, True]


@pytest.mark.parametrize("name", ["out.fits", "out.csv", "out.ecsv"])
def test_columns_are_added(tmp_path, name):
    table = Table({"X": [0.1, 0.2], "Y": [0.0, 0.1], "m22": [9.0, 9.0]})
    table["mag"] = MaskedColumn([12.0, 13.0], mask=[True, False])
    table.write(tmp_path / "p.fits")
    source = read_input_table(tmp_path / "p.fits")
    write_table(tmp_path / name, extended(source, {"M22": (np.array([1.0, np.nan]), "element")}))
    back = read_input_table(tmp_path / name)
    assert back.names == ("X", "Y", "MAG", "M22")
    np.testing.assert_array_equal(np.ma.filled(back.table["M22"], np.nan), [1.0, np.nan])
    with pytest.raises(DataError, match="exists already"):
        write_table(tmp_path / name, extended(source, {}))
    write_table(tmp_path / name, extended(source, {}), overwrite=True)
    assert "M22" in read_input_table(tmp_path / name).names


def test_hour_angles_of_a_whole_day_are_counted_from_the_meridian(tmp_path):
    """23.5 h is half an hour before the meridian: optics that follow the hour angle are those of −0.5 h."""
    Table({"X": [0.0] * 5, "Y": [0.1] * 5, "HA": [0.5, 23.5, -0.5, 12.0, 13.0]}).write(tmp_path / "t.fits")
    points = field_points(read_input_table(tmp_path / "t.fits"), SOUTH)
    assert points.settings.hour_angle.tolist() == [0.5, -0.5, -0.5, 12.0, -11.0]


@pytest.mark.parametrize(("effect", "column"), [("flexure", "HA"), ("hwp_temperature", "TEMP")])
def test_a_missing_column_that_the_optics_depend_on_is_named(tmp_path, effect, column):
    Table({"X": [0.0], "Y": [0.1]}).write(tmp_path / "t.fits")
    device = dataclasses.replace(SOUTH, effects=(effect_by_name(effect).neutral(SMALL.context()),))
    for instrument, asked in ((SOUTH, False), (device, True)):
        source = read_input_table(tmp_path / "t.fits")
        field_points(source, instrument)
        assert any(f"{column} is missing" in remark for remark in source.remarks) == asked

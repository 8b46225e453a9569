"""The common table of stellar polarisation: as others read it, its numbers by closed forms, its check by faults."""

from __future__ import annotations

import io

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io.votable import parse, validate
from astropy.table import MaskedColumn, Table

from walop_jax.data.user_tables import in_memory
from walop_jax.io.errors import DataError
from walop_jax.io.plain_tables import write_table
from walop_jax.science.common_table import check_common_table, columns, common_table, to_galactic


def result(count=40) -> Table:
    """A table as `apply` gives it, of made-up numbers."""
    rng = np.random.default_rng(6)
    p, angle = rng.uniform(0.001, 0.05, count), rng.uniform(0, 180, count)
    q, u = p * np.cos(np.deg2rad(2 * angle)), p * np.sin(np.deg2rad(2 * angle))
    table = Table({"SOURCE_ID": 4_000_000_000_000_000_000 + np.arange(count)})
    table["RA"], table["DEC"] = rng.uniform(0, 360, count), rng.uniform(-89, 89, count)
    table["ROTATOR"], table["MJD"], table["FILTER"] = rng.uniform(0, 360, count), 61041.25, "SDSS-r"
    table["Q"], table["U"], table["Q_ERR"], table["U_ERR"], table["QU_COV"] = q, u, 0.002, 0.003, 1e-6
    table["Q_PHOTON"], table["U_PHOTON"], table["QU_PHOTON"] = 0.0016, 0.0018, 0.4e-6
    table["Q_HIDDEN"], table["U_HIDDEN"] = 0.001, 0.0
    table["P"], table["P_DEBIASED"], table["P_ERR"] = p, 0.99 * p, 0.002
    table["EVPA"], table["EVPA_ERR"], table["CHI2"], table["DOF"], table["NROWS"] = (
        angle,
        1.0,
        rng.random(count),
        1,
        1,
    )
    table["FLAG"] = 0
    table.meta |= {"INSTRUME": "WALOP-SOUTH", "CALHASH": "abc", "PESTIM": "x"}
    return table


def made() -> Table:
    return common_table(in_memory(result()))[0]


def test_galactic_values_are_those_of_a_step_on_the_sky():
    table = made()
    stars = SkyCoord(table["RAJ2000"], table["DEJ2000"], unit="deg")
    step = stars.directional_offset_by(np.asarray(table["PA"]) * units.deg, 0.1 * units.arcsec)
    there = stars.galactic.position_angle(step.galactic).deg
    np.testing.assert_allclose(np.mod(table["PA_gal"] - there + 90, 180) - 90, 0, atol=1e-3)
    np.testing.assert_allclose(np.hypot(table["q_gal"], table["u_gal"]), table["Pol"], rtol=1e-12)
    np.testing.assert_allclose(
        table["q_gal"] + 1j * table["u_gal"],
        table["Pol"] * np.exp(2j * np.deg2rad(table["PA_gal"])),
        atol=1e-12,
    )
    np.testing.assert_allclose(table["GLAT"], stars.galactic.b.deg, atol=1e-9)


def test_a_covariance_turns_as_samples_do():
    covariance = np.array([[[4.0, 1.0], [1.0, 9.0]]]) * 1e-6
    samples = np.random.default_rng(0).multivariate_normal([0.01, -0.02], covariance[0], 200_000)
    north = np.array([33.0])
    qu, turned = to_galactic(np.array([[0.01, -0.02]]), covariance, north)
    seen = (samples[:, 0] + 1j * samples[:, 1]) * np.exp(-2j * np.deg2rad(33.0))
    assert (qu[0, 0], qu[0, 1]) == pytest.approx((seen.real.mean(), seen.imag.mean()), abs=3e-5)
    np.testing.assert_allclose(turned[0], np.cov(seen.real, seen.imag), rtol=0.02, atol=3e-8)
    assert np.linalg.det(turned[0]) == pytest.approx(np.linalg.det(covariance[0]))


def test_the_part_of_the_calibration_stands_apart():
    table = made()
    assert table["e_q_sys"][0] == pytest.approx(0.0012)  # 0.0020² = 0.0016² + 0.0012²
    assert table["e_u_sys"][0] == pytest.approx(0.0024)
    assert table["cov_qu_sys"][0] == pytest.approx(0.6e-6)
    assert table["JD"][0] == 2461041.75


@pytest.mark.parametrize("end", ["vot", "fits", "ecsv"])
def test_others_read_it(end, tmp_path):
    table = made()
    path = tmp_path / f"t.{end}"
    write_table(path, table)
    read = Table.read(path)
    assert (
        read.colnames
        == list(table.colnames)
        == [name for name in columns() if name not in ("Gmag", "Plx", "e_Plx")]
    )
    assert all(read[name].description for name in read.colnames)
    assert {name for name in read.colnames if read[name].unit is None} == {
        n for n in table.colnames if not columns()[n].unit
    }
    assert read["GaiaID"].tolist() == result()["SOURCE_ID"].tolist()
    np.testing.assert_array_equal(read["q"], table["q"])
    assert check_common_table(path) == ()
    frame = read.to_pandas()
    assert len(frame) == 40
    assert frame["PA"].between(0, 180).all()


def test_the_votable_is_valid_with_ucds_and_conventions(tmp_path):
    write_table(tmp_path / "t.vot", made())
    told = io.StringIO()
    assert validate(str(tmp_path / "t.vot"), output=told), told.getvalue()
    file = parse(tmp_path / "t.vot", verify="exception")
    table = file.get_first_table()
    assert all(field.ucd and field.description for field in table.fields)
    words = {param.name: param.value for param in table.params}
    assert (words["POLCCONV"], words["TIMESYS"], words["CALHASH"]) == ("IAU", "UTC", "abc")
    assert file.resources[0].time_systems[0].timescale == "UTC"


def test_parquet_holds_it(tmp_path):
    pytest.importorskip("pyarrow")
    write_table(tmp_path / "t.parquet", made())
    assert check_common_table(tmp_path / "t.parquet") == ()


def test_parquet_without_its_library_is_advised_on(tmp_path, monkeypatch):
    def lacking(*_, **__):
        raise ModuleNotFoundError("no", name="pyarrow")

    monkeypatch.setattr(Table, "write", lacking)
    with pytest.raises(
        DataError, match=r"needs pyarrow, which is not installed; pip install 'walop-jax\[parquet\]'"
    ):
        write_table(tmp_path / "t.parquet", made())


def test_stars_are_rows_once_and_those_without_a_result_are_left_out():
    table = result()
    for name in table.colnames[6:]:
        table[name][1] = table[name][0]  # a second row of the first star
    table["Q"][5] = np.nan
    table["ROTATOR"][6] = np.nan
    made, said = common_table(in_memory(table))
    assert len(made) == 37
    assert "1 rows without a result are left out" in said
    assert any("1 rows in the frame of the instrument" in text for text in said)
    table.remove_column("RA")
    with pytest.raises(DataError, match="RA: the column is missing"):
        common_table(in_memory(table))
    with pytest.raises(DataError, match=r"QU_PHOTON: .* from walop-jax apply"):
        common_table(in_memory({"RA": [1.0], "DEC": [1.0]}))


def test_one_rotator_for_a_field_far_from_the_equator_is_remarked_on():
    table = result()
    table["RA"], table["DEC"], table["ROTATOR"] = 10.0 + np.linspace(-0.5, 0.5, 40), -60.0, 0.0
    assert any(
        "refer to north at the field centre, up to 0.43 deg" in text
        for text in common_table(in_memory(table))[1]
    )


@pytest.mark.parametrize(
    ("ra", "dec", "message"),
    [
        (
            lambda ra: (100.0 + ra / 360.0) / 15.0,
            lambda dec: dec / 100.0,
            "RA: lies between .* looks like hours",
        ),
        (lambda ra: ra + 400.0, lambda dec: dec, "RA: is beyond ±360°"),
        (lambda ra: ra, lambda dec: dec + 200.0, "DEC: is beyond ±90°"),
    ],
)
def test_positions_that_are_none_are_refused(ra, dec, message):
    table = result()
    table["RA"], table["DEC"] = ra(table["RA"]), dec(table["DEC"])
    with pytest.raises(DataError, match=message):
        common_table(in_memory(table))


def test_sexagesimal_and_unknown_positions():
    """6h30m is 97.5 deg; a star without a position is no row, and unknown identifiers are no numbers of others."""
    table = result()
    table.replace_column("RA", ["", *39 * ["06:30:00"]])
    table.replace_column("DEC", 40 * ["-44:30:00"])
    table["SOURCE_ID"] = MaskedColumn(table["SOURCE_ID"], mask=np.arange(40) == 1)
    made, said = common_table(in_memory(table))
    np.testing.assert_allclose(made["RAJ2000"], 97.5)
    np.testing.assert_allclose(made["DEJ2000"], -44.5)
    assert made["GaiaID"].tolist()[:2] == [-1, 4_000_000_000_000_000_002]
    assert len(made) == 39
    assert "1 rows without RA and DEC are left out" in said


FAULTS = {
    "PA: not half the angle": lambda t: t["u"].__imul__(-1),  # the sign of COSMO
    "Pol: not the length": lambda t: t["Pol"].__imul__(100),
    "more than 1: in per cent": lambda t: [t[n].__imul__(100) for n in ("q", "u")],
    "e_q, e_u: not above 0": lambda t: t["e_q"].__imul__(0),
    "cov_qu: larger": lambda t: t["cov_qu"].__imul__(100),
    "PA_gal: not PA": lambda t: t["PA_gal"].__iadd__(10),
    "q_gal, u_gal": lambda t: t["u_gal"].__imul__(-1),
    "RAJ2000, DEJ2000: no direction": lambda t: t["DEJ2000"].__imul__(100),
    "GLON, GLAT": lambda t: t["GLON"].__iadd__(1),
    "e_q_sys, e_u_sys": lambda t: t["e_u_sys"].__imul__(2),
    "e_PA: the column is missing": lambda t: t.remove_column("e_PA"),
    "PA: the unit is rad": lambda t: setattr(t["PA"], "unit", "rad"),
    "q: has no description": lambda t: setattr(t["q"], "description", ""),
    "POLCCONV is COSMO": lambda t: t.meta.update(POLCCONV="COSMO"),
    "'phys.polarisation' is no UCD": lambda t: t["Pol"].meta.update(ucd="phys.polarisation"),
}


@pytest.mark.parametrize("what", FAULTS)
def test_a_fault_is_named(what):
    table = made()
    FAULTS[what](table)
    assert any(what in text for text in check_common_table(table))

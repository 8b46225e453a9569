"""Quality numbers of a night: closed forms of standards; a table that grows by nights; limits."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Column, Table
from small_run import small_fit

import walop_jax as walop
from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.refit import refit
from walop_jax.io.errors import DataError
from walop_jax.io.folder import locked
from walop_jax.reports.survey_figures import quality_figure
from walop_jax.science.quality import (
    QualityRow,
    Standard,
    append,
    judge,
    numbers_of,
    quality_row,
    read_limits,
    standards,
    table_of_nights,
)

TINY = np.diag([1e-8, 1e-8])


def star(p: float, angle: float, measured_p: float, measured_angle: float) -> Standard:
    """A standard that is catalogued and measured at p and angle (deg)."""
    pairs = ((p, angle), (measured_p, measured_angle))
    q = [np.array([r * np.cos(2 * np.deg2rad(a)), r * np.sin(2 * np.deg2rad(a))]) for r, a in pairs]
    return Standard("S", q[1], TINY, q[0], np.full(2, 1e-8))


def test_angle_and_p_of_standards_that_are_turned_and_weakened():
    """All angles larger by 0.3 deg, p smaller by 2 %: told so; weights go with p squared, errors as 1/(2p)."""
    found = numbers_of([star(0.05, 20.0, 0.049, 20.3), star(0.02, 100.0, 0.0196, 100.3)])
    assert found["ANGLE"] == pytest.approx(0.98 * 0.3, abs=1e-4)
    assert found["P_RATIO"] == pytest.approx(0.98, abs=1e-4)
    each = np.rad2deg(0.5 * np.sqrt(2e-8) / np.array([0.05, 0.02]))
    assert found["ANGLE_ERR"] == pytest.approx(np.sum(each**-2.0) ** -0.5, rel=1e-12)
    assert (found["NSTD"], found["NZERO"]) == (2, 0)
    assert np.isnan(found["ZERO_Q"])


def test_zeros_show_what_is_added_to_all():
    zeros = [Standard("Z", np.array([0.001, -0.002]), TINY, np.zeros(2), np.full(2, 1e-8)) for _ in range(4)]
    found = numbers_of(zeros)
    assert (found["ZERO_Q"], found["ZERO_U"]) == pytest.approx((0.001, -0.002), abs=1e-15)
    assert found["ZERO_ERR"] == pytest.approx(np.sqrt(2e-8 / 4), rel=1e-12)
    assert found["STDCHI2"] == pytest.approx((0.001**2 + 0.002**2) / 2e-8 / 2)


def test_a_standard_is_measured_without_its_own_catalogue_value():
    """Fitted again with a prior a thousand times wider, the star comes out where the formula says."""
    fit = small_fit()
    stars = {one.name: one for one in standards(Calibration.from_fit(fit))}
    name = next(iter(stars))
    model = fit.model
    for axis in "qu":
        mean, width = model[f"{name}.{axis}"].prior
        model = model.change(f"{name}.{axis}", prior=(mean, 1000.0 * width))
    free = refit(fit.calset, model)
    at = [model.index(f"{name}.{axis}") for axis in "qu"]
    error = np.sqrt(np.diag(stars[name].covariance))
    np.testing.assert_allclose(stars[name].measured, free.values[at], atol=0.02 * error.min())
    np.testing.assert_allclose(error, np.sqrt(np.diag(free.covariance[np.ix_(at, at)])), rtol=0.02)


@pytest.fixture(scope="module")
def row() -> dict:
    return quality_row(Calibration.from_fit(small_fit()), "RUN", {"median": 2e-4, "hidden": None})


def night(row: dict, number: int, **changes) -> dict:
    return row | {"NIGHT": 61220.0 + number, "CALHASH": f"{number}", "RUN": f"N{number}"} | changes


def test_the_row_of_a_run(row):
    assert row["NIGHT"] == 61220.0
    assert row["CHI2DOF"] == pytest.approx(small_fit().chi2 / small_fit().dof)
    assert sum(value for name, value in row.items() if name.startswith("GAIN_")) == pytest.approx(4.0)
    assert row["FILTERS"] == "SDSS-r"
    assert np.isnan(row["HIDDEN"])


def test_nights_are_added_once_and_replaced(row, tmp_path: Path):
    file, limits = tmp_path / "q.ecsv", read_limits()
    for number in (2, 1, 3):
        table, remarks = append(file, table_of_nights([night(row, number)]), limits)
        assert remarks == []
    assert table["NIGHT"].tolist() == [61221.0, 61222.0, 61223.0]
    before = file.read_bytes()
    table, remarks = append(file, table_of_nights([night(row, 2)]), limits)
    assert file.read_bytes() == before
    assert remarks == ["N2: this calibration is in the table already"]
    table, remarks = append(file, table_of_nights([night(row, 2, CALHASH="again", RUN="B")]), limits)
    assert table["RUN"].tolist() == ["N1", "B", "N3"]
    assert remarks == ["B: takes the place of N2 in night 61222"]
    assert Table.read(file)["ANGLE"].unit == "deg"


@pytest.mark.parametrize("end", ["ecsv", "csv", "fits", "vot"])
def test_a_table_of_any_format_is_added_to(row, tmp_path: Path, end):
    """Truth values, names and numbers of a text are what they were; nights without a time take no other's place."""
    file, limits = tmp_path / f"q.{end}", read_limits()
    append(file, table_of_nights([night(row, 2, ANGLE=0.0, FILTERS="NB-580,SDSS-r")]), limits)
    append(file, table_of_nights([night(row, 1, ANGLE=0.0, TRUSTED=False)]), limits)
    for number in (3, 4):
        table, remarks = append(file, table_of_nights([night(row, number, ANGLE=0.0, NIGHT=np.nan)]), limits)
        assert remarks == []
    assert table["RUN"].tolist() == ["N1", "N2", "N3", "N4"]
    assert table["TRUSTED"].tolist() == [False, True, True, True]
    assert table["FILTERS"].tolist()[1] == "NB-580,SDSS-r"
    assert table["OUTSIDE"].tolist() == ["TRUSTED", "", "", ""]
    assert append(file, table_of_nights([night(row, 4)]), limits)[1] == [
        "N4: this calibration is in the table already"
    ]


def test_a_table_in_other_units_is_converted(row, tmp_path: Path):
    file, limits = tmp_path / "q.ecsv", read_limits()
    append(file, table_of_nights([night(row, 1, ANGLE=0.01, ANGLE_ERR=0.001)]), limits)
    table = Table.read(file)
    for name in ("ANGLE", "ANGLE_ERR"):
        table[name] = Column(60.0 * table[name].data, unit="arcmin")
    table["COMMENT"] = "wind"
    table.write(file, overwrite=True)
    table, _ = append(file, table_of_nights([night(row, 2, ANGLE=0.02)]), limits)
    assert table["ANGLE"].tolist() == pytest.approx([0.01, 0.02])
    assert table["ANGLE"].unit == "deg"
    assert table["COMMENT"].tolist() == ["wind", None]


def test_gains_are_held_against_those_of_their_instrument_and_filters(row):
    rows = [
        night(row, n, INSTRUME=name, GAIN_O1=gain, ANGLE=0.0)
        for n, (name, gain) in enumerate([("A", 1.0), ("B", 1.3), ("A", 1.0), ("B", 1.3), ("A", 1.1)])
    ]
    found = judge(table_of_nights(rows), read_limits())["OUTSIDE"].tolist()
    assert found == ["", "", "", "", "GAIN_O1"]


def test_two_processes_do_not_lose_a_night(row, tmp_path: Path):
    file = tmp_path / "q.ecsv"
    with (
        locked(tmp_path / ".walop-quality-q.ecsv-lock", file),
        pytest.raises(DataError, match="is being written by"),
    ):
        append(file, table_of_nights([night(row, 1)]), read_limits())


def test_numbers_outside_their_limits_are_named(row):
    limits = read_limits()
    rows = [
        night(row, 1, ANGLE=0.0),
        night(row, 2, ANGLE=0.3, ANGLE_ERR=0.02),
        night(row, 3, ANGLE=0.3, ANGLE_ERR=0.2, CHI2DOF=2.0, GAIN_E1=1.05 * row["GAIN_E1"]),
        night(row, 4, ANGLE=0.0, TRUSTED=False, ZERO_U=-0.01),
    ]
    found = judge(table_of_nights(rows), limits)["OUTSIDE"].tolist()
    assert found == ["", "ANGLE", "CHI2DOF GAIN_E1", "ZERO_U TRUSTED"]


def test_limits_of_a_file(tmp_path: Path):
    file = tmp_path / "limits.toml"
    file.write_text("ANGLE = [-1.0, 1.0]\n")
    assert read_limits(file)["ANGLE"] == (-1.0, 1.0)
    assert read_limits(file)["GAIN"] == read_limits()["GAIN"]
    for text, message in (
        ("ANGEL = [0, 1]", "ANGLE"),
        ("ANGLE = [1, 0]", "lowest"),
        ("ANGLE = 1", "two numbers"),
    ):
        file.write_text(text)
        with pytest.raises(DataError, match=f"limits.toml.*{message}"):
            read_limits(file)


def test_other_tables_are_left_alone(row, tmp_path: Path):
    file = tmp_path / "stars.ecsv"
    Table({"X": [1.0]}).write(file)
    before = file.read_bytes()
    with pytest.raises(DataError, match="no table of quality numbers"):
        append(file, table_of_nights([row]), read_limits())
    assert file.read_bytes() == before


def test_a_table_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path):
    """Before the run, which is not there, is asked for."""
    with pytest.raises(DataError, match="QUALITY: has no extension of a table"):
        walop.check(tmp_path / "NO-RUN", append=tmp_path / "QUALITY")
    with pytest.raises(DataError, match="does not exist; create it first"):
        walop.check(tmp_path / "NO-RUN", append=tmp_path / "there" / "q.ecsv")


def test_the_figure_shows_every_night(row):
    table = judge(table_of_nights([night(row, k) for k in range(5)]), read_limits())
    figure = quality_figure(table, read_limits())
    assert len(figure.axes) == 6
    assert figure.axes[0].get_xlim()[1] > 61224.0 - 40587  # days since 1970
    figure.draw_without_rendering()
    q, u = (container.lines[0] for container in figure.axes[2].containers)
    at = [line.get_transform().transform(line.get_xydata()) for line in (q, u)]
    aside = at[1][:, 0] - at[0][:, 0]
    assert np.all(aside > q.get_markersize() * figure.dpi / 72.0)  # neither hides the other
    undated = judge(table_of_nights([night(row, k, NIGHT=np.nan) for k in range(2)]), read_limits())
    quality_figure(undated, read_limits()).draw_without_rendering()


def test_a_run_from_disk_and_one_in_memory_give_one_row(tmp_path: Path):
    fit = small_fit()
    fit.save(tmp_path / "RUN")
    for run in (tmp_path / "RUN", fit, dataclasses.replace(fit)):
        answer = walop.check(run, append=tmp_path / "q.ecsv", output=tmp_path / "OUT", overwrite=True)
        assert len(answer["quality"].table) == 1
        assert answer["quality"].mine["CHI2DOF"] == pytest.approx(fit.chi2 / fit.dof)
    assert (tmp_path / "OUT" / "quality.png").stat().st_size > 10_000
    assert len(Table.read(tmp_path / "q.ecsv")) == 1


def test_numbers_outside_their_limits_are_reasons_with_what_they_do_to_stars(row, tmp_path: Path):
    """An angle off by 0.3° turns 5 % of polarisation by 2 · 0.05 · 0.3°; a zero of 1 % is 1 %."""
    limits = read_limits()
    odd = night(row, 1, ANGLE=0.3, ANGLE_ERR=0.02, ZERO_U=-0.01, TRUSTED=False)
    table, _ = append(tmp_path / "q.ecsv", table_of_nights([odd]), limits)
    found = QualityRow(table, table[0], limits, None)
    angle, zero, trusted = found.against
    assert angle.off == pytest.approx(0.1 * np.deg2rad(0.3))
    assert angle.what.startswith("night 61221: ANGLE = 0.300 ± 0.020 deg, allowed −0.2 to 0.2 deg")
    assert "ROTATOR" in angle.cure
    assert zero.off == pytest.approx(0.01)
    assert trusted.off is None
    assert all(one.blocking for one in found.against)
    quiet = dataclasses.replace(found, mine=judge(table_of_nights([night(row, 1, ANGLE=0.0)]), limits)[0])
    assert quiet.against == ()

"""`matrix` and `apply` of tables: what cannot be carried over, what is refused, what is forced."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import walop_jax as walop
from walop_jax.calibration.product import write_calibration
from walop_jax.data.user_tables import in_memory
from walop_jax.fit.verdict import Quality
from walop_jax.io.errors import DataError
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import nominal_instrument
from walop_jax.science.field_points import field_points

from .conftest import FittedSet

POINTS = "X,Y\n0,0\n0.2,-0.1\n0.33,0\n"


@pytest.fixture
def points(tmp_path: Path) -> Path:
    path = tmp_path / "points.csv"
    path.write_text(POINTS)
    return path


@pytest.fixture
def catalogue(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    counts = rng.normal(1e6, 1e3, (6, 4))
    counts[0] = 0.0
    x, y = rng.uniform(-0.2, 0.2, (2, 6))
    table = Table({"ID": np.arange(6), "X": x, "Y": y, "N": counts, "N_ERR": np.full((6, 4), 1e3)})
    table.write(tmp_path / "stars.fits")
    return tmp_path / "stars.fits"


@pytest.fixture
def drifting(fitted: FittedSet, tmp_path: Path) -> Path:
    """The folder of a run whose model has a drift of single exposures, at the values of the fit."""
    old = fitted.calibration
    context = effect_context(old.model.template, old.exposures)
    model = with_effects(old.model, ["camera_gain_drift"], context)
    place = np.array([model.index(name) for name in old.model.names])
    values, covariance = model.start.copy(), np.zeros((len(model.names),) * 2)
    values[place], covariance[np.ix_(place, place)] = old.values, old.covariance
    changed = dataclasses.replace(old, model=model, values=values, covariance=covariance)
    (tmp_path / "RUN").mkdir()
    write_calibration(tmp_path / "RUN" / "calibration.fits", changed)
    return tmp_path / "RUN"


@pytest.mark.long
def test_effects_that_cannot_be_carried_over_are_named(
    call, fitted: FittedSet, drifting: Path, points: Path, catalogue: Path, tmp_path: Path
):
    """In a warning, in the document and in the header; the rest is what it is without them."""
    for name, words in (("matrix", ("--points", points)), ("apply", (catalogue,))):
        done = call(name, drifting, *words, "-o", tmp_path / "o.fits", "--overwrite", "--json")
        plain = call(name, fitted.run, *words, "-o", tmp_path / "plain.fits", "--overwrite", "--json")
        assert json.loads(done.stdout)["not_carried_over"] == ["camera_gain_drift"]
        assert "camera_gain_drift" in done.stderr
        assert "left out" in done.stderr
        assert json.loads(plain.stdout)["not_carried_over"] == []
        one, other = Table.read(tmp_path / "o.fits"), Table.read(tmp_path / "plain.fits")
        assert one.meta["NOTCARR"] == "camera_gain_drift"
        assert "NOTCARR" not in other.meta
        column = "M22" if name == "matrix" else "Q"
        np.testing.assert_allclose(one[column], other[column], rtol=0, atol=1e-12)
    result = call("trace", drifting, "--json")
    assert "camera_gain_drift" in result.stderr
    assert json.loads(result.stdout)["not_carried_over"] == ["camera_gain_drift"]


def test_what_cannot_be_is_said_before_any_work(fitted: FittedSet, catalogue: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="'MLE' is neither MAS nor WK"):
        walop.apply(tmp_path / "none.fits", catalogue, debias="MLE")
    with pytest.raises(ValueError, match="above 0"):
        walop.apply(tmp_path / "none.fits", catalogue, saturation=-1.0)
    with pytest.raises(DataError, match="no such file"):
        walop.apply(tmp_path / "none.fits", catalogue, output=tmp_path / "o.fits")
    with pytest.raises(DataError, match="no such file"):
        walop.matrix(fitted.run / "other.fits", points=catalogue, output=tmp_path / "o.fits")


def test_a_column_that_does_not_exist_is_no_setting(fitted: FittedSet):
    """It was added to the table, and the temperature stayed as it was."""
    with pytest.raises(TypeError, match="there is no argument 'temperature'"):
        walop.matrix(fitted.run, 0.1, 0.1, temperature=4)
    assert walop.matrix(fitted.run, points={"X": 0.1, "Y": 0.1, "TEMP": 4})["TEMP"] == 4


def test_a_filter_that_the_calibration_does_not_cover_is_refused_unless_forced(
    call, fitted: FittedSet, catalogue: Path, tmp_path: Path
):
    """The curve of a second filter is in the product, but none of its exposures was taken in it."""
    curves = {"r2": fitted.calibration.filter_curve("SDSS-r"), **fitted.calibration.filters}
    wider = dataclasses.replace(fitted.calibration, filters=curves)
    write_calibration(tmp_path / "calibration.fits", wider)
    table = Table.read(catalogue)
    table["FILTER"] = np.where(np.arange(6) == 3, "r2", "SDSS-r")
    table.write(other := tmp_path / "other.fits")
    arguments = ("apply", tmp_path, other, "-o", tmp_path / "o.fits")
    refused = call(*arguments)
    assert refused.exit_code == 1
    assert (
        "other.fits: FILTER: row 3 (counted from 0): r2; the calibration was made in SDSS-r" in refused.stderr
    )
    assert not (tmp_path / "o.fits").exists()
    forced = call(*arguments, "--force")
    assert forced.exit_code == 3, forced.stderr  # the intensities are round numbers, which no star has
    flag = Table.read(tmp_path / "o.fits")["FLAG"]
    both = int(Quality.VALIDITY_FORCED | Quality.BEYOND_SETTINGS)
    assert (flag & both).tolist() == [0, 0, 0, both, 0, 0]


def test_a_point_beyond_the_field_is_refused_and_bits_have_words(call, fitted: FittedSet):
    refused = call("matrix", fitted.run, "--x", "3", "--y", "1")
    assert refused.exit_code == 1
    assert "X, Y: beyond the field of WALOP-SOUTH (±0.35°); give degrees; are these arcmin?" in refused.stderr
    shown = str(walop.matrix(fitted.calibration, x=0.34, y=0.34))
    assert "FLAG 32: extrapolated in the field" in shown


def test_an_angle_that_is_missing_is_asked_for_as_it_can_be_given():
    instrument = nominal_instrument("WALOP-SOUTH")
    with pytest.raises(DataError, match=r"--at CHWP=0"):
        field_points(in_memory({"X": 0.0, "Y": 0.0}), instrument, always_in=("CHWP",))


def test_columns_that_are_not_used_or_replaced_are_named(call, fitted: FittedSet, tmp_path: Path):
    given = Table({"x": [0.1], "Y": [0.0], "FLAG": [3], "mag": [12.5]})
    given.write(tmp_path / "p.csv")
    told = call("matrix", fitted.run, "--points", tmp_path / "p.csv", "-o", tmp_path / "o.fits", "--json")
    assert told.exit_code == 0, told.output
    expected = ["column FLAG is replaced by the result", "column MAG is not used"]
    assert json.loads(told.stdout)["remarks"] == expected
    assert Table.read(tmp_path / "o.fits").meta["REMARK"] == expected
    for sentence in expected:
        assert f"p.csv: {sentence}" in told.stderr
    made = walop.matrix(fitted.calibration, points=given)
    made["x"] *= 60.0
    assert given["x"][0] == 0.1


def test_columns_of_the_call_add_to_a_table_of_any_form(fitted: FittedSet, tmp_path: Path):
    """A setting for all rows beside a table: its remarks and header stay, and its form does not matter."""
    table = Table({"X": [0.1, 0.2], "Y": [0.0, 0.1], "NOTE": [1, 2]}, meta={"OBSERVER": "me"})
    wanted = walop.matrix(fitted.calibration, points=table, teff=4000.0)
    assert wanted.meta["OBSERVER"] == "me"
    for given in (table.as_array(), table.to_pandas(), {name: table[name] for name in table.colnames}):
        found = walop.matrix(fitted.calibration, points=given, teff=4000.0)
        np.testing.assert_array_equal(found["M21"], wanted["M21"])
    (tmp_path / "t.csv").write_text("X;Y\n0,1;0,0\n0,2;0,1\n")
    found = walop.matrix(fitted.calibration, points=tmp_path / "t.csv", teff=4000.0)
    np.testing.assert_array_equal(found["M21"], wanted["M21"])
    assert "columns are separated by semicolons, decimals by commas" in found.meta["REMARK"]

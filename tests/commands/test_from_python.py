"""The commands as functions: they take what astronomers have, and give what the commands give."""

from __future__ import annotations

import dataclasses
import logging
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy import units
from astropy.table import QTable, Table
from small_run import small_fit

import walop_jax as walop
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import write_calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.io.errors import DataError

from .conftest import FittedSet

OWN = '''
import walop_jax as walop


class LateZero(walop.Effect):
    """Zero point of the polariser, called by another name."""

    angle: walop.Scalar = walop.param(unit="deg", about="added", source="a test", width=0.3, default=0.0)
    name = "late_zero"

    def patch(self, instrument):
        return instrument.changed("polariser", zero=lambda zero: self.angle + (0.0 if zero is None else zero))
'''


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return Calibration.from_fit(small_fit())


def test_read_gives_what_a_path_holds(fitted):
    assert isinstance(walop.read(fitted.calset), CalibrationSet)
    assert isinstance(walop.read(fitted.run / "calibration.fits"), Calibration)
    run = walop.read(fitted.run)
    assert isinstance(run, walop.Run)
    np.testing.assert_array_equal(run.calibration.values, fitted.calibration.values)
    assert run.documents["summary"]["instrument"] == "WALOP-SOUTH"
    assert repr(run).splitlines()[0].endswith("WALOP-SOUTH: go")


@pytest.mark.parametrize(
    ("name", "message"),
    [("set.csv", "is not a calibration set"), ("", "holds no results"), ("absent.fits", "no such file")],
)
def test_read_says_what_a_path_is_not(tmp_path, name, message):
    (tmp_path / "set.csv").write_text("X,Y\n1,2\n")
    with pytest.raises(walop.DataError, match=message):
        walop.read(tmp_path / name)


def test_a_folder_or_a_product_is_no_set(fitted):
    with pytest.raises(walop.DataError, match=f"is a folder; .*; walop-jax report {fitted.run} shows a"):
        walop.refit(fitted.run)
    with pytest.raises(walop.DataError, match="calibration product"):
        walop.refit(fitted.run / "calibration.fits")


# --------------------------------------------------------------------------------------------- the matrix


def test_positions_may_be_quantities_scalars_and_big_endian(calibration):
    expected, covariance = calibration.matrix(np.array([0.1]), np.array([0.2]))
    for x, y in ((0.1, 0.2), (6 * units.arcmin, 0.2), (np.float64(0.1), 720 * units.arcsec)):
        m, c = calibration.matrix(x, y)
        np.testing.assert_allclose(m, expected[0], rtol=1e-10)
        np.testing.assert_allclose(c, covariance[0], rtol=1e-8)
    column = Table({"X": np.array([0.1], ">f8")})["X"]
    np.testing.assert_array_equal(calibration.matrix(column, [0.2])[0], expected)
    with pytest.raises(walop.DataError, match="'m' cannot be converted"):
        calibration.matrix(1 * units.m, 0.2)


def test_beyond_the_field_there_is_nothing(calibration):
    m, c = calibration.matrix([0.1, 0.5], [0.2, 0.2])
    assert np.isfinite(m[0]).all()
    assert np.isnan(m[1]).all()
    assert np.isnan(c[1]).all()
    table = walop.matrix(calibration, [0.1, 0.5], 0.2)
    assert np.isfinite(table["M21"][0])
    assert np.isnan(table["M21"][1])
    assert table["FLAG"][1] & 32
    with pytest.raises(DataError, match="beyond the field"):
        walop.matrix(calibration, 0.5, 0.2)


def test_matrix_is_the_table_of_the_command(call, fitted, tmp_path):
    points = tmp_path / "points.ecsv"
    QTable({"X": [6.0, -3.0] * units.arcmin, "Y": [0.2, 0.1] * units.deg, "TEFF": [5000.0, 6000.0]}).write(
        points
    )
    result = call("matrix", fitted.run, "--points", points, "-o", tmp_path / "out.ecsv", "--quiet")
    assert result.exit_code == 0, result.output
    expected = Table.read(tmp_path / "out.ecsv")
    for given in (points, Table.read(points), QTable.read(points)):
        found = walop.matrix(fitted.run, points=given)
        assert found.colnames == expected.colnames
        np.testing.assert_array_equal(found["M32_ERR"], expected["M32_ERR"])
    found = walop.matrix(fitted.run, [6, -3] * units.arcmin, [0.2, 0.1] * units.deg, teff=[5000, 6000])
    np.testing.assert_allclose(found["M32"], expected["M32"], rtol=1e-12)
    one = walop.matrix(fitted.run, [0.1, 0.2], 0.1, filter="SDSS-r")
    assert len(one) == 2


# ---------------------------------------------------------------------------------------------- and others


def test_apply_is_the_table_of_the_command(call, fitted, tmp_path):
    n = np.array([[2.1e5, 1.9e5, 2e5, 2e5], [1.9e5, 2.1e5, 2e5, 2.1e5]])
    # By photon noise alone, stars of these counts would contradict the calibration.
    errors = 10.0 * np.sqrt(n)
    stars = Table({"X": [0.1, 0.2], "Y": [0.0, 0.1], "N": n, "N_ERR": errors})
    stars.write(tmp_path / "stars.fits")
    result = call("apply", fitted.run, tmp_path / "stars.fits", "-o", tmp_path / "out.fits", "--quiet")
    assert result.exit_code == 0, result.output
    expected, found = Table.read(tmp_path / "out.fits"), walop.apply(fitted.run, stars)
    for name in ("Q", "U_ERR", "P", "FLAG"):
        np.testing.assert_array_equal(found[name], expected[name])
    stars.write(tmp_path / "stars.vot", format="votable")
    result = call("apply", fitted.run, tmp_path / "stars.vot", "-o", tmp_path / "out.vot", "--quiet")
    assert result.exit_code == 0, result.output
    np.testing.assert_array_equal(Table.read(tmp_path / "out.vot")["Q"], expected["Q"])
    assert found.meta["CALHASH"] == expected.meta["CALHASH"]
    cameras = {f"N{k}": n[:, k] for k in range(4)} | {f"N_ERR{k}": errors[:, k] for k in range(4)}
    split = walop.apply(fitted.run, {"X": [0.1, 0.2], "Y": [0.0, 0.1]} | cameras)
    np.testing.assert_array_equal(split["Q"], found["Q"])


@pytest.mark.long
def test_limits_as_a_table():
    zero = walop.effect_by_name("clp_zero")
    table = walop.limits(small_fit(), effects=(zero,)).to_table()
    assert table["EFFECT"].tolist() == ["clp_zero"]
    assert 0 < table["DETECTED"][0, 0] < 0.1  # deg


def test_calls_are_logged_and_silent_otherwise(fitted, caplog, capsys):
    with caplog.at_level(logging.INFO, logger="walop_jax"):
        walop.inspect(fitted.calset)
    assert ("walop_jax", logging.INFO, f"reading {fitted.calset}") in caplog.record_tuples
    assert capsys.readouterr() == ("", "")


def test_data_that_have_moved_can_be_named(fitted, tmp_path, monkeypatch):
    """A run without its data says so; other data are refused; the data under another name will do."""
    monkeypatch.chdir(tmp_path)
    Path("a").mkdir()
    product = shutil.copy(fitted.run / "calibration.fits", "a")
    held = walop.read(product)
    lost = tuple(dataclasses.replace(entry, path=Path("lost.fits")) for entry in held.inputs)
    write_calibration(product, dataclasses.replace(held, inputs=lost), overwrite=True)
    with pytest.raises(walop.DataError, match=r"lost.fits: cannot be found.*--data FILE"):
        walop.plot("a", "modulation")
    moved = shutil.copy(fitted.calset, "moved.fits")
    assert len(walop.plot("a", "modulation", data=[moved]).axes) == 2
    walop.write_calibration_set("other.fits", dataclasses.replace(small_fit().calset, origin="elsewhere"))
    with pytest.raises(walop.DataError, match="not the data of the fit"):
        walop.plot("a", "modulation", data=["other.fits"])


@pytest.mark.long
def test_an_effect_of_ones_own_from_a_file(call, fitted, tmp_path):
    own, model = tmp_path / "own.py", tmp_path / "model.toml"
    own.write_text(OWN)
    made = call("model", fitted.calset, "--effect", "late_zero", "--effects", own, "-o", model)
    assert made.exit_code == 0, made.output
    run = tmp_path / "RUN"
    result = call("refit", fitted.calset, "--model", model, "--effects", own, "-o", run, "--quiet")
    assert result.exit_code == 0, result.output
    without = call("check", run)
    assert without.exit_code == 3
    assert "late_zero" in without.output
    assert "--effects" in without.output
    assert call("check", run, "--effects", own).exit_code == 0
    catalogue = (
        *walop.EFFECTS,
        walop.read(run, effects=_own(own)).calibration.model.template.effects[0].__class__,
    )
    assert catalogue[-1].name == "late_zero"


def _own(path):
    from walop_jax.model.effects.catalogue import catalogue_with

    return catalogue_with(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "defines no effect"),
        ("1/0", "ZeroDivisionError"),
        (OWN.replace('"late_zero"', '"clp_zero"'), "name of another effect"),
        (OWN.replace('name = "late_zero"', "pass"), "no name"),
    ],
)
def test_files_of_effects_that_are_none(tmp_path, text, message):
    (tmp_path / "own.py").write_text(text)
    with pytest.raises(walop.DataError, match=message):
        _own(tmp_path / "own.py")


def test_results_go_through_pickle_into_another_process(fitted: FittedSet, tmp_path: Path):
    """A fit held a function that no pickle takes, and what came out in a fresh process had lost half its digits."""
    result = walop.refit(fitted.calset)
    whole = {
        "fit": result,
        "product": fitted.calibration,
        "run": walop.read(fitted.run),
        "model": result.model,
    }
    for name, one in whole.items():
        (tmp_path / f"{name}.pkl").write_bytes(pickle.dumps(one))
    code = (
        "import pickle, sys\n"
        "fit, product, run, model = (pickle.load(open(f'{name}.pkl', 'rb')) for name in sys.argv[1:])\n"
        "import walop_jax as walop\n"
        "for one in (fit, product, run):\n    print(repr(walop.matrix(one, x=0.1, y=-0.2)['M22'][0].item()))\n"
        "print(repr(float(model.start[0])))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    told = subprocess.run(
        [sys.executable, "-c", code, *whole],
        check=False,
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert told.returncode == 0, told.stderr
    expected = [walop.matrix(whole[name], x=0.1, y=-0.2)["M22"][0] for name in ("fit", "product", "run")]
    np.testing.assert_allclose(
        [float(line) for line in told.stdout.split()], [*expected, result.model.start[0]], rtol=1e-11
    )


def test_nights_of_a_survey_have_their_standards_in_common():
    tiny = walop.ObservingPlan(grid=2, standard_grid=1, moon_patches=0, standards=3)
    first, second, other = (
        walop.simulate(tiny, seed=seed, catalogue_seed=stars) for seed, stars in ((1, 7), (2, 7), (2, None))
    )
    np.testing.assert_array_equal(first.calset.sources.q, second.calset.sources.q)
    assert not np.array_equal(first.calset.intensities.counts, second.calset.intensities.counts)
    assert not np.array_equal(first.calset.sources.q[2:], other.calset.sources.q[2:])
    (_, mgf2) = first.truth.element("half2.plate").layers
    assert first.values["half2.plate.mgf2"] == float(mgf2.thickness)
    assert tuple(first.values) == walop.base_model(first.calset).names


def test_a_fit_of_a_likelihood_keeps_the_factor_on_its_errors():
    """Errors of twice the size: twice the standard error where data alone decide, no more of it where priors do."""
    usual = small_fit()
    twice = walop.FitResult.of(usual.likelihood, noise_scale=2.0)
    assert twice.noise_scale == 2.0
    free = usual.model.free
    ratio = twice.sigma[free] / usual.sigma[free]
    assert 0.98 < ratio.min() < 1.1
    assert 1.9 < ratio.max() < 2.05
    assert 0.0 < np.abs((twice.values - usual.values)[free] / usual.sigma[free]).max() < 2.0
    with pytest.raises(RuntimeError, match="are not examined"):
        twice.trusted  # noqa: B018

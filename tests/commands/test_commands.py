"""The commands, run in this process: results, exit codes, and the one line that an error is."""

from __future__ import annotations

import dataclasses
import json
import os
import tomllib

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from command import one_line

import walop_jax as walop
from walop_jax.calibration.accuracy import p_errors, sample_stars
from walop_jax.calibration.product import read_calibration
from walop_jax.data.settings import Settings
from walop_jax.fit.misfit import Misfit

SUMMARY_KEYS = (
    "chi2", "dof", "n_data", "parameters", "converged", "message", "seconds", "versions", "inputs",
)  # fmt: skip


# ------------------------------------------------------------------------------------------------- refit


def test_refit_writes_product_and_summary_and_says_what_it_found(call, calset_file, tmp_path):
    run = tmp_path / "run"
    shown = call("refit", calset_file, "-o", run)
    assert "half2.plate.mgf2" in shown.stdout
    assert "χ²/dof" in shown.stdout
    reasons = json.loads((run / "summary.json").read_text())["reasons"]
    lines = shown.stdout.replace(str(tmp_path), "").splitlines()  # a path is as long as the caller's
    # The verdict tells each reason, with its remedy, in one line; all others fit into a terminal.
    long = [line for line in lines if len(line) >= 100]
    assert [line for line in long if not any(reason["what"] in line for reason in reasons)] == []
    assert "walop-jax:" not in shown.stderr  # neither an error nor a warning
    assert shown.stderr.count("walop-jax") == 2  # what to do next
    assert f"Next: walop-jax report {run} or walop-jax apply" in shown.stderr
    assert sorted(entry.name for entry in run.iterdir()) == ["calibration.fits", "summary.json"]
    summary = json.loads((run / "summary.json").read_text())
    assert list(summary)[: len(SUMMARY_KEYS)] == list(SUMMARY_KEYS)
    assert summary["converged"] is True
    assert summary["trusted"] is True
    assert 0.8 < summary["chi2"] / summary["dof"] < 1.2
    product = read_calibration(run / "calibration.fits", any_model=True)
    assert list(summary["parameters"]) == list(product.names)
    entry = summary["parameters"]["half1.plate.quartz"]
    assert entry["unit"] == "um"
    assert abs(entry["value"] - 2407.0) < 5 * entry["sigma"] + 5
    assert summary["inputs"][0]["path"] == str(calset_file)
    assert len(summary["inputs"][0]["sha256"]) == 64
    assert product.verdict.trusted
    assert summary["chi2"] == pytest.approx(product.verdict.chi2, rel=1e-12)


def test_three_reasons_against_a_fit_are_printed_and_where_the_others_are():
    misfit = Misfit({"O1": 3.0}, {"clp": 3.0}, {}, {}, {}, (3, 9.0), (4, 0.1, 0.2, 8.0), outliers=0.02)
    *reasons, rest = misfit.reasons(["residuals repeat", "errors differ", "a third"], "RUN")
    assert reasons == ["residuals repeat", "errors differ", "a third"]
    # Cameras, kinds, matrix, the worst exposure, rows that lie off.
    assert rest == "5 more, with the misfit by camera and exposure: walop-jax report RUN"


@pytest.mark.long
def test_a_misfit_is_written_but_not_trusted(call, spoilt_file, tmp_path):
    result = call("refit", spoilt_file, "-o", tmp_path / "run")
    assert result.exit_code == 3
    assert result.stdout.startswith("Fit of WALOP-SOUTH: no go: the model does not explain the data")
    assert "does not explain the data" in result.stderr
    assert result.stderr.count("warning") == 4
    assert f"walop-jax report {tmp_path / 'run'}" in result.stderr
    assert "prior only" not in result.stdout
    product = read_calibration(tmp_path / "run" / "calibration.fits", any_model=True)
    assert not product.verdict.trusted
    assert product.verdict.converged
    assert product.verdict.quality & 8192
    assert any("does not explain" in text for text in product.verdict.warnings)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["misfit"]["matrix_element"]["m22"] > 0
    # A model with the effect does explain them.
    (tmp_path / "m.toml").write_text('[model]\neffects = ["clp_wobble"]\n')
    better = call("refit", spoilt_file, "-o", tmp_path / "named", "--model", tmp_path / "m.toml", "--json")
    found = json.loads(better.stdout)
    assert found["trusted"] is True
    assert found["effects"] == ["clp_wobble"]
    assert found["parameters"]["clp_wobble.amplitude"]["value"] == pytest.approx(0.3, abs=0.05)
    cited = call("cite", tmp_path / "named").stdout
    assert "effect clp_wobble: " in cited
    # And the untrusted one says so wherever it is used.
    (tmp_path / "p.csv").write_text("X,Y\n0,0\n")
    used = call("matrix", tmp_path / "run", "--points", tmp_path / "p.csv", "-o", tmp_path / "o.csv")
    assert used.exit_code == 0
    assert "not trusted" in used.stderr


def test_outputs_that_cannot_be(call, calset_file, tmp_path, monkeypatch):
    assert "does not exist" in one_line(call("refit", calset_file, "-o", tmp_path / "no" / "run"))
    (tmp_path / "file").write_text("")
    assert "is a file" in one_line(call("refit", calset_file, "-o", tmp_path / "file"))
    monkeypatch.setattr(os, "access", lambda path, mode, **more: not mode & os.W_OK)
    assert "read-only" in one_line(call("refit", calset_file, "-o", tmp_path / "run"))
    assert "read-only" in one_line(call("model", "-o", tmp_path / "m.toml"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[model]\neffects = ["clp_woble"]', "clp_wobble"),
        ("[model", "not valid TOML"),
        (f"x = {'[' * 100000}", "nested too deep"),
        (f"x.{'y.' * 40}z = 1", "nested too deep"),
        ('[model]\ninstrument = "WALOP-NORTH"', "WALOP-SOUTH"),
    ],
)
def test_bad_model_files(call, calset_file, tmp_path, text, message):
    path = tmp_path / "m.toml"
    path.write_text(text)
    line = one_line(call("refit", calset_file, "-o", tmp_path / "run", "--model", path))
    assert message in line
    assert str(path) in line
    assert not (tmp_path / "run").exists()


def test_missing_and_alien_inputs(call, run, calset_file, tmp_path):
    assert "no such file" in one_line(call("refit", tmp_path / "none.fits", "-o", tmp_path / "run"))
    missing = one_line(call("refit", calset_file, "-o", tmp_path / "run", "--model", tmp_path / "none.toml"))
    assert "none.toml: there is no such file" in missing
    assert "calibration product" in one_line(call("refit", run / "calibration.fits", "-o", tmp_path / "run"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "args",
    [
        ("refit",),
        ("refit", "x.fits"),
        ("refti", "x"),
        ("matrix", "x", "--pionts", "y"),
        ("cite", "--sede", "1"),
    ],
)
def test_wrong_usage(call, args):
    assert call(*args).exit_code == 2


@pytest.mark.parametrize(
    ("name", "advice"), [("sample", "writes into the folder"), ("inspect", "prints its result")]
)
@pytest.mark.parametrize("option", ["-o", "--output", "--out"])
def test_commands_without_an_output_advise(call, name, advice, option):
    refused = call(name, "RUN", option, "X")
    assert refused.exit_code == 2
    assert f"{name} {advice}" in refused.stderr


# ------------------------------------------------------------------------------------------------ matrix


@pytest.mark.parametrize("suffix", [".fits", ".csv", ".ecsv"])
def test_matrix_adds_columns(call, run, tmp_path, suffix):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.28, 0.28, (2, 20))
    points = Table({"ID": np.arange(20), "X": x, "Y": y, "TEFF": np.where(np.arange(20) % 2, 5772.0, np.nan)})
    points["CHWP_IN"], points["CHWP_ANGLE"] = np.arange(20) % 3 == 0, 45.0
    points.write(tmp_path / f"points{suffix}")
    output = tmp_path / f"out{suffix}"
    result = call("matrix", run / "calibration.fits", "--points", tmp_path / f"points{suffix}", "-o", output)
    assert result.exit_code == 0, result.output
    table = Table.read(output)
    assert table.colnames[:6] == ["ID", "X", "Y", "TEFF", "CHWP_IN", "CHWP_ANGLE"]
    names = ["M21", "M22", "M23", "M31", "M32", "M33"]
    assert table.colnames[6:] == [*names, *(f"{name}_ERR" for name in names), "P_ERR", "FLAG"]
    calibration = read_calibration(run / "calibration.fits")
    settings = dataclasses.replace(
        Settings.default(20).at(CHWP=np.where(np.arange(20) % 3 == 0, 45.0, np.nan)),
        teff=np.where(np.arange(20) % 2, 5772.0, np.nan),
    )
    values, covariance = calibration.matrix(x, y, settings)
    for k, name in enumerate(names):
        np.testing.assert_allclose(table[name], values[:, k], rtol=0, atol=1e-12)
        np.testing.assert_allclose(table[f"{name}_ERR"], np.sqrt(covariance[:, k, k]), rtol=1e-9)
    np.testing.assert_allclose(table["P_ERR"], p_errors(values, covariance, sample_stars()), rtol=1e-9)


def test_matrix_behind_a_plate_that_stands_in_the_beam(call, run, tmp_path):
    """One point on the command line, in Python, and a table: the plate at 45° turns q into −q."""
    place = ("--x", 0.1, "--y", -0.05, "--teff", 5772)
    known = read_calibration(run / "calibration.fits")
    sun = dataclasses.replace(Settings.default(1).at(CHWP=45.0), teff=np.array([5772.0]))
    expected = known.matrix(np.array([0.1]), np.array([-0.05]), sun)[0][0]
    found = json.loads(call("matrix", run, *place, "--at", "CHWP=45", "--json").stdout)["matrix"]
    names = ["M21", "M22", "M23", "M31", "M32", "M33"]
    np.testing.assert_allclose([found[name][0] for name in names], expected, rtol=1e-9)
    out = json.loads(call("matrix", run, *place, "--json").stdout)["matrix"]
    assert found["M22"][0] == pytest.approx(-out["M22"][0], abs=0.05)
    assert found["M33"][0] == pytest.approx(out["M33"][0], abs=0.05)
    assert (
        "field point X +0.100°, Y −0.050°, CHWP at 45°"
        in call("matrix", run, *place, "--at", "CHWP=45").stdout
    )
    (tmp_path / "p.csv").write_text("x,Y,CHWP_ANGLE\n0.1,-0.05,\n0.2,0.1,30\n")
    for given in (tmp_path / "p.csv", Table.read(tmp_path / "p.csv")):
        table = walop.matrix(run, points=given, at={"chwp": 45.0}, teff=5772.0, filter="SDSS-r")
        np.testing.assert_allclose([table[name][0] for name in names], expected, rtol=1e-9)
        assert table["CHWP_ANGLE"].tolist() == [45.0, 45.0]
    for wrong in ("CHPW=45", "CHWP"):
        refused = call("matrix", run, *place, "--at", wrong)
        assert refused.exit_code == 2
        assert "CHWP" in refused.stderr


def test_matrix_marks_what_is_outside(call, run, tmp_path):
    (tmp_path / "p.csv").write_text("X,Y,FILTER\n0,0,SDSS-r\n0.1,0.1,SDSS-r\n0.4,0,SDSS-r\n0.33,0,SDSS-r\n")
    result = call("matrix", run, "--points", tmp_path / "p.csv", "-o", tmp_path / "o.fits", "--json")
    assert result.exit_code == 0
    told = json.loads(result.stdout)
    assert told["rows"] == 4
    assert told["flags"]["32"] == 2
    assert "beyond the calibrated field" in result.stderr
    table = Table.read(tmp_path / "o.fits")
    assert np.isnan(np.ma.filled(table["M22"], np.nan)).tolist() == [False, False, True, False]
    assert (np.asarray(table["FLAG"]) & 32).tolist() == [0, 0, 32, 32]


def test_matrix_errors_name_file_column_and_row(call, run, calset_file, tmp_path):
    def ask(text, product=run, output="o.fits"):
        (tmp_path / "p.csv").write_text(text)
        return one_line(call("matrix", product, "--points", tmp_path / "p.csv", "-o", tmp_path / output))

    line = ask("X,Y\n0,0\n0,north\n")
    assert "p.csv Y: 'north' is not a number, in row 1" in line
    line = ask("X,Y,FILTER\n0,0,SDSS-rr\n")
    assert "SDSS-r" in line
    assert "p.csv" in line
    assert "run walop-jax refit" in ask("X,Y\n0,0\n", product=calset_file)
    assert ".ecsv" in ask("X,Y\n0,0\n", output="o.txt")
    (tmp_path / "o.fits").write_text("precious")
    assert "exists already" in ask("X,Y\n0,0\n")
    assert (tmp_path / "o.fits").read_text() == "precious"


# --------------------------------------------------------------------------------- inspect, model and cite


def test_inspect_shows_a_set(call, calset_file):
    result = call("inspect", calset_file)
    assert result.exit_code == 0
    for text in ("WALOP-SOUTH", "moon", "standard", "8 modulo 180°", "photon noise"):
        assert text in result.stdout
    found = json.loads(call("inspect", calset_file, "--json").stdout)["sets"][0]
    assert found["points"] == 29
    assert found["noise_ratio"] == pytest.approx(1.0, abs=0.05)
    assert [finding["severity"] for finding in found["findings"]] == ["note"]


def test_inspect_names_what_is_wrong(call, calset_file, tmp_path):
    with fits.open(calset_file) as hdus:
        hdus["INTENSITIES"].data["N_ERR"] *= 0.1
        hdus["INTENSITIES"].data["FLAG"][::3] = 1
        hdus["EXPOSURES"].data["CLP_ANGLE"] = np.where(hdus["EXPOSURES"].data["CLP_ANGLE"] > 60, 0.0, 22.5)
        hdus.writeto(tmp_path / "odd.fits", checksum=True)
    result = call("inspect", tmp_path / "odd.fits")
    line = one_line(result)
    assert "2 distinct polariser angle(s)" in line
    assert "odd.fits" in line
    assert "0.1 times the photon noise" in result.stdout
    assert "saturated" in result.stdout
    told = call("inspect", calset_file, tmp_path / "none.fits", "--json")
    assert "no such file" in one_line(told)
    sets = json.loads(told.stdout)["sets"]
    assert "no such file" in sets[1]["error"]
    assert sets[0]["points"] == 29


def test_inspect_shows_files_that_contradict_each_other_before_it_says_so(call, calset_file, tmp_path):
    """Two instruments: each file is listed by itself, then one line says why they cannot be one."""
    with fits.open(calset_file) as hdus:
        hdus[0].header["INSTRUME"] = "WALOP-NORTH"
        hdus.writeto(tmp_path / "north.fits", checksum=True)
    result = call("inspect", calset_file, tmp_path / "north.fits")
    assert result.exit_code == 1
    assert "WALOP-SOUTH" in result.stdout
    assert "WALOP-NORTH" in result.stdout
    assert "these files cannot be fitted as one set" in one_line(result)
    told = json.loads(call("inspect", calset_file, tmp_path / "north.fits", "--json").stdout)
    assert [one["points"] for one in told["sets"]] == [29, 29]
    assert told["joint"] is None


def test_model_is_a_file_that_refit_takes(call, calset_file, tmp_path):
    text = call("model", calset_file, "--effect", "clp_zero").stdout
    table = tomllib.loads(text)
    assert table["model"]["effects"] == ["clp_zero"]
    assert "standard.STD00.q" in table["parameters"] or any("standard." in n for n in table["parameters"])
    path = tmp_path / "m.toml"
    path.write_text(text)
    north = ("model", "--instrument", "WALOP-NORTH", "-o", path)
    assert "exists already" in one_line(call(*north))
    told = json.loads(call(*north, "--overwrite", "--json").stdout)
    assert told["parameters"]["pupil.magnification"]["start"] == pytest.approx(20.371, abs=0.003)
    assert tomllib.loads(path.read_text())["model"]["instrument"] == "WALOP-NORTH"


def test_model_errors(call, calset_file, tmp_path):
    assert "WALOP-SOUTH" in one_line(call("model", "--instrument", "WALOP-SUOTH"))
    assert "clp_wobble" in one_line(call("model", "--effect", "clp_woble"))
    assert "come from WALOP-SOUTH" in one_line(call("model", calset_file, "--instrument", "WALOP-NORTH"))


def test_cite_lists_sources(call, run):
    for args in ((), (run,), (run / "calibration.fits",)):
        text = call("cite", *args).stdout
        for name in ("Maharana et al. 2022", "Yeh 1980", "Ghosh 1999", "Dodge 1984", "Moré 1978"):
            assert name in text
        assert "contract" not in text
    assert json.loads(call("cite", "--json").stdout)[0]["what"] == "the instrument and its calibration"

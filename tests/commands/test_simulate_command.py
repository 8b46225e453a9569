"""`walop-jax simulate`: options become a plan, effects come by name, mistakes are usage errors."""

from __future__ import annotations

import json

import pytest

from walop_jax.data.calset import read_calibration_set

SMALL = ("--grid", 3, "--standard-grid", 1, "--angles", 4, "--moon-patches", 2, "--standards", 3)


def test_a_set_and_its_truth(call, tmp_path):
    output, truth = tmp_path / "set.fits", tmp_path / "truth.json"
    effects = ("--effect", "clp_wobble=amplitude:0.06,phase:1.1", "--effect", "chwp_in_beam")
    result = call("simulate", "-o", output, *SMALL, *effects, "--seed", 3, "--truth", truth, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    calset = read_calibration_set(output)
    assert told["rows"] == calset.intensities.rows == 9 * (4 + 2) + 3
    assert told["effects"] == ["clp_wobble", "chwp_in_beam"]
    known = json.loads(truth.read_text())
    assert known["parameters"]["clp_wobble.amplitude"] == {"value": 0.06, "unit": "deg"}
    assert set(known["effects"]) == {"clp_wobble", "chwp_in_beam"}
    assert known["plan"]["grid"] == 3
    assert known["seed"] == 3


def test_what_is_hidden_is_printed_with_its_size(call, tmp_path):
    effects = ("--effect", "clp_wobble=amplitude:0.06,phase:1.1", "--effect", "chwp_in_beam")
    result = call("simulate", "-o", tmp_path / "set.fits", *SMALL, *effects)
    assert (
        "; clp_wobble=amplitude:0.06 deg, phase:1.1 rad; chwp_in_beam beyond the base model" in result.output
    )


def test_plate_and_narrow_bands(call, tmp_path):
    output = tmp_path / "set.fits"
    result = call(
        "simulate",
        "-o",
        output,
        *SMALL,
        "--plate",
        "--narrow-bands",
        "--full-turn",
        "--instrument",
        "walop-north",
    )
    assert result.exit_code == 0, result.output
    assert "nothing beyond the base model" in result.output
    calset = read_calibration_set(output)
    assert calset.instrument == "WALOP-NORTH"
    assert set(calset.filters) == {"SDSS-r", "NB-580", "NB-660"}
    assert (calset.exposures.kind == "clp").sum() == 4 * 3 * 3
    assert calset.exposures.clp_angle[0:4].tolist() == [0.0, 90.0, 180.0, 270.0]


def test_existing_files_are_kept(call, tmp_path):
    output = tmp_path / "set.fits"
    output.write_text("mine")
    result = call("simulate", "-o", output, *SMALL)
    assert result.exit_code == 1
    assert "exists already" in result.stderr
    assert output.read_text() == "mine"


@pytest.mark.parametrize(
    "options",
    [("--instrument", "WALOP-EAST"), ("--effect", "clp_zeroo=1"), ("--electrons", -1), ("--grid", 0)],
)
def test_wrong_usage(call, tmp_path, options):
    result = call("simulate", "-o", tmp_path / "set.fits", *options)
    assert result.exit_code == 2
    assert not list(tmp_path.iterdir())

"""`walop-jax simulate`: effects come by name, mistakes are usage errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from walop_jax.data.calset import read_calibration_set

PLAN = "grid = 3\nstandard_grid = 1\npolariser_angles = 4\nmoon_patches = 2\nstandards = 3\n"
EFFECTS = ("--effect", "clp_wobble=amplitude:0.06,phase:1.1", "--effect", "chwp_in_beam")


@pytest.fixture
def plan(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "plan.toml"
    path.write_text(PLAN)
    return path


def test_a_set_and_its_truth(call, plan, tmp_path):
    output, truth = tmp_path / "set.fits", tmp_path / "truth.json"
    result = call("simulate", plan, "-o", output, *EFFECTS, "--seed", 3, "--truth", truth, "--json")
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


def test_what_is_hidden_is_printed_with_its_size(call, plan, tmp_path):
    result = call("simulate", plan, "-o", tmp_path / "set.fits", *EFFECTS)
    assert (
        "; clp_wobble=amplitude:0.06 deg, phase:1.1 rad; chwp_in_beam beyond the base model" in result.output
    )


def test_existing_files_are_kept(call, plan, tmp_path):
    output = tmp_path / "set.fits"
    output.write_text("mine")
    result = call("simulate", plan, "-o", output)
    assert result.exit_code == 1
    assert "exists already" in result.stderr
    assert output.read_text() == "mine"


@pytest.mark.parametrize(
    "options", [("--instrument", "WALOP-EAST"), ("--effect", "clp_zeroo=1"), ("--grid", 3)]
)
def test_wrong_usage(call, tmp_path, options):
    result = call("simulate", "-o", tmp_path / "set.fits", *options)
    assert result.exit_code == 2
    assert not list(tmp_path.iterdir())

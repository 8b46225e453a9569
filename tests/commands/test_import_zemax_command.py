"""`walop-jax import-zemax`: from a folder of text exports to a set that the other commands read."""

from __future__ import annotations

import json

import pytest
from zemax_exports import write_folder

from walop_jax.data.calset import read_calibration_set


@pytest.fixture
def folder(tmp_path):
    return write_folder(tmp_path / "exports")


def test_a_set_that_can_be_inspected(call, folder, tmp_path):
    output = tmp_path / "design.fits"
    result = call("import-zemax", folder, "-o", output)
    assert result.exit_code == 0, result.output
    assert "WALOP-NORTH, 2 wavelengths, 12 exposures of 3 points, 36 rows to use" in result.stdout
    assert "warning" not in result.stderr
    assert f"Next: walop-jax refit {output} -o RUN" in result.stderr
    shown = call("inspect", output)
    assert shown.exit_code == 0, shown.output
    assert "MONO-6600" in shown.stdout


def test_json_and_warnings(call, folder, tmp_path):
    (folder / "Config_2" / "transmission_field1_pol3.txt").unlink()
    output = tmp_path / "design.fits"
    options = ("--instrument", "walop-south", "--cameras", "1, 3, 4, 2", "--error", "0.01")
    result = call("import-zemax", folder, "-o", output, *options, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert (told["instrument"], told["wavelengths"], told["rows"]) == ("WALOP-SOUTH", [0.54, 0.66], 30)
    assert len(told["remarks"]) == result.stderr.count("walop-jax: warning: ") == 2
    assert "6 of E2 (configuration 2)" in result.stderr
    block = read_calibration_set(output).intensities.block(0, 3)
    assert block.sigma[0, 0] == pytest.approx(0.01 * block.counts[0, 0])

    quiet = call("import-zemax", folder, "-o", output, "--overwrite", "--quiet")
    assert (quiet.exit_code, quiet.stdout) == (0, "")
    assert "are left out" in quiet.stderr


def test_nothing_is_half_written(call, folder, tmp_path):
    output = tmp_path / "design.fits"
    path = folder / "Config_1" / "transmission_field1_pol2.txt"
    path.write_text(path.read_text(encoding="latin-1")[:700], encoding="latin-1")
    result = call("import-zemax", folder, "-o", output)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"walop-jax: error: {path}, line ")
    assert [entry.name for entry in tmp_path.iterdir()] == ["exports"]


@pytest.mark.parametrize(
    "options",
    [
        ("--cameras", "1,2,3"),
        ("--cameras", "1,3,2,2"),
        ("--cameras", "O1,E1,O2,E2"),
        ("--error", "nan"),
        ("--error", "-1"),
        ("--instrument", "WALOP-EAST"),
    ],
)
def test_wrong_usage(call, folder, tmp_path, options):
    result = call("import-zemax", folder, "-o", tmp_path / "design.fits", *options)
    assert result.exit_code == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["exports"]

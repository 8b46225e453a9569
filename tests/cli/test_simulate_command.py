"""`walop-jax simulate`: options become a plan, effects come by name, mistakes are usage errors."""

from __future__ import annotations

import json

import pytest

from walop_jax.cli.simulate import parsed_effect
from walop_jax.data import read_calibration_set
from walop_jax.model.effects import EFFECTS
from walop_jax.simulation.observing_plan import ObservingPlan

SMALL = ("--grid", 3, "--standard-grid", 1, "--angles", 4, "--moon-patches", 2, "--standards", 3)
CONTEXT = ObservingPlan().context()


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
    ("text", "message"),
    [
        ("clp_wobbel=1", "clp_wobble"),
        ("clp_wobble=1", "2 parameters"),
        ("clp_wobble=amplitud:1,phase:0", "nearest: amplitude|without a value of amplitude"),
        ("clp_zero", "without a value of angle"),
        ("clp_zero=fast", "does not fit"),
        ("clp_zero=1%", "not a number"),
        ("clp_zero=angle:1,angle:2", "each once"),
        ("chwp_in_beam=1", "give chwp_in_beam alone"),
        ("pedestal=0.1/0.2/0.3", "does not fit"),
        ("blemish=camera:7,depth:0.1", "does not fit|camera"),
    ],
)
def test_effects_that_make_no_sense(text: str, message: str):
    with pytest.raises(ValueError, match=message):
        parsed_effect(text, CONTEXT)


def test_every_effect_can_be_asked_for():
    for kind in EFFECTS:
        names = kind.amplitudes()
        text = f"{kind.name}={','.join(f'{name}:0.01' for name in names)}" if names else kind.name
        assert parsed_effect(text, CONTEXT).name == kind.name
        if len(names) == 1 and not kind.shape:
            assert parsed_effect(f"{kind.name}=0.01", CONTEXT).name == kind.name


@pytest.mark.parametrize(
    "options",
    [("--instrument", "WALOP-EAST"), ("--effect", "clp_zeroo=1"), ("--electrons", -1), ("--grid", 0)],
)
def test_wrong_usage(call, tmp_path, options):
    result = call("simulate", "-o", tmp_path / "set.fits", *options)
    assert result.exit_code == 2
    assert not list(tmp_path.iterdir())

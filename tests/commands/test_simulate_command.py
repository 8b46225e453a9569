"""`walop-jax simulate`: effects come by name, mistakes are usage errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import walop_jax as walop
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


def test_a_misspelt_name_comes_before_a_file_that_exists(call, plan, tmp_path):
    """The call has to be written again anyway."""
    (tmp_path / "set.fits").write_text("mine")
    result = call("simulate", plan, "-o", tmp_path / "set.fits", "--effect", "clp_zeroo=1")
    assert result.exit_code == 2
    assert "did you mean 'clp_zero'" in result.stderr


@pytest.mark.parametrize(
    "options", [("--instrument", "WALOP-EAST"), ("--effect", "clp_zeroo=1"), ("--grid", 3)]
)
def test_wrong_usage(call, tmp_path, options):
    result = call("simulate", "-o", tmp_path / "set.fits", *options)
    assert result.exit_code == 2
    assert not list(tmp_path.iterdir())


def test_further_nights_are_of_the_same_instrument_and_catalogue(call, plan, tmp_path):
    """The rehearsal of many nights: nothing changes from night to night but weather, noise, date, and what is asked."""
    sets = [tmp_path / f"night{k}.fits" for k in range(3)]
    truths = [tmp_path / f"truth{k}.json" for k in range(3)]
    first = ("--effect", "clp_wobble=amplitude:0.06,phase:1.1", "--seed", 3)
    then = [
        ("--like", truths[0], "--night", 10),
        ("--like", truths[0], "--night", 11, "--effect", "hwp1_axis=0.3"),
    ]
    for path, truth, options in zip(sets, truths, [(plan, *first), *then], strict=True):
        result = call("simulate", *options, "-o", path, "--truth", truth)
        assert result.exit_code == 0, result.output
    known = [json.loads(path.read_text()) for path in truths]
    assert known[1]["parameters"] == known[0]["parameters"]
    assert known[2]["parameters"] == known[0]["parameters"] | {
        "hwp1_axis.angle": {"value": 0.3, "unit": "deg"}
    }
    assert set(known[2]["effects"]) == {"clp_wobble", "hwp1_axis"}
    old, new, turned = map(read_calibration_set, sets)
    np.testing.assert_allclose(new.exposures.mjd - old.exposures.mjd, 10.0, atol=1e-9)
    np.testing.assert_array_equal(turned.sources.q, old.sources.q)
    # Noise is that of the night, also with one seed: behind the polariser a ratio changes by the noise of two draws.
    ratio, error = zip(*(_ratio(each) for each in (old, new)), strict=True)
    pull = (ratio[1] - ratio[0]) / np.hypot(*error)
    assert 0.75 < np.sqrt(np.mean(pull**2)) < 1.25


def _ratio(calset):
    """(O1 − E1) / (O1 + E1) of what was seen through the polariser, and its photon noise."""
    table = calset.intensities
    o, e = np.asarray(table.counts)[calset.exposures.clp_in[table.exposure], :2].T
    return (o - e) / (o + e), 2 * np.sqrt(o * e * (o + e)) / (o + e) ** 2


def test_a_night_like_a_run(run):
    """In Python, without a deep import: the instrument as fitted, the stars of its catalogue."""
    run = walop.read(run)
    again = walop.simulate(like=run, night=5, seed=1)
    assert again.values["pupil.magnification"] == run["pupil.magnification"].value
    np.testing.assert_array_equal(again.calset.sources.q, run.calibration.sources.q)
    third = walop.simulate(walop.ObservingPlan(grid=2, standards=1), like=again, night=6)
    assert third.values["half1.wedge"] == again.values["half1.wedge"]
    assert third.calset.sources.q[0] == again.calset.sources.q[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--like", "nowhere.json"), "no such file"),
        (("--like", "empty.json"), "is not the truth of a simulated set"),
        (("--like", "empty.json", "--instrument", "WALOP-NORTH"), "leave out instrument and"),
    ],
)
def test_what_no_night_can_be_like(call, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    Path("empty.json").write_text("{}")
    result = call("simulate", *options, "-o", "set.fits")
    assert result.exit_code in (1, 2)
    assert message in " ".join(result.stderr.replace("│", " ").split())
    assert not Path("set.fits").exists()

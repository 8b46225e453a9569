"""An observing plan as a file: what it says, what is wrong with it, and what it is worth before any data."""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from own_instrument import OWN
from small_run import small_fit

from walop_jax.commands.inputs import save
from walop_jax.commands.limits import limits
from walop_jax.commands.plan import plan as plan_command
from walop_jax.commands.products import design_of
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import FilterCurve
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.refit import refit
from walop_jax.io.errors import DataError
from walop_jax.model.effects import effect_by_name
from walop_jax.simulation.observing_plan import ObservingPlan, plan_text, read_plan
from walop_jax.simulation.simulate import simulate

# As many exposures and points as `small_run.SMALL`: compiled for one, compiled for both.
TEXT = """
grid = 5
standard_grid = 2
polariser_angles = 8
moon_patches = 3
standards = 3
electrons = 5e5
"""
CATALOGUE = tuple(effect_by_name(name) for name in ("clp_zero", "wollaston_axis", "pedestal"))


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(TEXT)
    return path


def test_a_plan_says_what_it_says(plan):
    plan.write_text(TEXT + 'plate = ["out", 45]\nfull_turn = true\nfilters = ["SDSS-r", "NB-660"]\n')
    found = read_plan(plan)
    assert found.polariser_angles == (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
    assert found.plate == (None, 45)
    assert found.filters == ("SDSS-r", "NB-660")
    assert found.grid**2 + found.standard_grid**2 == len(found.points())
    assert found.electrons == 5e5
    plan.write_text("polariser_angles = [0, 30, 75]\n")
    assert read_plan(plan, "WALOP-NORTH").polariser_angles == (0, 30, 75)


def test_a_plan_for_an_instrument_of_ones_own(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.toml").write_text(OWN)
    Path("plan.toml").write_text(
        'instrument = "own.toml"\ngrid = 2\npolariser_angles = 4\nmoving = { WIN = [0, 45] }\n'
        "moon_patches = 0\nstandards = 0\n"
    )
    made = call("simulate", "plan.toml", "-o", "set.fits")
    assert "Next: walop-jax refit set.fits --instrument own.toml -o RUN" in made.stderr
    seen = call("inspect", "set.fits")
    assert "Next: walop-jax refit CALSET --instrument FILE.toml -o RUN" in seen.stderr
    assert "places of their own" not in seen.stdout
    with fits.open("set.fits") as hdus:
        kept = [c for c in hdus["EXPOSURES"].columns if c.name not in ("MJD", "TEMP", "HA")]
        hdus["EXPOSURES"] = fits.BinTableHDU.from_columns(kept, name="EXPOSURES")
        hdus.writeto("bare.fits")
    (note,) = [line for line in call("inspect", "bare.fits").stdout.splitlines() if "missing" in line]
    assert "[EXPOSURES] MJD, TEMP, HA: columns missing; using nan" in note
    Path("still.toml").write_text("moon_patches = 0\nstandards = 0\n")
    told = call("simulate", "still.toml", "--instrument", "own.toml", "-o", "no.fits")
    assert "no moving element 'WIN'" in told.stderr
    assert "moving = { WIN = [0, 22.5, 45] }" in told.stderr
    assert "did you mean" not in told.stderr
    assert limits("plan.toml", effects=CATALOGUE[:1]).limits
    told = call("simulate", "plan.toml", "--effect", "hwp1_axis=0.5", "-o", "no.fits").stderr
    assert "effect 'hwp1_axis': the instrument has no part 'half1.plate'; known: main, polariser" in told
    told = call("model", "set.fits", "--instrument", "own.toml", "-o", "MODEL.toml").stderr
    assert "Next: walop-jax refit set.fits --instrument own.toml --model MODEL.toml -o RUN" in told
    call("refit", "set.fits", "--instrument", "own.toml", "-o", "RUN")
    assert call("plot", "RUN", "modulation", "-o", "angles.png").exit_code == 0
    assert design_of("RUN").description.strip() == OWN.strip()
    told = call("plan", "RUN", "--minutes", 20, "--criterion", "window.delta", "-o", "P").stdout
    assert "Moon patches are left out: the site is not known" in told
    stops = json.loads(Path("P/plan.json").read_text())["exposures"]
    assert {stop["positions"]["WIN"] for stop in stops} <= {0.0, 45.0}  # where it stood in the run
    told = call("compare", "set.fits", "--instrument", "RUN", "-o", "C").stderr
    assert "Paper II has a method for two arms of two cameras, which OWN is not" in told
    call("plan", "plan.toml", "--minutes", 20, "--criterion", "window.delta", "-o", "P")
    assert read_plan("P/plan.toml").design.description.strip() == OWN.strip()


OWN_FILTERS = """
[filters.SDSS-r]
[filters.V]
wavelength = [0.60, 0.55, 0.50]
throughput = [0.1, 0.8, 0.3]
"""


def test_filters_of_ones_own_are_tables(plan, tmp_path):
    plan.write_text(TEXT + OWN_FILTERS)
    again = tmp_path / "again.toml"
    again.write_text(plan_text(read_plan(plan)))
    curve = FilterCurve("V", np.array([0.50, 0.55, 0.60]), np.array([0.3, 0.8, 0.1]))
    given = {"grid": 3, "polariser_angles": (0.0, 45.0, 90.0), "moon_patches": 0, "standards": 0}
    for found in (read_plan(again), ObservingPlan(filters=("SDSS-r", curve), **given)):
        assert found.filter_names == ("SDSS-r", "V")
        assert list(found.curves()["V"].wavelength) == [0.50, 0.55, 0.60]
        assert list(found.curves()["V"].throughput) == [0.3, 0.8, 0.1]
    made = simulate(ObservingPlan(filters={"V": curve}, **given)).calset
    write_calibration_set(tmp_path / "set.fits", made)
    assert read_calibration_set(tmp_path / "set.fits").filters["V"].throughput.tolist() == [0.3, 0.8, 0.1]
    assert set(made.exposures.filter) == {"V"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('filters = ["B"]', r"no filter 'B'; known: .*NB-660.*\[filters.B\] with wavelength \(um\)"),
        ("[filters.V]\nwavelength = [550, 600]\nthroughput = [1, 1]", r"\[filters.V\] .* are these nm"),
        (
            "[filters.V]\nwavelength = [0.5, 0.6]\nthroughput = [1]",
            r"\[filters.V\]: has 1 values of throughput",
        ),
        ("[filters.V]\nwavelength = [0.5, 0.6]", r"\[filters.V\]: needs wavelength \(um\) and throughput"),
        ("grids = 4", "did you mean 'grid'"),
        ('grid = "4"', "grid = '4' must be a whole number"),
        ("grid = [4, 4]", r"grid = \[4, 4\] must be a whole number"),
        ("standards = 3.5", "standards = 3.5 must be a whole number"),
        ("moving = { HWP = 45 }", r"\[moving\] HWP = 45 must be a list of numbers"),
        ('moving = { HWP = ["22,5"] }', r"\[moving\] HWP = '22,5' must be a finite number"),
        ("moving = { CHWP = [] }", "CHWP has no positions; list its angles"),
        ("polariser_angles = 0", "polariser_angles = 0 must be at least 1, or a list"),
        ("temperature = [4]", r"temperature = \[4\] must be a list of two numbers"),
        ('filters = "V"', r"filters = 'V' must be a list of names, or tables \[filters.NAME\]"),
        ('[[stops]]\npolariser_angle = "x"', r"\[stops\] polariser_angle = 'x' must be a finite number"),
        ("[[stops]]\nHWP = 22.5", "where an element stands is moving = { HWP = 22.5 }"),
        (
            "[[stops]]\npolariser_angle = 5\nmoving = { CHWP = 45 }",
            r"a stop has a position of CHWP: list all of them in the plan as well, moving = \{ CHWP = \[0",
        ),
        ("field = 5", r"field = 5 deg must be between 0 and 0.\d+, the field of WALOP-SOUTH"),
        ("grid = 0", "must be at least 1"),
        ('filters = ["SDSS-x"]', "SDSS-x"),
        ('instrument = "WALOP-EAST"', "WALOP-EAST"),
        ("grid = [", "not valid TOML"),
        ('grid = "four"', "plan.toml"),
        ("polariser_angles = [0, 60]\nfull_turn = true", "of no use beside a list"),
    ],
)
def test_what_is_wrong_is_said_with_the_file(plan, text, message):
    plan.write_text(text)
    with pytest.raises(DataError, match=message) as raised:
        read_plan(plan)
    assert "plan.toml" in str(raised.value)


def test_a_plan_has_limits_before_any_data(plan, tmp_path):
    found = limits(plan, output=tmp_path / "RUN", effects=CATALOGUE[:1])
    document = json.loads((tmp_path / "RUN" / "limits.json").read_text())
    assert document["plan"]["grid"] == 5
    assert document["trusted"] is True
    assert document["seed"] == 0
    (entry,) = (one for one in found.limits if one.effect == "clp_zero")
    # N photons behind a polariser tell its angle to 1/(2 √N) rad: 5·10⁵ in four cameras, at 29 points and 8 angles.
    photons = np.rad2deg(0.5 / np.sqrt(5e5 * 4 * 29 * 8))
    assert photons < entry.detected[0] < 30 * photons


@pytest.mark.parametrize(
    ("wishes", "message"),
    [
        ({"minutes": float("inf")}, "a plan is one of a night, of 1440 minutes at most"),
        ({"minutes": 1e6}, "add to its calibration with --after RUN"),
        ({"minutes": 0.0}, "nothing can be observed in no time"),
        ({"minutes": float("nan")}, "nothing can be observed in no time"),
        ({"goal": 0.0}, "no time reaches it; give a value above 0"),
        ({"goal": -1.0}, "no time reaches it"),
        ({"goal": float("nan")}, "no time reaches it"),
        ({"draws": 0}, "draws = 0: give 1 or more"),
    ],
)
def test_wishes_that_no_plan_has(wishes, message):
    """Refused at once; a million minutes promised p to 3e-8."""
    with pytest.raises(ValueError, match=message):
        plan_command(ObservingPlan(grid=2), **wishes)


OWN_EFFECT = """
[twin]
about = "Zero point of the polariser, called by another name"
source = "a test"
revealed_by = "sky of known polarisation"
separated_by = "nothing"
angle = { does = "turn of polariser", unit = "deg", width = 0.3, about = "added" }
"""


def test_effects_of_ones_own_are_told_apart(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.toml").write_text(OWN)
    Path("twin.toml").write_text(OWN_EFFECT)
    Path("plan.toml").write_text(
        'instrument = "own.toml"\ngrid = 2\npolariser_angles = 4\nmoving = { WIN = [0, 45] }\n'
        "moon_patches = 0\nstandards = 0\n"
    )
    words = (
        "plan",
        "plan.toml",
        "--minutes",
        20,
        "--draws",
        1,
        "--apart",
        "twin=0.5",
        "--apart",
        "clp_wobble",
    )
    refused = call(*words)
    assert refused.exit_code == 1
    assert "there is no effect 'twin'" in refused.stderr
    done = call(*words, "--effects", "twin.toml", "-o", "P")
    assert done.exit_code == 0, done.output
    assert json.loads(Path("P/plan.json").read_text())["criterion"] == "apart"


def test_what_a_fit_in_memory_left_undecided(tmp_path):
    """It has no diagnosis; asking it for one ended in a TypeError."""
    result = refit(simulate(ObservingPlan(grid=3, moon_patches=2, standards=3), seed=1).calset).with_verdict()
    for wish in ({"after": result, "criterion": "apart"}, {"separate": result}):
        with pytest.raises(
            DataError, match="no diagnosis; run diagnose first, or name the effects with --apart"
        ):
            plan_command("", **wish)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--separate", "RUN", "--goal", 3), "leave it out beside --separate, which takes all from its RUN"),
        (("--separate", "RUN", "--after", "RUN"), "leave it out beside --separate"),
        (("--separate", "RUN", "--criterion", "mean"), "leave it out beside --separate"),
        (("--minutes", 10), "give a plan file, an instrument or a RUN"),
    ],
)
def test_wishes_that_contradict_a_class(call, words, message):
    done = call("plan", *words)
    assert done.exit_code == 2
    assert message in done.stderr


def test_a_run_without_a_class_says_so(call, tmp_path, monkeypatch):
    """Exit code 1 and what to do; nothing is planned."""
    monkeypatch.chdir(tmp_path)
    save(small_fit(), "RUN")
    Path("RUN/diagnosis.json").write_text('{"verdict": "consistent", "steps": []}')
    done = call("plan", "--separate", "RUN")
    assert done.exit_code == 1
    assert "the diagnosis left no effects that look alike" in done.stderr

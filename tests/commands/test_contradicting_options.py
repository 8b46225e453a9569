"""Options that were ignored without a word, or complained of in wrong words; suggestions that could not be typed."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import handmade_run
import pytest
from own_instrument import OWN
from small_run import small_fit

import walop_jax as walop
from walop_jax.commands.command import Command, Outcome, given, typed, with_own_classes
from walop_jax.posterior.run import Run

PLAN = "grid = 2\nstandard_grid = 1\npolariser_angles = 4\nmoon_patches = 2\nstandards = 3\n"


@pytest.fixture
def here(run: Path, tmp_path: Path, monkeypatch) -> Path:
    """A folder with a run, a plan, an instrument without a site, and a page that is no page."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "RUN").symlink_to(run)
    (tmp_path / "plan.toml").write_text(PLAN)
    (tmp_path / "own.toml").write_text(OWN)
    (tmp_path / "points.csv").write_text("X,Y\n0,0\n")
    (tmp_path / "LIMITS").mkdir()
    handmade_run.make_limits(tmp_path / "LIMITS")
    handmade_run.make_diagnosis(tmp_path / "FOUND")
    return tmp_path


@pytest.mark.parametrize(
    ("line", "option", "reason"),
    [
        ("matrix RUN --points points.csv --y 0.2 -o out.fits", "--points", "--x and --y"),
        ("plot RUN -o figure.png", "NAME", "name of the figure"),
        ("trace RUN --instrument WALOP-SOUTH", "--instrument", "through one of them"),
        ("instrument --text", "NAME|FILE.toml", "name the instrument"),
        ("standards --instrument WALOP-NORTH", "--instrument", "see --up"),
        ("standards --up 61041.9 --instrument own.toml", "--instrument", "site of this instrument"),
        ("standards --near 308,141", "--near", "a declination is between"),
        ("plan RUN --after RUN", "--after", "one calibration can be added to"),
        ("plan plan.toml --words words.toml", "--words", "see --schedule"),
        ("plan WALOP-NORTH --candidates plan.toml", "--candidates", "for WALOP-SOUTH"),
        ("plan plan.toml --candidates plan.toml", "--candidates", "or a RUN of it"),
        ("report LIMITS --goal 0.05", "--goal", "the page about a fit"),
        ("report LIMITS --data set.fits", "--data", "the page about a fit"),
        ("apply RUN stars.fits -o out.fits --scheduler tcp://a:1", "--scheduler", "see --each"),
        ("diagnose --why ghost FOUND RUN", "CALSET...", "one diagnosis"),
    ],
)
def test_what_contradicts_itself_is_refused_and_named(call, here: Path, line: str, option: str, reason: str):
    refused = call(*shlex.split(line))
    told = " ".join(refused.stderr.split())
    assert refused.exit_code == 2, told
    assert f"Invalid value for {option}: " in told
    assert reason in told


def test_an_answer_does_not_replace_the_diagnosis(call, here: Path):
    """With -o FOUND --overwrite the files of the diagnosis were removed: none of the new ones was there."""
    before = sorted(entry.name for entry in Path("FOUND").iterdir())
    refused = call("diagnose", "--why", "ghost", "FOUND", "-o", "FOUND", "--overwrite")
    assert refused.exit_code == 2
    assert sorted(entry.name for entry in Path("FOUND").iterdir()) == before


@pytest.mark.parametrize("name", ["refit", "check", "matrix"])
def test_an_output_without_a_name_lacks_it(call, name: str):
    """The program said that the command takes no output."""
    refused = call(name, "RUN", "-o")
    assert refused.exit_code == 2
    assert "requires an argument" in refused.stderr


def test_a_product_is_planned_from_like_its_run(call, here: Path):
    """It was taken for the name of an instrument."""
    refused = call("plan", "RUN/calibration.fits", "--criterion", "apart")
    assert "no diagnosis; run diagnose first" in refused.stderr


def test_numbers_that_are_texts_are_refused():
    for wrong in ({"stars": "ten"}, {"night": "one"}):
        with pytest.raises(TypeError, match="give a number"):
            walop.simulate(**wrong)


def test_a_negative_seed_is_refused_by_its_name(call):
    """A fit was made before numpy refused a number that it did not name."""
    refused = call("refit", "set.fits", "-o", "OUT", "--seed", "-1")
    assert refused.exit_code == 2
    assert "--seed" in refused.stderr


class Begun(Exception):
    """The work has begun."""


def _begin(*arguments: Any, **options: Any) -> Any:
    raise Begun


@pytest.mark.parametrize("goal", ["0", "200"])
def test_a_goal_that_no_calibration_has_is_refused_before_the_work(
    call, calset_file, here: Path, monkeypatch, goal: str
):
    monkeypatch.setattr("walop_jax.fit.refit.refit", _begin)
    refused = call("refit", calset_file, "-o", "OUT", "--goal", goal)
    assert refused.exit_code == 2
    assert "is no error of p" in refused.stderr


def test_a_schedule_that_exists_is_refused_before_the_work(call, here: Path, monkeypatch):
    monkeypatch.setattr("walop_jax.plans.plan.plan_exposures", _begin)
    Path("night.json").write_text("mine")
    refused = call("plan", "plan.toml", "--schedule", "night.json")
    assert "night.json: exists already" in refused.stderr


def test_catalogues_of_cameras_that_exist_are_refused_before_the_work(call, here: Path, monkeypatch):
    monkeypatch.setattr("walop_jax.simulation.simulate.true_instrument", _begin)
    Path("sky_E1.fits").write_text("mine")
    refused = call("simulate", "plan.toml", "--stars", 5, "--cameras", "-o", "sky.fits")
    assert "sky_E1.fits: exists already" in refused.stderr


@pytest.mark.parametrize("command", ["check", "compare"])
def test_sets_are_read_with_the_kinds_of_exposures_of_the_calibration(command: str, fitted, monkeypatch):
    def read(data: Any, instrument: Any = None) -> Any:
        raise Begun(instrument.name)

    monkeypatch.setattr(f"walop_jax.commands.{command}.set_of", read)
    old, new = fitted.calibration, fitted.calset
    with pytest.raises(Begun, match="WALOP-SOUTH"):
        walop.check(old, new) if command == "check" else walop.compare(new, old)


def test_a_run_reads_its_data_with_the_kinds_of_exposures_of_its_instrument(run, monkeypatch):
    def read(*paths: Any, kinds: Any, cells: Any) -> Any:
        raise Begun(", ".join(kinds))

    monkeypatch.setattr("walop_jax.posterior.run.read_calibration_set", read)
    with pytest.raises(Begun, match="moon, standard"):
        _ = Run(run).calset


def test_a_catalogue_that_cannot_be_read_leaves_the_others_their_tables(call, run, tmp_path, monkeypatch):
    made, begun = [], Command.run

    def running(self: Any, job: Any, arguments: Any) -> Any:
        if arguments.get("each"):
            return begun(self, job, arguments)
        made.append(Path(arguments["catalogue"]).name)
        if made[-1] == "a.csv":
            raise PermissionError("a.csv: permission denied")
        return Outcome(None, {}, "done")

    monkeypatch.setattr(Command, "run", running)
    done = call("apply", run, "a.csv", "b.csv", "--each", "-o", tmp_path / "OUT")
    assert made == ["a.csv", "b.csv"]
    assert done.exit_code == 1
    assert "a.csv: permission denied" in done.stderr


def test_check_refuses_what_apply_refuses(call, here: Path):
    """The angle of a plate that stood in the beam in no exposure of the calibration: was it in the beam now?"""
    Path("stars.csv").write_text("X,Y,CHWP_ANGLE," + ",".join(f"N{k},N{k}_ERR" for k in range(4)) + "\n")
    with Path("stars.csv").open("a") as stream:
        stream.write("0,0,45" + ",10000,100" * 4 + "\n")
    for line in (("apply", "RUN", "stars.csv", "-o", "out.csv"), ("check", "RUN", "stars.csv")):
        assert "no exposure of the calibration had CHWP in the beam" in call(*line).stderr


def test_an_output_that_exists_is_refused_before_the_row_is_added(call, here: Path):
    (here / "OUT").mkdir()
    Path("OUT/check.json").write_text("mine")
    refused = call("check", "RUN", "--append", "nights.ecsv", "-o", "OUT")
    assert "--overwrite" in refused.stderr
    assert not Path("nights.ecsv").exists()
    assert Path("OUT/check.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("RUN", "--against", "RUN"), "give the catalogues that are compared"),
        (("RUN", "--limits", "l.toml"), "those of the numbers that --append writes"),
        (("RUN", "stars.csv", "--limit", "0", "--against", "RUN"), "must be above 0"),
        (("RUN", "stars.csv", "--limit", "1"), "a shift between two calibrations"),
        (("RUN", "stars.csv", "--goal", "0.5"), "asked of RUN alone"),
        (("RUN", "--force"), "it is about stars"),
        (("RUN", "--goal", "0"), "is no error of p"),
    ],
)
def test_options_of_check_that_cannot_be_meant_are_refused(call, here: Path, words, reason: str):
    refused = call("check", *words)
    assert refused.exit_code == 2
    assert reason in refused.stderr


def test_a_product_of_another_name_is_not_judged_by_the_data_of_the_run_beside_it(run, tmp_path, monkeypatch):
    for name in ("calibration.fits", "earlier.fits"):
        shutil.copy(run / "calibration.fits", tmp_path / name)
    monkeypatch.setattr(walop.Run, "calset", property(_begin))
    assert walop.check(tmp_path / "earlier.fits")["commissioning"].checks
    with pytest.raises(Begun):
        walop.check(tmp_path)


# ---------------------------------------------------------------------------------------- what to type next


def test_lines_to_type_are_quoted_and_left_out_where_they_cannot_be_typed():
    assert typed("report", "my run") == "walop-jax report 'my run'"
    assert typed("report", None) == ""
    assert typed("apply", small_fit, "STARS.fits") == ""
    assert given(model=None, instrument=Path("own.toml")) == ["--instrument", Path("own.toml")]


def test_lines_to_type_name_the_files_of_own_classes():
    """Without them the calibration of an instrument with an element of one's own is not read."""
    steps = ("walop-jax report RUN", "walop-jax refit s.fits --elements my.py -o RUN", "topcat OUT.vot", "")
    assert with_own_classes(steps, Path("my.py"), Path("own effects.py")) == (
        "walop-jax report RUN --elements my.py --effects 'own effects.py'",
        "walop-jax refit s.fits --elements my.py -o RUN --effects 'own effects.py'",
        "topcat OUT.vot",
        "",
    )
    assert with_own_classes(steps, None, Path("own.toml")) == steps


def test_suggested_paths_with_blanks_can_be_typed(call, calset_file, here: Path):
    done = call("model", calset_file, "-o", "my model.toml")
    (line,) = re.findall("Next: (.*)", done.stderr)
    assert shlex.split(line)[:6] == ["walop-jax", "refit", str(calset_file), "--model", "my model.toml", "-o"]


def test_a_calibration_that_is_not_fit_for_use_is_not_suggested_for_use(call, here: Path):
    """A no-go ended with the advice to correct stars with it."""
    done = call("check", "RUN")
    assert (done.exit_code == 3) == ("walop-jax apply" not in done.stderr)

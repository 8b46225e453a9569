"""Every command of the program and of the README, with `-o`, on one small set; and back.

Each line is typed in a folder that holds what users have. What it writes is read with `walop.read` or as a table, a
folder is reported, and the commands that the program suggests next are typed as they are printed.
"""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from camera_files import four, some_stars
from command import Call
from frame_run import frame_run, raster
from frames_file import write_frames
from own_instrument import OWN

import walop_jax as walop
from walop_jax.commands import COMMANDS
from walop_jax.commands.program import UNTRUSTED
from walop_jax.simulation.simulate import simulate

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


class Line(NamedTuple):
    """A line of words: its exit code, the document that its folder must hold, and how long it takes."""

    words: str
    document: str = ""
    takes: str = ""  # "seconds": not with --fast, "minutes": with --long alone


LINES = {
    "demo": [Line("demo -o DEMO", "summary", "seconds")],
    "inspect": [Line("inspect set.fits", takes="seconds")],
    "exposures": [Line("exposures log.csv --words words.toml -o exposures.ecsv")],
    "simulate": [
        Line("simulate plan.toml -o made.fits --truth truth.json", takes="seconds"),
        Line("simulate -o made.fits", takes="seconds"),
    ],
    "refit": [
        Line("refit set.fits -o FIT", "summary", "seconds"),
        Line("refit set.fits --clip 5 -o FIT", "summary", "seconds"),
        Line("refit frames.fits --cells 12 -o FIT", "summary", "minutes"),
    ],
    "diagnose": [Line("diagnose set.fits -o FOUND", "diagnosis", "seconds")],
    "limits": [
        Line("limits set.fits -o LIMITS", "limits", "seconds"),
        Line("limits plan.toml -o LIMITS", "limits", "minutes"),
    ],
    "plan": [
        Line("plan bench.toml --minutes 10 --draws 1 --criterion window.delta -o PLAN", "plan", "seconds"),
        Line("plan plan.toml --minutes 20 --draws 1 --schedule night.json -o PLAN", "plan", "seconds"),
        Line("plan WALOP-SOUTH --minutes 20 --draws 1 -o PLAN", "plan", "minutes"),
        Line("plan RUN --minutes 10 --draws 1 -o PLAN", "plan", "minutes"),
    ],
    "sample": [Line("sample SAMPLED", takes="minutes")],
    "report": [Line("report RUN", takes="seconds"), Line("report RUN -o page.html", takes="seconds")],
    "plot": [Line("plot RUN matrix -o matrix.pdf", takes="seconds"), Line("plot RUN")],
    "matrix": [Line("matrix RUN --points points.csv -o matrix.fits"), Line("matrix RUN --x 0.1 --y 0.2")],
    "gather": [Line("gather O1.fits E1.fits O2.fits E2.fits -o gathered.ecsv", takes="seconds")],
    "apply": [Line("apply RUN stars.fits -o corrected.fits", takes="seconds")],
    "compare": [Line("compare set.fits -o COMPARED", "comparison", "minutes")],
    "check": [
        Line("check RUN"),
        Line("check RUN -o NIGHT", "check", "seconds"),
        Line("check RUN set.fits -o LATER", "check", "seconds"),
        Line("check RUN set.fits", takes="seconds"),
        Line("check RUN stars.fits -o WATCHED", "check", "seconds"),
        Line("check RUN stars.fits --against RUN -o CHANGED", "check", "seconds"),
        Line("check RUN --append QUALITY.ecsv -o QUALITY", "check", "seconds"),
        Line("check RUN set.fits stars.fits -o BOTH", "check", "seconds"),
    ],
    "stack": [Line("stack RUN -o SURVEY", "survey", "seconds")],
    "model": [Line("model set.fits --effect clp_zero -o model.toml", takes="seconds")],
    "instrument": [Line("instrument WALOP-SOUTH", takes="seconds")],
    "trace": [Line("trace RUN --x 0.1 --y 0.2 --q 0.01")],
    "standards": [Line("standards --near 308,41"), Line("standards --up 61041.9")],
    "cite": [Line("cite RUN"), Line("cite RUN --bibtex")],
    "docs": [Line("docs files"), Line("docs")],
}
"""What is typed for each command; a new one needs its line here."""

PLACEHOLDERS = {
    "CALSET": "set.fits",
    "STARS.fits": "stars.fits",
    "NEW.fits": "set.fits",
    "TABLE": "points.csv",
    "OUT.fits": "out.fits",
}
"""What users put in the place of words in README and suggestions."""

PLAN = "grid = 5\nstandard_grid = 1\npolariser_angles = 4\nmoon_patches = 2\nstandards = 3\n"
BENCH = (
    'instrument = "own.toml"\ngrid = 3\npolariser_angles = 4\nmoon_patches = 0\nstandards = 0\n'
    "moving = { WIN = [0, 45] }\n"
)


def lines(takes: str) -> list[Any]:
    """Those that take so long, as parameters of a test."""
    return [
        pytest.param(one, id=one.words) for typed in LINES.values() for one in typed if one.takes == takes
    ]


def readme_lines() -> list[str]:
    """The commands of README, without the name of the program."""
    shown = re.findall(r"walop-jax ((?:[a-z][a-z-]+)[^`\n]*)", README)
    return list(dict.fromkeys(line.strip() for line in shown if line.split()[0] in COMMANDS))


def test_every_command_has_a_line():
    assert set(LINES) == set(COMMANDS)
    assert all(line.words.split()[0] == name for name, typed in LINES.items() for line in typed)


def test_every_command_of_the_readme_is_among_them():
    """The same options and as many arguments."""

    def shape(line: str) -> tuple[str, ...]:
        return tuple(word if k == 0 or word.startswith("-") else "" for k, word in enumerate(line.split()))

    typed = {shape(line.words) for several in LINES.values() for line in several}
    assert len(readme_lines()) > 8
    for line in readme_lines():
        assert any(one[: len(shape(line))] == shape(line) for one in typed), line


@pytest.fixture(scope="module")
def home(calset_file: Path, run: Path, tmp_path_factory) -> Path:
    """A folder with what users have: a set and its fit, stars, points, plans."""
    folder = tmp_path_factory.mktemp("home")
    shutil.copyfile(calset_file, folder / "set.fits")
    shutil.copytree(run, folder / "RUN")
    (folder / "plan.toml").write_text(PLAN)
    (folder / "own.toml").write_text(OWN)
    (folder / "bench.toml").write_text(BENCH)
    (folder / "points.csv").write_text("X,Y\n0,0\n0.2,-0.1\n")
    (folder / "log.csv").write_text("TYPE,ANGLE,SECONDS\nclp,0,20\nclp,45,20\n")
    columns = {"KIND": "TYPE", "CLP_ANGLE": "ANGLE", "EXPTIME": "SECONDS"}
    words = "".join(f'[{name}]\nword = "{word}"\n' for name, word in columns.items())
    (folder / "words.toml").write_text(f"{words}[CLP_IN]\nvalue = true\n")
    four(some_stars(), folder)
    _stars(folder / "RUN").write(folder / "stars.fits")
    return folder


def _stars(run: Path) -> Table:
    """Stars of two nights, with photon noise about the counts that a calibration expects of them."""
    places = [(-0.2, 0.1), (-0.1, -0.2), (0.05, 0.15), (0.2, 0.2), (0.15, -0.1)]
    at = [walop.trace(run, x=x, y=y, q=0.01, u=-0.004)[-1].value.ravel() for x, y in places]
    counts = np.random.default_rng(6).poisson(1e6 * np.array(at * 2)).astype(float)
    x, y = np.array(places * 2).T
    mjd = np.repeat([61220.8, 61221.0], len(places))
    return Table({"X": x, "Y": y, "N": counts, "N_ERR": np.sqrt(counts), "MJD": mjd})


@pytest.fixture
def here(home: Path, tmp_path: Path, monkeypatch) -> Path:
    """A copy of that folder, in which commands are typed."""
    monkeypatch.chdir(shutil.copytree(home, tmp_path / "here"))
    return tmp_path / "here"


@pytest.mark.parametrize("line", lines(""))
def test_what_is_written_is_read_and_gone_on_with(line: Line, call, here: Path):
    _type(line, call)


@pytest.mark.parametrize("line", lines("seconds"))
def test_so_is_what_takes_seconds(line: Line, call, here: Path):
    _type(line, call)


@pytest.mark.long
@pytest.mark.parametrize("line", lines("minutes"))
def test_so_is_what_takes_minutes(line: Line, call, here: Path):
    if line.words.startswith("sample"):
        shutil.copytree("RUN", "SAMPLED")
    if "frames.fits" in line.words:
        _frames(here / "frames.fits")
    _type(line, call)


def _type(line: Line, call: Call) -> None:
    words = shlex.split(line.words)
    done = call(*words)
    assert done.exit_code == 0, done.output
    assert done.stdout.strip()
    output = words[words.index("-o") + 1] if "-o" in words else ""
    if output:
        _read_back(Path(output if words[0] != "demo" else f"{output}/RUN"), line, call)
    for following in _suggested(done.stderr):
        _typed(following, call)


def _frames(path: Path) -> None:
    """Whole frames, so many pixels that cells are made of them."""
    side = 60
    run = frame_run(side)
    write_frames(path, simulate(run, seed=6).calset, raster(run, side))


def _read_back(output: Path, line: Line, call: Call) -> None:
    """What a command has written, as whoever comes next reads it; each file of a folder is on the page of files."""
    if output.is_dir():
        run = walop.read(output)
        assert line.document in run.documents
        assert str(output) in repr(run)
        done = call("report", output)
        assert done.exit_code == 0, done.output
        assert (output / "report.html").stat().st_size > 5000
        documented = (ROOT / "walop_jax" / "docs" / "files.md").read_text(encoding="utf-8")
        assert [entry.name for entry in output.iterdir() if entry.name not in documented] == []
    elif output.suffix == ".fits":
        with fits.open(output) as hdus:
            is_set = "EXPOSURES" in hdus
        assert len(walop.read(output).points if is_set else Table.read(output)) > 0
    else:
        assert output.stat().st_size > 200


def _suggested(told: str) -> list[str]:
    """The commands of the line `Next: …`."""
    match = re.search(r"Next: (.*)", told)
    return [] if match is None else [one for one in match[1].split(" or ") if one.startswith("walop-jax ")]


def _typed(line: str, call: Call) -> None:
    """A command as it is printed, with the words in capitals replaced by what is there."""
    words = [PLACEHOLDERS.get(word, word) for word in shlex.split(line)[1:]]
    if "-o" in words:
        at = words.index("-o") + 1
        words[at] = f"next_{Path(words[at]).name}"
    if words[0] == "plan":
        words += ["--draws", "1"]  # as good a plan takes twenty times as long
    done = call(*words)
    if "design.fits" in words:  # transmissions of no instrument: no model explains them
        assert "the fit did not converge" in done.output
        return
    assert done.exit_code in (0, UNTRUSTED), f"{line}: {done.output}"

"""Every command as a function: the same options, the same results, files, documents and errors as the program."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from astropy.table import Table
from camera_files import four, some_stars

import walop_jax as walop
from walop_jax.commands import COMMANDS
from walop_jax.commands.command import COMMON
from walop_jax.data.settings import DEFAULT_FILTER
from walop_jax.posterior.result import Options
from walop_jax.science.polarisation import ESTIMATORS

from .conftest import FittedSet, assert_same_files, without_times

FUNCTIONS = {name: getattr(walop, name.replace("-", "_")) for name in COMMANDS}
# What only Python can say: columns and elements by name, fits in memory, what is no text.
PYTHON_ONLY = {
    "simulate": {"noiseless", "catalogue_seed"},
    "compare": {"calibration"},
    "plot": {"ax", "figsize", "reference"},
    "sample": {"parameters", "options"},
}


@pytest.mark.parametrize("name", COMMANDS)
def test_options_are_those_of_the_function(name: str, call):
    """An argument or option for each parameter, spelled like it, and none else; the rest is said above."""
    function = FUNCTIONS[name]
    parameters = inspect.signature(function).parameters
    command = function.command
    own = [key for key in parameters if key not in COMMON and key not in PYTHON_ONLY.get(name, ())]
    assert own == list(command.options)
    text = call(name, "--help").output
    for key, option in command.options.items():
        spelled = option.metavar if option.placed else f"--{key.replace('_', '-')}"
        assert spelled in text, key
        assert " ".join(option.help.split()[:3]) in " ".join(text.split())
        assert f"\n{key}: {option.help}" in function.__doc__
    assert ("--overwrite" in text) == ("overwrite" in parameters)
    assert {"progress", "seed"} <= set(parameters)
    assert "--json" in text
    assert "--quiet" in text


def test_defaults_are_those_of_what_is_called():
    def default(name: str, key: str) -> Any:
        return inspect.signature(FUNCTIONS[name]).parameters[key].default

    assert default("diagnose", "minutes") is None
    assert default("compare", "filter") == default("trace", "filter") == DEFAULT_FILTER
    assert default("apply", "debias") == ESTIMATORS[0]
    for key in ("sampler", "walkers", "interval", "maximum_steps", "moves"):
        assert default("sample", key) == getattr(Options(), key)


@pytest.mark.parametrize("name", COMMANDS)
def test_an_argument_that_does_not_exist_is_named_with_the_nearest(name: str):
    with pytest.raises(TypeError, match=r"'sede'.*did you mean 'seed'"):
        FUNCTIONS[name](sede=1)


@pytest.mark.parametrize(
    ("call_it", "message"),
    [
        (
            lambda: walop.refit(3),
            "3 is not a calibration set; give a set, the path of one (FITS), or several",
        ),
        (
            lambda: walop.refit("x.fits", 7),
            "7 is not a model; give base_model(calset), or the path of a model",
        ),
        (lambda: walop.refit("x.fits", overwrite="yes"), "refit: overwrite is the text 'yes'; give a number"),
        (
            lambda: walop.diagnose("x.fits", minutes="ten"),
            "diagnose: minutes is the text 'ten'; give a number",
        ),
        (lambda: walop.check({}), "{} is not a run or a calibration; give a fit, a Run, or the path of a"),
        (lambda: walop.trace(instrument=[]), "[] is not an instrument; give its name, its description file"),
        (lambda: walop.report(1.0), "1.0 is not a run or a calibration; give a fit, a Run, or the path of"),
        (
            lambda: walop.refit("x.fits", free=["half1.wedge"]),
            "refit: there is no argument 'free'; that is a matter of the model: model=base_model(calset)",
        ),
        (walop.refit, "refit: missing a required argument: 'data'; the arguments are data, model"),
    ],
)
def test_a_wrong_kind_of_argument_is_one_sentence(call_it: Callable[[], Any], message: str):
    with pytest.raises((TypeError, ValueError)) as raised:
        call_it()
    assert message in str(raised.value)


# ---------------------------------------------------------------------------------------------- run, both ways


class Case(NamedTuple):
    """A command: words of the command line, the call in Python, and the option that names its output, if it has one."""

    words: Callable[[Any], tuple[object, ...]]
    python: Callable[..., Any]
    output: str = ""
    long: bool = False


PLAN = "grid = 3\nstandard_grid = 1\npolariser_angles = 4\nmoon_patches = 2\nstandards = 3\n"
CASES = {
    "inspect": Case(lambda g: (g.calset,), lambda g, **k: walop.inspect(g.calset, **k)),
    "simulate": Case(
        lambda g: (g.plan, "--effect", "hwp1_axis=0.3"),
        lambda g, **k: walop.simulate(g.plan, effect={"hwp1_axis": 0.3}, **k),
        "set.fits",
    ),
    "refit": Case(lambda g: (g.calset,), lambda g, **k: walop.refit(g.calset, **k), "RUN"),
    "diagnose": Case(lambda g: (g.calset,), lambda g, **k: walop.diagnose(g.calset, **k), "RUN", True),
    "limits": Case(
        lambda g: (g.calset, "--seed", 3), lambda g, **k: walop.limits(g.calset, seed=3, **k), "RUN", True
    ),
    "compare": Case(lambda g: (g.calset,), lambda g, **k: walop.compare(g.calset, **k), "RUN", True),
    "report": Case(lambda g: (g.run,), lambda g, **k: walop.report(g.run, **k), "page.html", True),
    "plot": Case(lambda g: (g.run, "matrix"), lambda g, **k: walop.plot(g.run, "matrix", **k), "m.png", True),
    "matrix": Case(
        lambda g: (g.run, "--points", g.points),
        lambda g, **k: walop.matrix(g.run, points=g.points, **k),
        "m.ecsv",
    ),
    "gather": Case(lambda g: g.cameras, lambda g, **k: walop.gather(g.cameras, **k), "s.ecsv"),
    "apply": Case(lambda g: (g.run, g.stars), lambda g, **k: walop.apply(g.run, g.stars, **k), "s.ecsv"),
    "check": Case(lambda g: (g.run,), lambda g, **k: walop.check(g.run, **k), "RUN"),
    "check set": Case(
        lambda g: (g.run, g.calset), lambda g, **k: walop.check(g.run, g.calset, **k), "RUN", True
    ),
    "check stars": Case(
        lambda g: (g.run, g.stars), lambda g, **k: walop.check(g.run, g.stars, **k), "RUN", True
    ),
    "check against": Case(
        lambda g: (g.run, "--against", g.run, g.stars),
        lambda g, **k: walop.check(g.run, g.stars, against=g.run, **k),
        "RUN",
        True,
    ),
    "model": Case(
        lambda g: (g.calset, "--effect", "clp_zero"),
        lambda g, **k: walop.model(g.calset, effect=["clp_zero"], **k),
        "m.toml",
    ),
    "instrument": Case(lambda g: ("WALOP-SOUTH",), lambda g, **k: walop.instrument("WALOP-SOUTH", **k)),
    "trace": Case(lambda g: (g.run, "--x", 0.1), lambda g, **k: walop.trace(g.run, x=0.1, **k)),
    "standards": Case(
        lambda g: ("--near", "308,41"), lambda g, **k: walop.standards(near=(308.0, 41.0), **k)
    ),
    "cite": Case(lambda g: (g.run,), lambda g, **k: walop.cite(g.run, **k)),
    "docs": Case(lambda g: ("files",), lambda g, **k: walop.docs("files", **k)),
}
ELSEWHERE = {"exposures", "demo", "sample", "plan", "stack"}
# data/test_header_words; test_sample; tests/plans; tests/nights
CHEAP = [name for name, case in CASES.items() if not case.long]
WRITING = [name for name in CHEAP if CASES[name].output]
TABLE = [pytest.param(name, marks=[pytest.mark.long] if CASES[name].long else []) for name in CASES]


def test_every_command_is_in_the_table():
    assert set(COMMANDS) == {name.split()[0] for name in CASES} | ELSEWHERE


class Given(NamedTuple):
    plan: Path
    calset: Path
    run: Path
    points: Path
    stars: Path
    cameras: tuple[Path, ...]


@pytest.fixture
def given(fitted: FittedSet, tmp_path: Path) -> Given:
    (tmp_path / "points.csv").write_text("X,Y\n0,0\n0.2,-0.1\n")
    n = np.array([[2.1e5, 1.9e5, 2e5, 2e5], [1.9e5, 2.1e5, 2e5, 2.1e5]])
    stars = Table({"X": [0.1, 0.2], "Y": [0.0, 0.1], "N": n, "N_ERR": np.sqrt(n)})
    stars.write(tmp_path / "stars.fits")
    (tmp_path / "plan.toml").write_text(PLAN)
    return Given(
        tmp_path / "plan.toml",
        fitted.calset,
        fitted.run,
        tmp_path / "points.csv",
        tmp_path / "stars.fits",
        tuple(four(some_stars(), tmp_path)),
    )


OF_STARS = ("check stars", "apply")  # of which the program says that they disagree with the calibration


@pytest.mark.parametrize("name", TABLE)
def test_files_and_document_are_those_of_the_program(name: str, call, given: Given, tmp_path: Path):
    """With --json nothing else is on stdout; progress is told; the seed is an integer."""
    case, told = CASES[name], []
    command, caller = tmp_path / "command", tmp_path / "caller"
    command.mkdir()
    caller.mkdir()
    words = ("-o", command / case.output) if case.output else ()
    done = call(name.split()[0], *case.words(given), *words, "--json")
    # Two stars, one camera too bright.
    assert done.exit_code == (3 if name in OF_STARS else 0), done.output
    document = json.loads(done.stdout)
    output = {"output": caller / case.output} if case.output else {}
    value = case.python(given, progress=told.append, **output)
    assert value is not None
    assert_same_files(command, caller)
    if case.output.startswith("RUN"):
        assert_same_files(command / case.output, caller / case.output)
    if name not in ("instrument", "docs", "trace", "cite", "standards", "model"):
        assert told
    if isinstance(document, dict) and "seed" in document:
        assert isinstance(document["seed"], int)
    made = getattr(value, "document", None)
    if made is not None and name not in (
        "compare",
        "check",
        "check set",
        "check stars",
        "check against",
        "limits",
        "refit",
        "diagnose",
        "report",
        "model",
    ):
        assert without_times(json.loads(json.dumps(made()))) == without_times(document)


@pytest.mark.parametrize("name", CHEAP)
def test_quiet_is_quiet_and_without_output_nothing_is_written(
    name: str, call, given: Given, tmp_path: Path, monkeypatch
):
    case, before = CASES[name], sorted(tmp_path.iterdir())
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert case.python(given) is not None
    assert not any((tmp_path / "here").iterdir())
    assert sorted(entry for entry in tmp_path.iterdir() if entry.name != "here") == before
    words = ("-o", case.output) if case.output else ()
    quiet = call(name, *case.words(given), *words, "--quiet")
    assert (quiet.exit_code, quiet.stdout) == (3 if name in OF_STARS else 0, "")


@pytest.mark.parametrize("name", WRITING)
def test_what_exists_stays_unless_told_otherwise(name: str, call, given: Given, tmp_path: Path):
    case = CASES[name]
    output = tmp_path / "out" / case.output
    document = "check.json" if name == "check" else "summary.json"
    mine = output / document if case.output == "RUN" else output
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    refused = call(name, *case.words(given), "-o", output)
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    with pytest.raises(walop.DataError, match="overwrite=True"):
        case.python(given, output=output)
    assert mine.read_text() == "mine"
    case.python(given, output=output, overwrite=True)
    assert mine.read_bytes() != b"mine"


@pytest.mark.parametrize("error", [MemoryError(), KeyboardInterrupt()])
@pytest.mark.parametrize("name", WRITING)
def test_an_interrupted_command_leaves_nothing(
    name: str, call, given: Given, tmp_path: Path, monkeypatch, error
):
    """Whatever is being written when it stops."""

    def half(*args: Any, **more: Any) -> None:
        path = next(entry for entry in args if isinstance(entry, Path))
        path.write_bytes(b"half")
        raise error

    case, written = CASES[name], Path.write_text
    (tmp_path / "out").mkdir()

    def half_of_text(path: Path, *args: Any, **more: Any) -> int:
        return half(path) if path.is_relative_to(tmp_path) else written(path, *args, **more)

    for target in ("walop_jax.data.write.sign_and_write", "walop_jax.calibration.product.sign_and_write"):
        monkeypatch.setattr(target, half)
    with monkeypatch.context() as patch:
        patch.setattr(Table, "write", lambda self, *args, **more: half(*args))
        patch.setattr(Path, "write_text", half_of_text)
        result = call(name, *case.words(given), "-o", tmp_path / "out" / case.output)
    assert result.exit_code == (130 if isinstance(error, KeyboardInterrupt) else 1)
    assert not any((tmp_path / "out").iterdir())

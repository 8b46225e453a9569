"""Every block of code of every page and of the README: Python runs, TOML is read, the program takes its command lines.

Pages that a test of their own runs (`ELSEWHERE`) are held to their text here: no block of theirs is left out.
"""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import textwrap
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import test_differentiate
import test_recipes
from astropy.io import fits
from astropy.table import Table
from small_run import SEED, SMALL
from typer.main import get_command

import walop_jax as walop
from walop_jax.commands.docs import pages
from walop_jax.commands.program import app

ROOT = Path(__file__).resolve().parents[1]
TEXTS = {
    **pages(),
    "index": (ROOT / "walop_jax" / "docs" / "index.md").read_text(encoding="utf-8"),
    "README": (ROOT / "README.md").read_text(encoding="utf-8"),
    "CONTRIBUTING": (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8"),
}
INDENTED = re.compile(r"(?:(?<=\n\n)|\A)(?: {4}.*\n(?:\n(?= {4}))*)+", re.MULTILINE)
FENCED = re.compile(r"^```\w*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NEEDED_ELSEWHERE = {"dask_jobqueue", "numpyro", "blackjax", "optax"}  # not installed with every test


def blocks(text: str) -> list[str]:
    """The blocks of a page, without their indentation: fenced ones, and those that are indented outside of fences."""
    outside = FENCED.sub("\n", text)
    return [textwrap.dedent(block) for block in (*FENCED.findall(text), *INDENTED.findall(outside))]


def is_toml(block: str) -> bool:
    try:
        return bool(tomllib.loads(block))
    except tomllib.TOMLDecodeError:
        return False


def is_python(block: str) -> bool:
    """Python that does something: equations can be Python as well, but import, define, assign or call nothing."""
    try:
        tree = ast.parse(block)
    except SyntaxError:
        return False
    doing = ast.Import | ast.ImportFrom | ast.FunctionDef | ast.ClassDef | ast.Assign | ast.Call
    return not is_toml(block) and any(isinstance(node, doing) for node in ast.walk(tree))


PYTHON = {page: [b for b in blocks(text) if is_python(b)] for page, text in TEXTS.items()}
PYTHON = {page: code for page, code in PYTHON.items() if code}


# ------------------------------------------------------------------------------------------------------- Python


def _words(code: str) -> str:
    return " ".join(code.split())


ELSEWHERE = {
    "differentiate": lambda: [
        test_differentiate.script(test_differentiate.HEAD),
        *test_differentiate.SCRIPTS.values(),
    ],
    "recipes": test_recipes.SCRIPTS.values,
    "README": lambda: PYTHON["README"],  # test_readme.py
    "files": lambda: PYTHON["files"],  # calibration/test_foreign_reader.py
    "nights": lambda: PYTHON["nights"],  # nights/test_survey.py
}
HERE = ("adding-a-command", "adding-an-effect", "adding-an-instrument", "year")


def test_every_page_with_python_is_run():
    assert sorted(PYTHON) == sorted((*ELSEWHERE, *HERE))
    assert [len(PYTHON[page]) for page in ("README", "files", "nights")] == [1, 1, 3]
    for page, scripts in ELSEWHERE.items():
        whole = "\n".join(map(_words, scripts()))
        for block in PYTHON[page]:
            assert _words(block) in whole, (page, block)


@pytest.mark.parametrize(("page", "block"), [(p, b) for p, code in PYTHON.items() for b in code])
def test_what_a_block_imports_is_there(page: str, block: str):
    """The imports of every block, without running it; and public names are asked of the package that has them."""
    tree = ast.parse(block)
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [getattr(node, "module", None) or node.names[0].name]
            if names[0].split(".")[0] not in NEEDED_ELSEWHERE:
                exec(compile(ast.Module([node], []), page, "exec"), {})
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "walop":
            assert hasattr(walop, node.attr), node.attr


def ran(page: str, names: dict[str, Any], block: str) -> None:
    exec(compile(block, page, "exec", dont_inherit=True), names)


def test_the_instrument_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its instrument, plan, element and source, one after the other; the element against its closed form."""
    monkeypatch.chdir(tmp_path)
    toml = [block for block in blocks(TEXTS["adding-an-instrument"]) if is_toml(block)]
    (tmp_path / "my_instrument.toml").write_text(next(one for one in toml if one.startswith("name =")))
    plan = next(one for one in toml if one.startswith("instrument =")) + (
        "grid = 3\npolariser_angles = 6\nmoon_patches = 2\nstandards = 2\n"
    )
    (tmp_path / "plan.toml").write_text(plan)
    calset = walop.simulate("plan.toml", seed=1).calset
    fit, element, source = PYTHON["adding-an-instrument"]
    names: dict[str, Any] = {"__name__": "page", "walop": walop, "calset": calset}
    ran("instrument", names, fit)
    assert names["result"].model.template.name == "TWO-BEAM"
    ran("instrument", names, element)
    kind = names["Depolariser"]
    haze = names["instrument"].inserted(kind(loss=0.01), before="plate")
    bare, hazy = (one.mueller(0.1, -0.05, 0.55) for one in (names["instrument"], haze))
    kept = 1.0 - 0.01 * (0.62 / 0.55) ** 4
    np.testing.assert_allclose(hazy, bare @ np.diag([1.0, kept, kept, 1.0]), atol=1e-14)
    dusk = dict.fromkeys(["moon"], "twilight")
    kinds = np.array([dusk.get(one, one) for one in calset.exposures.kind])
    _rewritten(calset, kinds, tmp_path / "dusk.fits")
    ran("instrument", names, source)
    assert set(names["calset"].exposures.kind) == {"clp", "standard", "twilight"}


def _rewritten(calset: walop.CalibrationSet, kinds: np.ndarray, path: Path) -> None:
    """The set in a file, with these KINDs."""
    walop.write_calibration_set(path, calset)
    with fits.open(path) as opened:
        hdus: Any = opened
        table = Table(hdus["EXPOSURES"].data)
        table["KIND"] = kinds
        hdus["EXPOSURES"] = fits.BinTableHDU(table, header=hdus["EXPOSURES"].header, name="EXPOSURES")
        hdus.writeto(path, overwrite=True, checksum=True)


def test_the_effect_page(monkeypatch: pytest.MonkeyPatch):
    """Its class, its patch of a number, and the call that gives the class to a search."""
    spot, patch, search = PYTHON["adding-an-effect"]
    names: dict[str, Any] = {"__name__": "page", "walop": walop, "calset": None}
    ran("effect", names, spot)
    assert issubclass(names["Spot"], walop.Effect)
    instrument = walop.Instrument.read("WALOP-SOUTH")
    before = instrument.element("half1.plate").layers[1].axis
    ran("effect", names, patch)
    patched = names["patch"](SimpleNamespace(angle=0.5), instrument)
    assert float(patched.element("half1.plate").layers[1].axis - before) == pytest.approx(0.5)
    given: list[Any] = []
    monkeypatch.setattr(
        walop, "diagnose", lambda calset, effects: given.extend(effects)
    )  # run by test_recipes
    ran("effect", names, search)
    assert given == [*walop.EFFECTS, names["Spot"]]


def test_the_command_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its command, from its file alone: it has its options, counts, and writes its document."""
    (tmp_path / "count.py").write_text(PYTHON["adding-a-command"][0], encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    count = importlib.import_module("count").count
    calset = walop.simulate(SMALL, seed=SEED).calset
    block = calset.intensities.block(0, len(calset.points))
    used = block.counts[block.used]
    limit = float(np.median(used))
    assert count(calset, output=tmp_path / "RUN", least=limit) == int((used >= limit).sum())
    assert (tmp_path / "RUN" / "count.json").exists()
    assert list(count.command.options) == ["data", "output", "least"]
    assert "least: Fewest electrons that count." in count.__doc__


def test_the_year(capsys: pytest.CaptureFixture):
    """The whole year in Python; it says what the page says that it finds."""
    (year,) = PYTHON["year"]
    names: dict[str, Any] = {"__name__": "page"}
    ran("year", names, year)
    said = capsys.readouterr().out
    assert "Fit of WALOP-SOUTH: go" in said
    assert "the instrument has changed: hwp1_axis.angle by 0." in said
    (angle,) = re.findall(r"^ *hwp1_axis +angle +(\S+) +(\S+) +deg", said, re.MULTILINE)
    assert abs(float(angle[0]) - 0.1) < 4.0 * float(angle[1])
    assert "Survey of WALOP-SOUTH: go" in said


# ------------------------------------------------------------------------------------------------ command lines


def lines(page: str) -> Iterator[str]:
    """Command lines of the program in the blocks of a page, without comments, pipes, prompts and `\\` at their ends."""
    for block in blocks(TEXTS[page]):
        for line in re.sub(r"\\\n\s*", " ", block).splitlines():
            for part in re.split(r"&&|;|\||(?<!\S)#.*", line.removeprefix("$ ")):
                if part.strip().startswith("walop-jax "):
                    yield part.strip()


TYPED = [(page, line) for page in TEXTS for line in lines(page)]
INLINE = sorted(
    {
        " ".join(text.split())
        for page in TEXTS.values()
        for text in re.findall(r"`(walop-jax [^`]+)`", FENCED.sub("\n", page))
    }
)


def words(line: str) -> list[str]:
    return shlex.split(line.partition(" > ")[0])[1:]


def test_there_are_lines_to_parse():
    assert len(TYPED) > 30
    assert len(INLINE) > 60


@pytest.mark.parametrize(("page", "line"), TYPED)
def test_the_program_takes_a_line(page: str, line: str):
    """The whole line: its command, its arguments, options and values; nothing is run."""
    name, *rest = words(line)
    group: Any = get_command(app)
    command = group.get_command(None, name)
    assert command is not None, name
    command.make_context(name, rest)


@pytest.mark.parametrize("line", INLINE)
def test_the_program_has_the_options_of_a_sentence(line: str):
    """Commands in the text may leave something out, but all they name is there."""
    found = words(line)
    group: Any = get_command(app)
    if found[0].startswith("-"):
        options = {"-h", "--help", *(name for p in group.params for name in p.opts)}
        assert found[0] in options
        return
    if found[0].isupper():  # a word in the place of a command
        return
    command = group.get_command(None, found[0])
    assert command is not None, found[0]
    options = {"-h", "--help"}
    for parameter in command.params:
        options.update(parameter.opts, parameter.secondary_opts)
    for word in found[1:]:
        if re.match(r"-[a-zA-Z-]", word):
            assert word.partition("=")[0] in options, word


# ---------------------------------------------------------------------------------------------- what is installed


def test_extras_of_the_pages_are_there():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = {
        extra.strip()
        for text in TEXTS.values()
        for extras in re.findall(r"pip install[^\n`]*?\[([\w, -]+)\]", text)
        for extra in extras.split(",")
    }
    assert named - {"cuda13", "cuda12"} <= set(project["optional-dependencies"])  # those are extras of JAX

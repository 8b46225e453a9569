"""What the README promises: its example runs, its commands exist, its files are there."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    block = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert block is not None
    monkeypatch.chdir(tmp_path)
    exec(compile(block[1], "README.md", "exec"), {})
    assert "trusted: True" in capsys.readouterr().out
    assert (tmp_path / "calibration.png").stat().st_size > 50_000


def test_links_and_files_exist():
    for path in (
        *re.findall(r"\]\(([^)]+)\)", TEXT),
        *re.findall(r"((?:fits_data|notebooks|tests)/[\w./]+\w)", TEXT),
    ):
        assert (ROOT / path).exists(), path
    assert (ROOT / "notebooks/figures/calibration.png").stat().st_size < 200_000


def test_version_is_one():
    import tomllib

    import walop_jax

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert project["version"] == walop_jax.__version__
    assert f"version: {walop_jax.__version__}" in citation
    assert f"## {walop_jax.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_false_alarms_are_those_of_the_study():
    study = (ROOT / "walop_jax" / "docs" / "validation.md").read_text(encoding="utf-8")
    allowed = r"\(27 in 10 000 are allowed\) \| (\d+) \|"
    row = re.search(rf"^\| false alarms, 1000 scenes with nothing hidden {allowed}", study, re.MULTILINE)
    told = re.search(rf"1000 simulated scenes with nothing hidden: false alarms {allowed}", TEXT)
    assert row is not None
    assert told is not None
    assert told[1] == row[1]


def outputs_of(notebook: str) -> str:
    """What the stored notebook has printed."""
    cells = json.loads((ROOT / "notebooks" / f"{notebook}.ipynb").read_text(encoding="utf-8"))["cells"]
    texts = (one.get("text", ()) for cell in cells for one in cell.get("outputs", ()))
    return " ".join(" ".join("".join(text) for text in texts).split())


def test_other_instruments_are_described_as_in_their_notebooks():
    """The table of five instruments against what the notebooks have printed."""
    rows = (row for row in TEXT.splitlines() if row.startswith("| ") and "](notebooks/" in row)
    table = {row.split("](notebooks/")[1].split(".ipynb")[0]: row for row in rows}
    assert set(table) == {"charis", "nasmyth", "metasurface", "two_retarders", "walop_north_design"}
    told = outputs_of("charis")
    assert "84 free, rms 0.281 %" in told
    assert "bin by bin [10.98" in told
    assert "worse than one instrument in 22 of 22" in told
    assert "84 numbers; 0.28 %" in table["charis"]
    assert "22 of 22 bins" in table["charis"]
    told = outputs_of("nasmyth")
    assert "all: 1.24 with 6 numbers" in told
    assert re.search(r"constant q, u +8 numbers, χ²/dof 1\.17", told)
    assert "χ²/dof 1.24 |" in table["nasmyth"]
    assert "χ²/dof 1.17 |" in table["nasmyth"]
    ratios = [float(b) / float(a) for a, b in re.findall(r"fitted ([\d.]+), left out ([\d.]+)", told)]
    assert len(ratios) == 5
    assert sum(ratio > 1.25 for ratio in ratios) == 1
    assert max(ratios) < 2.0
    (left,) = re.findall(
        r"second order 108 numbers, rms \(%\) of d1 to d4 and the meter \[([^\]]+)\]",
        told := outputs_of("metasurface"),
    )
    (out,) = re.findall(r"left out, flux from all five \[([^\]]+)\]", told)
    for values in (left, out):
        assert all(0.08 < float(one) < 0.11 for one in values.split()[:4])
    assert "108 numbers; 0.10 %" in table["metasurface"]
    told = outputs_of("two_retarders")
    assert "37 numbers, rms 0.989 %" in told
    assert "fitted 0.987 %, left out 0.999 %" in told
    assert "37 numbers for all; 0.99 % | every fourth bin: 1.00 %" in table["two_retarders"]


def test_the_test_command_is_that_of_contributors_and_of_the_checks():
    """Set-up and tests are two lines that anybody can paste."""
    upgrade, install = "python -m pip install --upgrade pip", "pip install -e . --group test"
    test = "python -m pytest -n 2 --fast"
    assert f"{upgrade} && {install} && {test}\n" in TEXT
    contributing = (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8")
    checks = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for text in (contributing, checks):
        assert test in text
    assert f"{upgrade} && {install}\n" in contributing
    # Pip that comes with Python 3.11 to 3.13 knows no dependency groups: it is upgraded first here as well.
    assert checks.index("pip install --quiet --upgrade pip") < checks.index("-e . --group test")

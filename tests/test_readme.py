"""What the README promises: its example runs, its commands exist, its files are there."""

from __future__ import annotations

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

"""What the README promises: its example runs, its commands exist, its files are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from walop_jax.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    block = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert block is not None
    monkeypatch.chdir(tmp_path)
    exec(compile(block[1], "README.md", "exec"), {})
    assert "trusted: True" in capsys.readouterr().out
    assert (tmp_path / "calibration.png").stat().st_size > 50_000


def test_commands_exist():
    named = set(re.findall(r"(?:^|`|&& )walop-jax ([a-z][a-z-]+)", TEXT, re.MULTILINE))
    assert len(named) > 5
    assert named <= set(COMMANDS)


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

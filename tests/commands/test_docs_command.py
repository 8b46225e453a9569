"""`walop-jax docs`: the list, a page as text and on a terminal, a name that does not exist; and pages against files."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest

from walop_jax.commands.docs import about, pages


def test_list_of_pages(call):
    lines = call("docs").stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(pages())
    for line, text in zip(lines, pages().values(), strict=True):
        assert line.endswith(about(text))


def test_a_page_is_plain_text_where_nobody_looks(call):
    assert call("docs", "files").stdout == pages()["files"]
    assert call("docs", "Files.md").stdout == pages()["files"]


def test_a_page_is_rendered_on_a_terminal(call, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    shown = call("docs", "conventions").stdout
    plain = re.sub(r"\x1b\[[0-9;]*m", "", shown)
    assert plain != shown
    assert "## Sky" not in plain
    assert "| --- |" not in plain
    assert "ROTATOR is the position angle" in plain
    assert max(map(len, plain.splitlines())) <= 120


def test_a_name_that_does_not_exist_lists_the_nearest(call):
    found = call("docs", "efects")
    assert found.exit_code == 2
    assert "effects" in found.output


def test_parameters_of_the_base_model(call):
    """The table of `docs model` against what `walop-jax model` says of the instruments in it."""
    lines = [
        line.strip("| ").split("|")
        for line in pages()["model"].splitlines()
        if re.match(r"\| [a-z]+[\w.]*\.", line)
    ]
    told = {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines}
    for column, instrument in enumerate(("WALOP-SOUTH", "WALOP-LAB"), start=1):
        document = json.loads(call("model", "--instrument", instrument, "--json").stdout)
        parameters = {n: p for n, p in document["parameters"].items() if not n.startswith("throughput.")}
        assert set(told) == set(parameters)
        for name, p in parameters.items():
            assert told[name][0] == p["unit"], name
            assert float(told[name][column]) == pytest.approx(p["start"], rel=1e-5), name
            width = told[name][3].split("; ")[-1 if instrument == "WALOP-LAB" else 0]
            assert p["prior"] is None if width == "none" else p["prior"][1] == pytest.approx(float(width)), (
                name
            )


def test_effects_of_the_command_line(call):
    """The examples of `docs effects` are understood."""
    for spelling in re.findall(r"--effect (\w+) ", pages()["effects"]):
        assert spelling in tomllib.loads(call("model", "--effect", spelling).stdout)["model"]["effects"]


def keys(document: Any) -> Iterator[str]:
    if isinstance(document, dict):
        for key, value in document.items():
            yield key
            if key not in ("parameters", "versions"):  # named by the model and by the packages
                yield from keys(value)
    elif isinstance(document, list):
        for value in document:
            yield from keys(value)


def test_summary_of_a_run_is_explained(run):
    text = pages()["files"].partition("### summary.json")[2].partition("### diagnosis.json")[0]
    found = set(keys(json.loads((run / "summary.json").read_text(encoding="utf-8"))))
    assert len(found) > 20
    assert [key for key in found if f"`{key}`" not in text] == []

"""Every observing plan that a page shows to be copied is one that `inspect` has no doubt of, and good for `compare`."""

from __future__ import annotations

import ast
import contextlib
import itertools
import json
import re
import textwrap
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.commands.docs import pages
from walop_jax.data.inspection import inspect
from walop_jax.paper.polynomial import polariser_exposures
from walop_jax.simulation.observing_plan import ObservingPlan, plan_of
from walop_jax.simulation.simulate import _catalogue, _without_light

ROOT = Path(__file__).resolve().parents[1]
TEXTS = {f"{topic}.md": text for topic, text in pages().items()} | {
    path.name: path.read_text() for path in (ROOT / "README.md", ROOT / ".github" / "CONTRIBUTING.md")
}


def blocks(text: str) -> Iterator[str]:
    """Blocks of code: indented, or fenced; empty lines are inside."""
    for fenced in re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        yield textwrap.dedent(fenced)
    for inside, lines in itertools.groupby(
        text.splitlines(), lambda line: not line or line.startswith("    ")
    ):
        if inside:
            yield textwrap.dedent("\n".join(lines)).strip()


def files_of_plans(text: str) -> Iterator[ObservingPlan]:
    """Plans as files. A list of stops goes into one, and is none by itself."""
    for block in blocks(text):
        with contextlib.suppress(tomllib.TOMLDecodeError):
            content = tomllib.loads(block)
            if "grid" in content or "polariser_angles" in content:
                yield plan_of(content, Path())


def plans_in_python(code: str) -> Iterator[ObservingPlan]:
    """Plans that Python makes, with the numbers that are named in the same code."""
    names: dict[str, Any] = {"np": np, "walop": walop, "ObservingPlan": ObservingPlan, "tuple": tuple}
    try:
        tree = ast.parse(code)
    except SyntaxError:
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and "ObservingPlan" in code:
            value = node.value
            if not any(
                isinstance(part, ast.Attribute) and part.attr == "simulate" for part in ast.walk(value)
            ):
                with contextlib.suppress(Exception):
                    names[node.targets[0].id] = eval(ast.unparse(value), names)
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("ObservingPlan"):
            yield eval(ast.unparse(node), names)


def shown() -> Iterator[tuple[str, ObservingPlan]]:
    for name, text in TEXTS.items():
        yield from ((f"{name} (file)", plan) for plan in files_of_plans(text))
        for block in blocks(text):
            yield from ((f"{name} (Python)", plan) for plan in plans_in_python(block))
    for path in sorted((ROOT / "notebooks").glob("*.py")):
        yield from ((path.name, plan) for plan in plans_in_python(path.read_text()))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text())["cells"]
        for code in ("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"):
            yield from ((path.name, plan) for plan in plans_in_python(code))


SHOWN = list(shown())


def test_plans_are_found():
    names = {name for name, _ in SHOWN}
    assert {"year.md (file)", "files.md (file)", "year.md (Python)", "recipes.md (Python)"} <= names
    assert len(SHOWN) >= 8


@pytest.mark.parametrize(("name", "plan"), SHOWN, ids=[f"{name} {k}" for k, (name, _) in enumerate(SHOWN)])
def test_a_plan_of_a_page_is_a_good_one(name, plan):
    """Its exposures and points, without light: eight directions of the polariser and more, five for the polynomial."""
    sources, _ = _catalogue(plan, np.random.default_rng(0))
    calset = _without_light(plan, sources, 0, len(plan.design.cameras))
    assert [str(finding) for finding in inspect(calset).findings if finding.severity != "note"] == []
    if plan.design.polariser is not None and not plan.moving:
        rows = polariser_exposures(calset, plan.filter_names[0])
        assert len(np.unique(np.mod(calset.exposures.clp_angle[rows], 180.0).round(6))) >= 8

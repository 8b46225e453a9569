"""The front door: the names that others may rely on, and what importing the package costs."""

from __future__ import annotations

import ast
import doctest
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_run import small_fit

import walop_jax
from walop_jax.commands import COMMANDS


@pytest.mark.parametrize("name", [name for name in walop_jax.__all__ if name != "Scalar"])  # a type
def test_every_public_name_is_there_and_documented(name: str):
    assert getattr(walop_jax, name).__doc__
    assert name in dir(walop_jax)


@pytest.fixture(scope="module")
def at_hand(tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    """What the examples of docstrings begin with: a set, its fit, both as files."""
    folder = tmp_path_factory.mktemp("examples")
    result = small_fit()
    walop_jax.write_calibration_set(folder / "night.fits", result.calset)
    result.save(folder / "RUN")
    return folder, {"walop": walop_jax, "np": np, "result": result, "calset": result.calset}


@pytest.mark.parametrize(
    "name", sorted(set(walop_jax.__all__) - {"Scalar", "EFFECTS"})
)  # they have no docstring
def test_the_example_of_a_public_name(name: str, at_hand, monkeypatch: pytest.MonkeyPatch):
    """Every one has one, and it runs; one that takes long is held against the signature."""
    folder, names = at_hand
    monkeypatch.chdir(folder)
    flags = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    text = inspect.getdoc(getattr(walop_jax, name)) or ""
    examples = doctest.DocTestParser().get_doctest(text, dict(names), name, None, None)
    assert examples.examples
    assert doctest.DocTestRunner(optionflags=flags, verbose=False).run(examples).failed == 0
    for one in examples.examples:
        if doctest.SKIP in one.options:
            calls = [node for node in ast.walk(ast.parse(one.source)) if isinstance(node, ast.Call)]
            (call,) = [node for node in calls if ast.unparse(node.func) == f"walop.{name}"]
            keywords = {str(word.arg): None for word in call.keywords}
            inspect.signature(getattr(walop_jax, name)).bind(*call.args, **keywords)


def test_the_package_says_what_every_public_name_is_for():
    words = set(re.findall(r"\w+", inspect.getdoc(walop_jax) or ""))
    assert set(walop_jax.__all__) - words == set()


def test_public_names_are_there_once_each():
    assert len(walop_jax.__all__) == len(set(walop_jax.__all__))


def test_a_name_that_does_not_exist_is_an_error():
    with pytest.raises(AttributeError, match="no attribute 'calibrate_everything'"):
        walop_jax.calibrate_everything  # noqa: B018


def test_importing_loads_nothing():
    code = (
        "import sys, walop_jax; print(sorted({'jax', 'numpy', 'astropy', 'matplotlib'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_function_has_the_name_of_its_command(name: str):
    assert callable(getattr(walop_jax, name.replace("-", "_")))


def run(code: str) -> str:
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    ).stdout.strip()


def test_the_first_call_switches_on_float64():
    code = "import walop_jax as w; w.Settings; import jax.numpy as jnp; print(jnp.ones(1).dtype)"
    assert run(code) == "float64"


def test_public_names_are_not_hidden_by_rooms():
    # Importing a room sets an attribute of the package, which would win over a public name.
    import walop_jax.diagnosis
    import walop_jax.fit
    import walop_jax.model  # a command as well
    import walop_jax.reports

    for name in walop_jax.__all__:
        assert type(getattr(walop_jax, name)).__name__ != "module"

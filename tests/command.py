"""The program called in this process, for tests that hold a command against something."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner

from walop_jax.commands.program import app

Call = Callable[..., Any]  # gives a `Result`: typer brings its own click, or uses an installed one


@pytest.fixture(autouse=True, scope="session")
def no_cache():
    """No cache of compiled code but that of pytest; wide tables."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WALOP_JAX_CACHE", "off")
        patch.setenv("COLUMNS", "200")
        yield


@pytest.fixture(scope="session")
def call() -> Call:
    """Run a command in this process; exceptions that are no exit code count as test failures."""
    return run_program


def run_program(*args: object) -> Any:
    """What `call` calls."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def one_line(result) -> str:
    """The error of a command that failed with exit code 1."""
    assert result.exit_code == 1, result.output
    assert "Traceback" not in result.output
    errors = [line for line in result.stderr.splitlines() if line.startswith("walop-jax: error: ")]
    assert len(errors) == 1, result.stderr
    return errors[0]

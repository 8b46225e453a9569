"""The house rules of every test: float64, shapes checked, long studies and timings only on demand."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jaxtyping
import pytest
from handmade_set import Handmade
from south_sets import ABSENT, CUTS, SHARED, SouthSet

jax.config.update("jax_enable_x64", True)  # the package itself never switches it on
# Every annotated shape and type of the package is checked, under pytest only. Must precede its import.
jaxtyping.install_import_hook("walop_jax", "shapes.checked")
from south_fits import SouthFit  # noqa: E402

OPTIONS = {"long": "studies that take minutes", "benchmark": "timings"}


def pytest_addoption(parser: pytest.Parser) -> None:
    for name, what in OPTIONS.items():
        parser.addoption(f"--{name}", action="store_true", default=False, help=f"run {what} as well")


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled code in pytest's own cache: workers share it, and a second run hardly compiles at all."""
    cache = getattr(config, "cache", None)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", str(cache.mkdir("xla")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
        jax.config.update("jax_raise_persistent_cache_errors", False)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for name, what in OPTIONS.items():
        if config.getoption(f"--{name}"):
            continue
        for item in items:
            if item.get_closest_marker(name):
                item.add_marker(pytest.mark.skip(reason=f"{what}: run with --{name}"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how much was left out because data that cannot come with the project are not there."""
    skipped = sum(ABSENT in str(report.longrepr) for report in terminalreporter.getreports("skipped"))
    if skipped:
        terminalreporter.write_line(f"{skipped} tests skipped: their data are {ABSENT}")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of sets made outside the project that do not come with it."""
    if not SHARED.is_dir():
        pytest.skip(f"outside sets are {ABSENT}")
    return SHARED


@pytest.fixture(scope="session")
def south_set() -> Callable[[str], SouthSet]:
    """Cuts of 5 × 5 points of the sets a, b, c, d with known truth, by name."""
    return functools.partial(SouthSet.of, CUTS)


@pytest.fixture(scope="session")
def whole_south_set(shared_data: Path) -> Callable[[str], SouthSet]:
    """The sets of 12 × 12 points with known truth, by name; skips where they are not."""
    return functools.partial(SouthSet.of, shared_data)


@pytest.fixture(params=["cut", "whole"])
def either_south_set(request: pytest.FixtureRequest) -> Callable[[str], SouthSet]:
    """Cut and whole sets in turn: for what holds on both alike."""
    return request.getfixturevalue({"cut": "south_set", "whole": "whole_south_set"}[request.param])


@pytest.fixture(scope="session")
def south_fit() -> Callable[[SouthSet], SouthFit]:
    """Fits of the base model to sets with known truth, each made once."""
    return functools.cache(SouthFit.of)


@pytest.fixture
def handmade(tmp_path: Path) -> Handmade:
    """A calibration set made with astropy alone, to be spoilt."""
    return Handmade(tmp_path)


@pytest.fixture
def two_cameras(tmp_path: Path) -> Handmade:
    """A set of an instrument with two cameras and two moving elements of its own, made in the same way."""
    return Handmade(tmp_path, two_cameras=True)

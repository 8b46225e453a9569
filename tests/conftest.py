"""The house rules of every test: float64, shapes checked, long studies and timings only on demand."""

from __future__ import annotations

import functools
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Workers share the cores: threads of linear algebra that wait for each other make the run half as long again.
if "--benchmark" not in sys.argv:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import pytest
import shapes

if TYPE_CHECKING:
    from handmade_set import Handmade
    from south_sets import SouthSet

    from walop_jax.fit.refit import FitResult

jax.config.update("jax_enable_x64", True)  # the package itself never switches it on
# Fixtures import what they need of the package: not the process that only hands out tests to workers.
shapes.check_package()

LEAST_COMPILED = 0.1  # seconds: what compiles faster is not worth a file
# A quarter of the time; results differ by 10⁻¹³ of the counts. The last is newer than the oldest JAX that will do.
# Loops of fusion emitters take twice as long to compile; JAX 0.12 has no others, and ends at an unknown flag.
QUICK_COMPILATION = "--xla_backend_optimization_level=0"
PLAIN_LOOPS = {(0, 10): "--xla_cpu_use_fusion_emitters=false"}
QUICK_OPTIMISATION = "jax_optimization_level"
# Objects made before Python looks for garbage among the youngest: a program that is traced makes a million that stay.
GARBAGE_AFTER = 50_000
SLOW = Path(__file__).parent / "slow_tests.txt"
OPTIONS = {"long": "studies that take minutes", "benchmark": "timings"}


def pytest_addoption(parser: pytest.Parser) -> None:
    for name, what in OPTIONS.items():
        parser.addoption(f"--{name}", action="store_true", default=False, help=f"run {what} as well")
    parser.addoption("--fast", action="store_true", default=False, help="leave out what takes seconds")


def pytest_configure(config: pytest.Config) -> None:
    """Compile quickly and little unless something is timed, and keep compiled code in pytest's own cache.

    Workers and processes of tests share the cache, and so does the next run. Where Python is not to write bytecode
    beside the sources, it is there too: to compile tests and modules is more than half of the time of collecting them.
    """
    if not config.getoption("--benchmark"):
        flags = (
            os.environ.get("XLA_FLAGS", ""),
            QUICK_COMPILATION,
            PLAIN_LOOPS.get(jax.__version_info__[:2], ""),
        )
        os.environ["XLA_FLAGS"] = " ".join(flags).strip()
        if hasattr(jax.config, QUICK_OPTIMISATION):
            jax.config.update(QUICK_OPTIMISATION, "O0")
            os.environ[QUICK_OPTIMISATION.upper()] = "O0"
    cache = getattr(config, "cache", None)
    if cache is None:
        return
    if sys.dont_write_bytecode:
        sys.dont_write_bytecode, sys.pycache_prefix = False, str(cache.mkdir("bytecode"))
        os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    folder = str(cache.mkdir("xla"))
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILED)
    jax.config.update("jax_raise_persistent_cache_errors", False)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(LEAST_COMPILED)


def slow_tests() -> set[str]:
    """Tests that `--fast` leaves out: files, or file::function."""
    lines = SLOW.read_text(encoding="utf-8").splitlines()
    return {line for line in lines if line and not line.startswith("#")}


def pytest_collection_finish() -> None:
    """What is imported stays: Python need not look there for garbage, a twentieth of all time otherwise."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(GARBAGE_AFTER, *gc.get_threshold()[1:])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Workers begin at tests of different rooms and steal from each other: fixtures are made once, as a rule."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getoption("dist") == "load" else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for name, what in OPTIONS.items():
        if config.getoption(f"--{name}"):
            continue
        for item in items:
            if item.get_closest_marker(name):
                item.add_marker(pytest.mark.skip(reason=f"{what}: run with --{name}"))
    if config.getoption("--fast"):
        slow = slow_tests()
        for item in items:
            name = item.nodeid.split("[")[0].removeprefix("tests/")
            if name in slow or name.split("::")[0] in slow:
                item.add_marker(pytest.mark.skip(reason="takes seconds: run without --fast"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how much was left out because data that cannot come with the project are not there."""
    from south_sets import ABSENT

    skipped = sum(ABSENT in str(report.longrepr) for report in terminalreporter.getreports("skipped"))
    if skipped:
        terminalreporter.write_line(f"{skipped} tests skipped: their data are {ABSENT}")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of sets made outside the project that do not come with it."""
    from south_sets import ABSENT, SHARED

    if not SHARED.is_dir():
        pytest.skip(f"outside sets are {ABSENT}")
    return SHARED


@pytest.fixture(scope="session")
def south_set() -> Callable[[str], SouthSet]:
    """Cuts of 5 × 5 points of the sets a, b, c, d with known truth, by name."""
    from south_sets import CUTS, SouthSet

    return functools.partial(SouthSet.of, CUTS)


@pytest.fixture(scope="session")
def whole_south_set(shared_data: Path) -> Callable[[str], SouthSet]:
    """The sets of 12 × 12 points with known truth, by name; skips where they are not."""
    from south_sets import SouthSet

    return functools.partial(SouthSet.of, shared_data)


@pytest.fixture(params=["cut", pytest.param("whole", marks=pytest.mark.long)])
def either_south_set(request: pytest.FixtureRequest) -> Callable[[str], SouthSet]:
    """Cuts, and where there is time whole sets: for what holds on both alike."""
    return request.getfixturevalue({"cut": "south_set", "whole": "whole_south_set"}[request.param])


@pytest.fixture(scope="session")
def south_fit() -> Callable[[SouthSet], FitResult]:
    """Fits of the base model to sets with known truth, each made once."""
    from walop_jax.data.calset import read_calibration_set
    from walop_jax.fit.refit import refit

    return functools.cache(lambda south: refit(read_calibration_set(south.path)).with_verdict())


@pytest.fixture
def handmade(tmp_path: Path) -> Handmade:
    """A calibration set made with astropy alone, to be spoilt."""
    from handmade_set import Handmade

    return Handmade(tmp_path)


@pytest.fixture
def two_cameras(tmp_path: Path) -> Handmade:
    """A set of an instrument with two cameras and two moving elements of its own, made in the same way."""
    from handmade_set import Handmade

    return Handmade(tmp_path, two_cameras=True)

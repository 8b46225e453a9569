"""The house rules of every test: float64, shapes checked, long studies and timings only on demand."""

from __future__ import annotations

from pathlib import Path

import jax
import jaxtyping
import pytest
from handmade_set import Handmade

jax.config.update("jax_enable_x64", True)  # the package itself never switches it on
# Every annotated shape and type of the package is checked, under pytest only. Must precede its import.
jaxtyping.install_import_hook("walop_jax", "shapes.checked")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
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


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the calibration sets with known truth, which were made outside the project."""
    if not (SHARED_DATA / "walop_south_a.fits").exists():
        pytest.skip("calibration sets with known truth are not beside the project (../shared/data)")
    return SHARED_DATA


@pytest.fixture
def handmade(tmp_path: Path) -> Handmade:
    """A calibration set made with astropy alone, to be spoilt."""
    return Handmade(tmp_path)


@pytest.fixture
def two_cameras(tmp_path: Path) -> Handmade:
    """A set of an instrument with two cameras and two moving elements of its own, made in the same way."""
    return Handmade(tmp_path, two_cameras=True)

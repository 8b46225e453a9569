"""The list of planted errors fits the package that they are planted in; `planted_errors.py` plants them."""

from __future__ import annotations

import pytest
from planted_errors import ERRORS, ROOT, Planted
from test_house import ROOMS


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: f"{e.file}: {e.old}")
def test_every_line_is_there_once(error: Planted):
    text = (ROOT / "walop_jax" / error.file).read_text(encoding="utf-8")
    assert text.count(error.old) == 1
    assert error.old != error.new
    for name in error.tests:
        assert (ROOT / "tests" / name).is_file()


def test_enough_of_them_over_the_rooms_that_compute():
    rooms = {error.file.split("/")[0] for error in ERRORS}
    assert len(ERRORS) >= 60
    assert rooms >= set(ROOMS) - {"instruments", "simulation", "reports"}


def test_what_is_left_out_of_the_fast_suite_is_there():
    """A test that was renamed or moved must not stay in the list."""
    listed = [
        line
        for line in (ROOT / "tests" / "slow_tests.txt").read_text().splitlines()
        if line[:1] not in ("", "#")
    ]
    assert listed == sorted(set(listed))
    for entry in listed:
        file, _, name = entry.partition("::")
        assert (f"def {name}(" if name else "def test_") in (ROOT / "tests" / file).read_text(
            encoding="utf-8"
        ), entry

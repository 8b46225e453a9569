"""The front door: the names that others may rely on, and what importing the package costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

import walop_jax


@pytest.mark.parametrize("name", walop_jax.__all__)
def test_every_public_name_is_there_and_documented(name: str):
    assert getattr(walop_jax, name).__doc__
    assert name in dir(walop_jax)


def test_public_names_are_few_and_in_order():
    assert walop_jax.__all__ == sorted(walop_jax.__all__)
    assert len(walop_jax.__all__) < 24


def test_a_name_that_does_not_exist_is_an_error():
    with pytest.raises(AttributeError, match="no attribute 'calibrate_everything'"):
        walop_jax.calibrate_everything  # noqa: B018


def test_importing_loads_nothing():
    code = (
        "import sys, walop_jax; print(sorted({'jax', 'numpy', 'astropy', 'matplotlib'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_public_names_are_not_hidden_by_rooms():
    # Importing a room sets an attribute of the package, which would win over a public name.
    import walop_jax.diagnosis
    import walop_jax.fit
    import walop_jax.reports

    for name in walop_jax.__all__:
        assert type(getattr(walop_jax, name)).__name__ != "module"

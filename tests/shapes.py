"""The type checker that `conftest.py` hooks into the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

# As in PEP 484, and as pyright has it, an int may stand where a float is asked for.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """`beartype`; methods that speak of `Self` stay unchecked, for it knows no class to compare with."""
    try:
        return _beartype(function)
    except BeartypeDecorHintPep673Exception:
        return function

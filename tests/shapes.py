"""The type checker that `conftest.py` hooks into the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import beartype
from beartype.roar import BeartypeDecorHintPep673Exception


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """`beartype`, but methods that speak of `Self` stay unchecked: it knows no class to compare with there."""
    try:
        return beartype(function)
    except BeartypeDecorHintPep673Exception:
        return function

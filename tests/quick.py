"""Parameters of a test that stand for the others in the usual run; `--long` takes all."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def quick(values: Iterable[Any], kept: Collection[Any]) -> list[Any]:
    """The values, those that are not in `kept` as long ones. Raises ValueError for one that is not among them."""
    values = list(values)
    if unknown := [one for one in kept if one not in values]:
        raise ValueError(f"not among the values: {unknown}")
    return [one if one in kept else pytest.param(one, marks=pytest.mark.long) for one in values]

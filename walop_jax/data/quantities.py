"""Numbers that callers bring along: lists, scalars, astropy quantities and columns, any byte order."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.data.schema import Place, convert_unit


def in_unit(values: Any, unit: str, name: str) -> Float[np.ndarray, "*s"]:
    """The values as native float64 in `unit`; numbers without a unit are taken to have it, masked ones are NaN.

    `name` is what errors call them. Raises `DataError` for a unit that cannot be converted and for what is not a
    number.
    """
    place = Place("", "")
    given = str(getattr(values, "unit", None) or "")
    plain = getattr(values, "value", values) if given and not hasattr(values, "colnames") else values
    try:
        numbers = np.ma.filled(np.ma.asarray(plain, np.float64), np.nan)
    except (TypeError, ValueError):
        raise place.fail("is not made of numbers", name, f"give numbers in {unit or 'fractions'}") from None
    flat = np.atleast_1d(numbers).astype(np.float64)
    return (convert_unit(flat, given, unit, name, place) if given else flat).reshape(np.shape(numbers))

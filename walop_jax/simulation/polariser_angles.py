"""Angles of the calibration polariser: evenly over a turn, or as a plan states them, in Python or as a file."""

from __future__ import annotations

from typing import Any

import numpy as np


def polariser_turn(count: int = 15, *, full_turn: bool = False) -> tuple[float, ...]:
    """Angles (deg) of the calibration polariser, spread evenly over half a turn or a full one.

    Half a turn later the light behind the polariser is the same. Over a full turn an odd `count` therefore gives
    `count` directions, an even one half as many, each twice.
    """
    return tuple(float(a) for a in np.arange(count) * ((360.0 if full_turn else 180.0) / count))


USUAL_ANGLES = polariser_turn()
"""Those of a plan that says nothing (deg)."""


def angles_of(given: Any, full_turn: Any) -> tuple[float, ...]:
    """The angles (deg) of the polariser that a plan, in Python or as a file, gives: a list, or the number of them.

    Raises ValueError for what is neither, and for `full_turn` beside a list.
    """
    if not isinstance(full_turn, bool | None):
        raise ValueError(f"full_turn = {full_turn!r} must be true or false")
    if given is USUAL_ANGLES and full_turn is not None:
        given = len(USUAL_ANGLES)
    if isinstance(given, int | np.integer) and not isinstance(given, bool):
        if given < 1:
            raise ValueError(f"polariser_angles = {given} must be at least 1, or a list of angles (deg)")
        return polariser_turn(int(given), full_turn=bool(full_turn))
    listed = np.ndim(given) == 1
    if listed and full_turn is not None:
        what = "is of no use beside a list of angles; give their number, or leave it out"
        raise ValueError(f"full_turn {what}")
    angles = np.asarray(given, float) if listed else np.array(np.nan)
    if not np.isfinite(angles).all():
        what = "must be a number of angles, such as 15, or a list of them (deg)"
        raise ValueError(f"polariser_angles = {given!r} {what}")
    return tuple(given) if isinstance(given, tuple) else tuple(angles.tolist())

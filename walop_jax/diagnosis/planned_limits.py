"""Detection limits of an observing plan: those of the sets that it will give, by instruments as they may be built.

What a set shows depends on its instrument, and that is not the one that was designed: light that passes from camera to
camera, for one, hides where all cameras are alike. It depends on the weather as well: while the flux never changes, a
pedestal cannot be told from light in proportion to the flux. A forecast from the design in steady weather is therefore
wrong. Here sets are simulated as `simulate` would draw them, without noise, and asked in turn.

Forecast    Of the amplitudes that are detected the smallest and the largest of all instruments and shapes; of all else
            the worst of the instruments: what is named, errors that could hide, effects that are taken for each other.
            Untestable is what none of the instruments shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.could_hide import CouldHide
from walop_jax.diagnosis.detection_limits import ConditionLimit, DetectionLimit, DetectionLimits

Entry = TypeVar("Entry")

INSTRUMENTS = 5
"""Instruments that stand for those that may be built. The range of as many holds the next one in two cases of three,
and nearly always within a factor of 1.3."""


def over_instruments(found: Sequence[DetectionLimits]) -> DetectionLimits:
    """The forecast from the limits of sets of one plan by several instruments; those of one as they are."""
    first = found[0]
    if len(found) == 1:
        return first
    limits = _together((entry for one in found for entry in one.limits), lambda entry: entry.name)
    conditions = _together((entry for one in found for entry in one.conditions), lambda entry: entry.what)
    effects = tuple(dict.fromkeys(name for one in found for name in one.effects))
    protection = np.stack([np.nan_to_num(one.protection, nan=-1.0) for one in found])
    worst = protection.argmax(axis=0)
    largest = protection.max(axis=0)
    return DetectionLimits(
        limits=_by_error(_limit(same) for same in limits),
        effects=effects,
        separation=_nearest(found, effects),
        x=first.x,
        y=first.y,
        protection=np.where(largest < 0.0, np.nan, largest),
        caused_by=tuple(found[k].caused_by[i] for i, k in enumerate(worst)),
        untestable=tuple(name for name in first.untestable if all(name in one.untestable for one in found)),
        conditions=tuple(_condition(same) for same in conditions),
        could_hide=_hidden(mistake for one in found for mistake in one.could_hide),
        instruments=len(found),
    )


def _together(found: Iterable[Entry], name: Callable[[Entry], str]) -> list[list[Entry]]:
    """Entries of the same name."""
    groups: dict[str, list[Entry]] = {}
    for entry in found:
        groups.setdefault(name(entry), []).append(entry)
    return list(groups.values())


def _limit(same: Sequence[DetectionLimit]) -> DetectionLimit:
    smallest, largest = zip(*(one.detected for one in same), strict=True)
    return same[0]._replace(
        detected=(min(smallest), max(largest)),
        named=max(one.named for one in same),
        taken_for=tuple(dict.fromkeys(name for one in same for name in one.taken_for)),
        error_of_qu=_worst(one.error_of_qu for one in same),
    )


def _by_error(limits: Iterable[DetectionLimit]) -> tuple[DetectionLimit, ...]:
    return tuple(sorted(limits, key=lambda entry: -np.nan_to_num(entry.error_of_qu[1], nan=-1.0)))


def _condition(same: Sequence[ConditionLimit]) -> ConditionLimit:
    return same[0]._replace(
        detected=max(one.detected for one in same),
        size=max(one.size for one in same),
        error_of_qu=_worst(one.error_of_qu for one in same),
    )


def _worst(errors: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """The largest median over the field, and the largest anywhere; NaN of none."""
    median, largest = (np.array(values) for values in zip(*errors, strict=True))
    if np.isnan(median).all():
        return float("nan"), float("nan")
    return float(np.nanmax(median)), float(np.nanmax(largest))


def _hidden(mistakes: Iterable[CouldHide]) -> tuple[CouldHide, ...]:
    """Every mistake that could hide with the instrument with which it does most."""
    worst: dict[str, CouldHide] = {}
    for mistake in mistakes:
        if mistake.name not in worst or mistake.error > worst[mistake.name].error:
            worst[mistake.name] = mistake
    return tuple(sorted(worst.values(), key=lambda mistake: (-mistake.error[0], -mistake.error[1])))


def _nearest(found: Sequence[DetectionLimits], effects: Sequence[str]) -> Float[np.ndarray, "e e"]:
    """The smallest distance of each pair of effects; NaN of those that are never seen together."""
    smallest = np.full((len(effects), len(effects)), np.inf)
    for one in found:
        at = [effects.index(name) for name in one.effects]
        smallest[np.ix_(at, at)] = np.fmin(smallest[np.ix_(at, at)], one.separation)
    return np.where(np.isinf(smallest), np.nan, smallest)

"""What of an instrument holds for other exposures than those it was fitted to, and what stays behind.

The instrument matrix and the analysis of a catalogue know the optics and the cameras. Light of the opposite field
point, shares of single exposures, optics that change with the time since the first exposure and detectors that need
to know of their exposure do not go with them; a detector that asks for nothing but its own counts is undone. Which
effects that concerns is found by patching, not declared.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.cameras import DetectorPart
from walop_jax.model.dependence import changed_elements, conditions_asked_by
from walop_jax.model.instrument import Instrument
from walop_jax.model.ray import NotPlannedError
from walop_jax.model.sources import ExposureArrays

KNOWN = frozenset({"temperature", "hour_angle"})
"""Conditions of the optics that a table of points or a catalogue can say."""


class _Untold(ExposureArrays):
    """Exposures of which nothing is known: whatever is asked of them is an error."""

    def __getattr__(self, name: str) -> object:
        raise NotPlannedError(name)


def _untold() -> _Untold:
    return object.__new__(_Untold)


def is_undone(part: DetectorPart, cameras: int) -> bool:
    """Whether a detector asks for nothing but its own counts, so that a catalogue can be freed of it."""
    try:
        jax.eval_shape(lambda p: p.reported(jnp.ones((1, cameras)), _untold()), part)
    except NotPlannedError:
        return False
    return True


def left_behind(instrument: Instrument) -> tuple[str, ...]:
    """Names of the effects of which a part cannot be carried over to other exposures."""
    bare = dataclasses.replace(instrument, effects=())
    names = []
    for effect in instrument.effects:
        cameras = effect.patch(bare).cameras
        kept = all(is_undone(part, len(cameras)) for part in cameras.detectors)
        asked = {name for element in changed_elements(bare, effect) for name in conditions_asked_by(element)}
        unknown = asked - KNOWN
        if cameras.ghosts or cameras.exposures or not kept or unknown:
            names.append(effect.name)
    return tuple(names)


def reported(instrument: Instrument, counts: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """What the detectors that can be undone report for counts (electrons)."""
    for part in instrument.patched().cameras.detectors:
        if is_undone(part, len(instrument.cameras)):
            counts = part.reported(counts, _untold())
    return counts

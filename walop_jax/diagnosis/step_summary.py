"""What an effect does, by two fits: the one without it and the one with it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from walop_jax.diagnosis import naming
from walop_jax.diagnosis.change_of_stokes import instrument_matrices, largest_change
from walop_jax.diagnosis.design import Design, held_out
from walop_jax.diagnosis.findings import Step
from walop_jax.model.effects import Described


def before_and_after(name: str, before: Design, after: Design) -> dict[str, Any]:
    """The fields of a `Step` that compare the fits without and with an effect."""
    effect = after.fit.model.instrument(after.fit.values).effect(name)
    # An effect with a number for every exposure, or for one of them, cannot predict exposures that it has not seen.
    many = any(np.size(getattr(effect, f)) > 4 for f in effect.amplitudes())
    many |= isinstance(effect, Described) and any("exposure" in text for text in effect.sentences)
    scheme = "field blocks" if many else "exposures"
    old, new = (instrument_matrices(design.fit) for design in (before, after))
    return {
        "chi2_before": before.fit.chi2,
        "chi2_after": after.fit.chi2,
        "heldout_before": held_out(before, scheme),
        "heldout_after": held_out(after, scheme),
        "change_of_qu": largest_change(old, new),
        "residual_before": before.measured.residual,
        "residual_after": after.measured.residual,
    }


def refitted_in_order(steps: Sequence[Step], start: Design, end: Design) -> list[Step]:
    """The steps as they lead, one after the other, from one fit to another that has no effects beside theirs.

    The models between the two are fitted again; what belongs to the discovery of an effect stays.
    """
    fits = [end.fit] if steps else []
    for step in reversed(steps[1:]):
        fits.append(naming.refit_without(fits[-1], step.effect))
    compared, before = [], start
    for step, result in zip(steps, reversed(fits), strict=True):
        after = end if result is end.fit else Design.of(result)
        compared.append(dataclasses.replace(step, **before_and_after(step.effect, before, after)))
        before = after
    return compared

"""What an effect does, told from two fits: the one without it and the one with it."""

from __future__ import annotations

from typing import Any

import numpy as np

from walop_jax.diagnose.consequence import instrument_matrices, largest_change
from walop_jax.diagnose.design import Design, held_out


def comparison(name: str, before: Design, after: Design) -> dict[str, Any]:
    """The fields of a `Step` that compare the fits without and with an effect."""
    effect = after.fit.model.instrument(after.fit.values).effect(name)
    # An effect with a number for every exposure cannot predict exposures that it has not seen.
    many = any(np.size(getattr(effect, f)) > 4 for f in effect.amplitudes())
    scheme = "field blocks" if many else "exposures"
    old, new = (instrument_matrices(design.fit, design.problem.calset) for design in (before, after))
    return {
        "chi2_before": before.fit.chi2,
        "chi2_after": after.fit.chi2,
        "heldout_before": held_out(before, scheme),
        "heldout_after": held_out(after, scheme),
        "change_of_qu": largest_change(old, new),
        "residual_before": before.measured.residual,
        "residual_after": after.measured.residual,
    }

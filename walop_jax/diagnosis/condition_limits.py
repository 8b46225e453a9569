"""Largest errors of stated conditions that the residuals of a set do not show, and what they do to q and u.

As in `detection_limits`: a number c that is wrong by h is found where h² G reaches the noncentrality of the test of
`stated_conditions`, G the square of the derivative C of the residuals behind the projection. The fit takes up
δθ = (JᵀJ)⁻¹JᵀC h of it, and stars are calibrated with a matrix that is off by δθ ∂m/∂θ − h ∂m/∂c; the second term is
there only where stars are seen under the same condition (a filter).
"""

from __future__ import annotations

import numpy as np

from walop_jax.calibration.matrix import change_of_qu, first_setting, matrix_slopes
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.examination import ALARM
from walop_jax.diagnosis.limits_found import PROBABILITY, ConditionLimit, over_field
from walop_jax.diagnosis.score import local_p, noncentrality
from walop_jax.diagnosis.stated_conditions import STEP, condition_scores


def condition_limits(design: Design) -> tuple[ConditionLimit, ...]:
    """A limit for every number that the set behind a fit states of itself."""
    scored = condition_scores(design)
    tried = sum(one.score.testable for one in scored)
    if not tried:
        return ()
    result = design.fit
    instrument, calset = result.model.instrument(result.values), result.calset
    setting, x, y = first_setting(calset, instrument), calset.points.x, calset.points.y
    matrix, slopes = matrix_slopes(instrument, setting, calset.filters, x, y)
    taken_up = design.taken_up(np.column_stack([one.column for one in scored]))
    off = slopes @ (result.model.selection() @ taken_up)
    least = noncentrality(local_p(ALARM, tried), 1, PROBABILITY)
    found = []
    for number, (stated, score, _, square) in enumerate(scored):
        slope = off[..., number]
        if stated.seen_by_stars:
            step = STEP * stated.width
            above, below = (
                matrix_slopes(instrument, setting, stated.changed(h).filters, x, y)[0] for h in (step, -step)
            )
            slope = slope - (above - below) / (2.0 * step)
        # Of errors as stated, not of the residuals: a plan has none.
        detected = float(np.sqrt(least / square)) if score.testable else np.inf
        size = min(detected, stated.width)
        error = over_field(change_of_qu(matrix, matrix + size * slope)[None])
        found.append(ConditionLimit(stated.what, stated.unit, detected, size, error))
    return tuple(found)

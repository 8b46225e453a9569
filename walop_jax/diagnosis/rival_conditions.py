"""Names beside the numbers that a set states: does one such number, if it is wrong, explain the data as well?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import special

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.exact import log_evidence_ratio
from walop_jax.diagnosis.score import corrected_p, local_p
from walop_jax.diagnosis.stated_conditions import ALIKE, Scored, Stated, condition_in_words, condition_scores
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.text import with_error
from walop_jax.likelihood.likelihood import Likelihood

_FITTED, _ROUNDS = 3, 3  # stated numbers that are fitted exactly, and steps of each


def rival_conditions(
    design: Design, conditions: Sequence[tuple[Stated, Scored]], chi2: float
) -> Iterator[str]:
    """A sentence on stated conditions, each of which, if wrong, explains the data as well as a model with `chi2` does.

    `design` is of the fit before anything was added to its model, `conditions` are its `condition_scores`.
    """
    scored = [(stated, item) for stated, item in conditions if item.score.testable]
    scored = [(stated, item) for stated, item in scored if abs(item.score.amplitudes[0]) < stated.width]
    errors = design.fit.noise_scale**2  # of the scores; those of `chi2` are as given
    square = float(np.sum(design.projector(design.residual) ** 2))
    least = special.chdtri(1, local_p(thresholds.ALARM, len(scored)))
    gains = [float(item.score.amplitudes[0]) ** 2 * float(item.rest[0]) for _, item in scored]
    likely = [k for k, gain in enumerate(gains) if (square - gain) * errors < chi2 + ALIKE and gain > least]
    if likely:
        likely.sort(key=lambda k: -gains[k])
        shown = (scored[k] for k in likely[: thresholds.SHOWN])
        causes = "; or ".join(condition_in_words(stated, item.score) for stated, item in shown)
        yield f"what was found explains no more than one number that the set states would, if it were {causes}"


def instead_of_names(conditions: Sequence[tuple[Stated, Scored]], before: FitResult, after: FitResult) -> str:
    """The number that the set states which, if wrong, explains the data better than names do; empty: none.

    `conditions` are the `condition_scores` of `before`. Numbers that are as probable are reported together. Where
    nothing was added (`after` is `before`) only what explains the data is reported.

    Compared are the evidence of the names, ln B of `after` against `before`, and that of the number, fitted exactly,
    with its width as prior: ½ (χ² − χ²_c) − ½ ln(1 + w² C̃ᵀC̃). One number may so come before sixteen.
    """
    listed = [(stated, item) for stated, item in conditions if item.score.testable]
    clear = [pair for pair in listed if corrected_p(pair[1].score.log_p, len(listed)) < thresholds.ALARM]
    if after.noise_scale != before.noise_scale:  # one scale of the errors, or χ² of both are not comparable
        after = fit(after.likelihood, start=after.values, noise_scale=before.noise_scale)
    added = after is not before
    least, likely = log_evidence_ratio(before, after) if added else 0.0, list[tuple[float, str]]()
    for stated, current in sorted(clear, key=lambda pair: pair[1].score.log_p)[:_FITTED]:
        size, result = 0.0, before
        for _ in range(_ROUNDS):  # Gauss and Newton: hours are no small step
            size += float(current.score.amplitudes[0])
            if abs(size) >= stated.width:  # a latitude beyond the pole, a negative temperature
                break
            likelihood = Likelihood.of(stated.changed(size), before.model)
            result = fit(likelihood, start=result.values, noise_scale=before.noise_scale)
            rescored = condition_scores(Design.of(result), stated.what) if result.converged else []
            if not rescored:
                break
            ((_, current),) = rescored
        worth = 0.5 * (before.expansion.objective - result.expansion.objective)
        worth -= 0.5 * float(np.log1p(float(current.rest[0]) * stated.width**2))
        explained = result.explains_data or result.nearly_explains_data
        if result.converged and abs(size) < stated.width and worth > least and (added or explained):
            value = size if stated.value is None else stated.value + size
            sigma = float(np.sqrt(current.score.covariance[0, 0]))
            by = " changed by" if stated.value is None else ""
            text = f"{stated.what}{by} {with_error(value, sigma)} {stated.unit}".rstrip()
            text += f" ({stated.remedy}; χ²/dof = {result.chi2 / max(result.dof, 1):.3g})"
            likely.append((worth, text))
    best = max((worth for worth, _ in likely), default=0.0)
    return "; or ".join(
        text for worth, text in sorted(likely, reverse=True) if worth > best - thresholds.EVEN_ODDS
    )

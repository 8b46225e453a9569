"""The end of a search: removal of unneeded additions, and the unidentified remainder.

Names compete with the numbers that a set states: one of these, if it is wrong, may explain the data as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from scipy import special

from walop_jax.calibration.accuracy import largest_change
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design, pattern_in_words, strata
from walop_jax.diagnosis.exact import Trial, context_of, evidence_of_presence, log_evidence_ratio, try_effect
from walop_jax.diagnosis.examination import Examination
from walop_jax.diagnosis.findings import FitComparison, Unexplained, describe
from walop_jax.diagnosis.refits import (
    Refits,
    contradicting,
    held_out_by,
    predicts_unseen,
    refitted_in_order,
    settled,
    without,
)
from walop_jax.diagnosis.score import local_p
from walop_jax.diagnosis.search import State, too_many_descriptions
from walop_jax.diagnosis.stated_conditions import Singles, condition_scores
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.text import with_error
from walop_jax.likelihood import limits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described, FreeForm, OtherDescription

Remainder = tuple[State, Unexplained | None]


def concluded(first: State, state: State, judge: Refits) -> Remainder:
    """The state without unneeded additions, and its unidentified remainder (None: nothing).

    A model that predicts exposures, or parts of the field, worse than the first model is not adopted. More descriptions
    than `thresholds.MOST_SENTENCES` are reported as the remainder: one cause that none of them describes. They stay in
    the model only if they predict data that they were not fitted to (`refits.predicts_unseen`).
    """
    state, remainder = _leftover(first, prune(first, state, judge), judge)
    adopted = state.steps or (remainder is not None and remainder.free_form)
    if adopted and (worse := _worse(first.evidence, state)):
        return _not_adopted(first, state, worse)
    added = tuple(name for step in state.steps for name in step.groups)  # groups of descriptions
    if remainder is not None:
        against = tuple(text for name, text in _contradicted(state).items() if name not in added)
        return state, dataclasses.replace(remainder, parts=(*remainder.parts, *against))
    if not too_many_descriptions(state):
        return state, None
    text = f"{len(added)} descriptions were needed: they show its place, no single one its nature"
    remainder = Unexplained(state.evidence.table.p_global, f"{text} ({' | '.join(added)})", ())
    # A place that only a structural effect has made is unknown to the first model.
    if all(map(first.evidence.knows, added)):
        terms = [first.evidence.candidate(name) for name in added]
        if predicts_unseen(first.evidence.design, terms):
            return state, remainder
    state = _without(first, state, [Described.name], judge)
    remainder = dataclasses.replace(remainder, p_value=state.evidence.table.p_global)
    return state, _and(remainder, _LEFT_OUT)


def prune(first: State, state: State, judge: Refits) -> State:
    """The state without unneeded additions, removed in order of increasing evidence."""
    result = state.evidence.result
    reduced, steps = _needed(result, state.steps, judge)
    return state if reduced is result else _refitted(first, state, reduced, steps, judge)


def _needed(
    result: FitResult, steps: tuple[Trial, ...], judge: Refits
) -> tuple[FitResult, tuple[Trial, ...]]:
    """A fit without the additions that the model is more probable without, and the additions that stay."""
    while steps and len(result.model.template.effects) > 1:
        worth = {step.effect.name: evidence_of_presence(result, step.effect.name) for step in steps}
        least = min(worth, key=lambda name: worth[name])
        if worth[least] >= 0.0:  # ln B of its presence
            break
        judge.tell(f"{least} is no longer needed")
        steps = tuple(step for step in steps if step.effect.name != least)
        result = without(result, least, [step.effect.name for step in steps])
    return result, steps


def _without(first: State, state: State, names: Sequence[str], judge: Refits) -> State:
    """The state without some of its additions."""
    result, steps = state.evidence.result, state.steps
    for name in names:
        steps = tuple(step for step in steps if step.effect.name != name)
        result = without(result, name, [step.effect.name for step in steps])
    return _refitted(first, state, result, steps, judge)


def _refitted(first: State, state: State, result: FitResult, steps: Sequence[Trial], judge: Refits) -> State:
    """The state with a smaller model, and its additions compared again in their order."""
    state = judge.adopt(state, result, steps, first.evidence)
    in_order = refitted_in_order(steps, first.evidence.design, state.evidence.design)
    return dataclasses.replace(state, steps=tuple(in_order))


def _leftover(first: State, state: State, judge: Refits) -> Remainder:
    """Remainder of a state, with a free-form term for it where that is of use."""
    partial: tuple[str, ...] = ()
    while True:
        result = state.evidence.result
        # Errors that are a few per cent too small are no effect: nothing but their size is wrong.
        if not state.evidence.alarm and (result.explains_data or result.nearly_explains_data):
            return state, None
        judge.tell("an unidentified residual remains")
        if not partial and (names := _parts(first, state)):
            partial = tuple(names.values())
            for name in names:
                judge.tell(f"{name} explains a part only: not added")
            state = _without(first, state, list(names), judge)
            continue
        remainder, with_term = _with_free_form(state, judge)
        if partial:
            text = "explains a part and may imitate something else, not added"
            remainder = dataclasses.replace(_and(remainder, f"{text}: {'; '.join(partial)}"), parts=partial)
        if with_term is None:
            return state, remainder
        reduced, steps = _needed(with_term, state.steps, judge)
        if reduced is with_term:
            return judge.adopt(state, reduced, steps), remainder
        # Beside the free-form term some names are not needed: they imitated an unidentified effect. Again without them.
        bare = without(reduced, FreeForm.name, [step.effect.name for step in steps])
        state = _refitted(first, state, bare, steps, judge)


def _parts(first: State, state: State) -> dict[str, str]:
    """Names that leave a poor fit nearly as poor, with what each of them explains in words.

    Such a name imitates a part of the missing effects, and makes the matrix between the field points worse. Other
    descriptions of the instrument stay: they have no amplitude that could adapt itself to what is missing.
    """
    results, freedom = (state.evidence.result, first.evidence.result), max(first.evidence.dof, 1)
    remaining, missing = (result.chi2 / max(result.dof, 1) - 1.0 for result in results)
    if remaining < thresholds.POOR_FIT - 1.0 or remaining * thresholds.PART < missing:
        return {}
    partial = {}
    for step in (step for step in state.steps if step.effect is not OtherDescription):
        before, after = step.compared.chi2_before / freedom, step.compared.chi2_after / freedom
        partial[step.effect.name] = f"{step.effect.name} (χ²/dof {before:.3g} → {after:.3g})"
    return partial


def _with_free_form(state: State, judge: Refits) -> tuple[Unexplained, FitResult | None]:
    """Remainder, and a fit with a free-form term for it (None: it would be of no use)."""
    evidence = state.evidence
    result, measured = evidence.result, evidence.design.measured
    remainder = _unexplained(evidence)
    blocks = dict.fromkeys(
        block for name, _ in evidence.patterns_needed if (block := evidence.candidates[name].block)
    )
    if len(result.calset.exposures) > limits.FREE_EXPOSURES:
        for block in ("exposures", "exposure_gains"):
            blocks.pop(block, None)
    if FreeForm.name in result.model.effect_names or not blocks or judge.over(state.fits):
        return remainder, None
    # A block has all patterns of its kind, and those that are not needed make errors larger as well.
    terms = {block: [measured.candidate(s) for s in strata(measured) if s.block == block] for block in blocks}
    design = evidence.design
    useful = tuple(block for block in blocks if predicts_unseen(design, terms[block]))
    if not useful:
        return _and(remainder, _LEFT_OUT), None
    trial = try_effect(result, FreeForm.of(context_of(result), blocks=useful))
    if trial.fit is None or not trial.fit.converged:
        return remainder, None
    after = settled(trial.fit, [step.effect.name for step in state.steps])
    change = largest_change(instrument_matrices(result), instrument_matrices(after))
    remainder = dataclasses.replace(
        remainder, free_form=useful, chi2_before=result.chi2, chi2_after=after.chi2, change_of_qu=change
    )
    return remainder, after


def _unexplained(evidence: Examination) -> Unexplained:
    """Unidentified remainder of an examination: its patterns, and the location of the residuals."""
    cameras = evidence.result.model.template.cameras.names
    patterns = tuple((pattern_in_words(name, cameras), p) for name, p in evidence.patterns_needed)
    if not evidence.alarm:
        factor = np.sqrt(evidence.chi2 / evidence.dof)
        size = with_error(factor, factor / np.sqrt(2.0 * evidence.dof))
        text = (
            f"residuals scatter {size} times as much as N_ERR without a known pattern: N_ERR is too small, or"
        )
        text += ' has no scintillation ([noise] scale = "all", or fraction = "all", in a model file has it fitted)'
    elif patterns:
        text = f"unidentified patterns: {'; '.join(f'{name} (p = {p:.1g})' for name, p in patterns)}"
    else:
        text = "something is missing, but no single pattern is significant by itself"
    leading = [*evidence.significant[:1], *evidence.significant_descriptions[:1]] if evidence.alarm else []
    if leading:
        nearest = max(leading, key=lambda item: item.log_bayes)
        p = evidence.table.corrected(nearest.score)
        text += f". Nearest comes '{nearest.probe.name}' (p = {p:.1g}), which was not confirmed"
    where = describe(evidence.design, evidence.design.residual)
    words = {"cameras": "camera", "kinds": "kind", "field": "field"}
    words |= {prefix: prefix for prefix in evidence.design.measured.likelihood.plan.moving}
    locations = (f"{name} {where[key]}" for name, key in words.items() if where.get(key) is not None)
    text += f". Residuals sit in: {'; '.join(locations)}"
    return Unexplained(evidence.table.p_global, text, patterns)


# ------------------------------------------------------------------------------------ models not adopted


def _worse(first: Examination, state: State) -> str:
    """Data that the final model predicts worse than the first, in words; empty: none."""
    if kinds := contradicting(first.design, state.evidence.design):
        return f"exposures of {kinds}, as all others predict them"
    if not state.steps:  # only a free-form term: its numbers for single exposures predict no other exposure
        return ""
    # An effect with a number for each exposure cannot predict an exposure that is left out, only places of the field.
    schemes = [step.compared.heldout_scheme for step in state.steps]
    scheme = "exposures" if set(schemes) == {"exposures"} else "field blocks"
    compared = FitComparison(**held_out_by(first.design, state.evidence.design, scheme))
    if compared.confirmed:
        return ""
    means = f"{compared.heldout_before:.3g} → {compared.heldout_after:.3g}"
    return f"{scheme} that are left out (mean squared residual {means})"


def _not_adopted(first: State, state: State, worse: str) -> Remainder:
    """The first model again: the additions are reported as parts."""
    changes = ((s.effect.name, s.compared.chi2_before, s.compared.chi2_after) for s in state.steps)
    partial = tuple(f"{name} (χ² {before:.4g} → {after:.4g})" for name, before, after in changes)
    added = "; ".join(partial) or "a free-form term"
    text = f"the model with all additions predicts worse {worse}, so nothing was adopted: {added}"
    remainder = _and(_unexplained(first.evidence), text)
    remainder = dataclasses.replace(remainder, parts=(*partial, *_contradicted(state).values()))
    return back_to(first, state), remainder


def back_to(first: State, state: State) -> State:
    """The first state, with the reasons of a later one."""
    return dataclasses.replace(state, evidence=first.evidence, steps=first.steps)


def _contradicted(state: State) -> dict[str, str]:
    """All candidates contradicted by exposures of another KIND, in words."""
    return {r.name: f"{r.name} ({r.reason})" for turn in state.rounds for r in turn.asked if r.against}


_LEFT_OUT = (
    "a free-form term was left out: it does not predict settings and field points that it was not fitted to"
)


def _and(remainder: Unexplained, text: str) -> Unexplained:
    return dataclasses.replace(remainder, description=f"{remainder.description}. {text}")


# ------------------------------------------------------------------------------- numbers that a set states, and names

_FITTED, _ROUNDS = 6, 3  # stated numbers that are fitted exactly at most, and steps of each


def rival_conditions(design: Design, conditions: Singles, chi2: float) -> Iterator[str]:
    """A remark that lists numbers that the set states, each of which, if wrong, explains the data as well as names.

    `chi2` is that of the fit with names, `design` that of the fit before anything was added, `conditions` are the
    `condition_scores` of `design`. Without such a number there is no remark.
    """
    scored = [item for item in conditions.testable if abs(item.score.amplitudes[0]) < item.stated.width]
    errors = design.fit.noise_scale**2  # scores are in scaled errors, `chi2` is in errors as given
    square = float(np.sum(design.projector(design.residual) ** 2))
    least = special.chdtri(1, local_p(thresholds.ALARM, len(scored)))
    gains = [float(item.score.amplitudes[0]) ** 2 * float(item.rest[0]) for item in scored]
    most = chi2 + thresholds.CHI2_IMPROBABLE
    likely = [k for k, gain in enumerate(gains) if (square - gain) * errors < most and gain > least]
    if likely:
        likely.sort(key=lambda k: -gains[k])
        shown = (scored[k] for k in likely[: thresholds.SHOWN])
        causes = "; or ".join(item.single.worded(item.score) for item in shown)
        yield f"what was found explains no more than one number that the set states would, if it were {causes}"


def beside_conditions(
    first: State, state: State, remainder: Unexplained | None, conditions: Singles
) -> Remainder:
    """The outcome of a search; the first state instead if one number that the set states explains more than names."""
    fits = first.evidence.result, state.evidence.result
    stated, explained = instead_of_names(conditions, *fits) if conditions.items else ("", False)
    if not stated:
        return state, remainder
    partial = () if remainder is None else remainder.parts
    names = ", ".join([step.effect.name for step in state.steps] or partial) or "none that holds"
    text = f"one number that the set states explains more than names do ({names}), if it is {stated}"
    text = f"{_WRONG}; {text}" if explained else text
    number, p = stated if explained else "", first.evidence.table.p_global
    return back_to(first, state), Unexplained(p, text, (), parts=partial, number=number)


def instead_of_a_search(first: State, conditions: Singles) -> Unexplained | None:
    """The remainder, if one number that the set states, were it wrong, explained a gross misfit; None: no number does.

    No search follows then: a single number that turns such residuals into noise is taken as the cause.
    """
    stated = number_alone(first.evidence.result, conditions)
    return wrong_number(first, stated) if stated else None


def wrong_number(first: State, stated: str) -> Unexplained:
    """The remainder that a number of the set explains, if it is wrong: nothing else is missing."""
    return Unexplained(first.evidence.table.p_global, f"{_WRONG}: {stated}", (), number=stated)


_WRONG = "a number that the set states is wrong"


def number_alone(result: FitResult, conditions: Singles) -> str:
    """The number that a set states which, if it is wrong, turns the residuals of a fit into noise; empty: none.

    Only numbers that explain more than `thresholds.LIKELY_SHARE` of the misfit by a linear step are fitted.
    """
    missing = (result.chi2 - result.dof) / result.noise_scale**2
    most = [
        item
        for item in conditions.testable
        if float(item.score.amplitudes[0]) ** 2 * float(item.rest[0]) > thresholds.LIKELY_SHARE * missing
    ]
    if not most:
        return ""
    stated, explained = instead_of_names(dataclasses.replace(conditions, items=tuple(most)), result, result)
    return stated if explained else ""


def instead_of_names(conditions: Singles, before: FitResult, after: FitResult) -> tuple[str, bool]:
    """The stated number that, were it wrong, explained the data better than names do, and whether it leaves only noise.

    The number comes in words, empty if there is none; numbers that are as probable are named together. `conditions` are
    the `condition_scores` of `before`. If nothing was added (`after` has the effects of `before`), only a number that
    explains the data is named.

    The evidence of the names, ln B of `after` against `before`, is compared with the evidence of the number, which is
    fitted exactly: ½ (χ² − χ²_c) − ½ ln(1 + w² C̃ᵀC̃), w its prior width. So one number may be preferred to sixteen
    amplitudes that fit a little better.
    """
    if after.noise_scale != before.noise_scale:  # one scale of the errors, or χ² of both are not comparable
        after = fit(after.likelihood, start=after.values, noise_scale=before.noise_scale)
    added = after.model.effect_names != before.model.effect_names
    least, likely = log_evidence_ratio(before, after) if added else 0.0, list[tuple[float, str, bool]]()
    for current in conditions.alike[:_FITTED]:
        stated, size, result = current.stated, 0.0, before
        for _ in range(_ROUNDS):  # Gauss–Newton steps: a clock wrong by hours is not in the linear range
            size += float(current.score.amplitudes[0])
            if abs(size) >= stated.width:  # a latitude beyond the pole, a negative temperature
                break
            likelihood = Likelihood.of(stated.changed(size), before.model)
            result = fit(likelihood, start=result.values, noise_scale=before.noise_scale)
            rescored = condition_scores(Design.of(result), stated.what).items if result.converged else ()
            if not rescored:
                break
            (current,) = rescored
        worth = 0.5 * (before.expansion.objective - result.expansion.objective)
        worth -= 0.5 * float(np.log1p(float(current.rest[0]) * stated.width**2))
        explained = result.explains_data or result.nearly_explains_data
        if result.converged and abs(size) < stated.width and worth > least and (added or explained):
            value = size if stated.value is None else stated.value + size
            sigma = float(np.sqrt(current.score.covariance[0, 0]))
            by = " changed by" if stated.value is None else ""
            text = f"{stated.what}{by} {with_error(value, sigma)} {stated.unit}".rstrip()
            text += f" ({stated.remedy}; χ²/dof = {result.chi2 / max(result.dof, 1):.3g})"
            likely.append((worth, text, explained))
    likely.sort(reverse=True)
    texts = [text for worth, text, _ in likely if worth > likely[0][0] - thresholds.CERTAIN_ODDS]
    return "; or ".join(texts), bool(likely) and likely[0][2]

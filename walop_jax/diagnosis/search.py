"""The search for what is missing: additions are tried, confirmed and adopted, one after the other.

Names are added by evidence, one after the other, by the same rules for every judge. A *judge* says what an addition is
worth. That of the blind study (`tests/diagnosis/blind.py`) takes its linear step (a Schur complement of the score
space): no model is computed, and thousands of scenes run through the rules below. `workflow.Refit` fits it, but only
what may be added:

1. Candidates are ordered by their linear evidence. What linear algebra finds not worth telling is not tried.
2. The best is fitted. If it leaves nothing but noise, no rival can be better. If its evidence differs from that of its
   linear step by more than `Policy.linear_good`, rivals that lie within twice the difference are fitted as well.
3. Where the model is far off and no name explains half of that, or none is found, what cannot be differentiated
   competes with the names: structural effects and other descriptions of the instrument (`descriptions`).
4. What data that took no part in the fit confirm joins the model (`adopted`), and what is left is scored again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import largest_change
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.diagnosis.design import Design, held_out
from walop_jax.diagnosis.exact import Trial, in_words, refit_without
from walop_jax.diagnosis.examination import Evidence, explains, leaders
from walop_jax.diagnosis.findings import Step
from walop_jax.diagnosis.hypotheses import Ranked
from walop_jax.diagnosis.policy import Policy
from walop_jax.diagnosis.score import Candidate
from walop_jax.fit.robust import field_cells, states
from walop_jax.model.effects import Described

LaidOut = tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, " _"], int, float]

# ------------------------------------------------------------------------------- what an effect does, by two fits


def before_and_after(name: str, before: Design, after: Design) -> dict[str, Any]:
    """The fields of a `Step` that compare the fits without and with an effect."""
    effect = after.fit.model.instrument(after.fit.values).effect(name)
    # An effect with a number for every exposure, or for one of them, cannot predict exposures that it has not seen.
    many = any(np.size(getattr(effect, f)) > 4 for f in effect.kind.amplitudes())
    many |= isinstance(effect, Described) and any("exposure" in text for text in effect.sentences)
    scheme = "field blocks" if many else "exposures"
    old, new = (instrument_matrices(design.fit) for design in (before, after))
    return {
        "chi2_before": before.fit.chi2,
        "chi2_after": after.fit.chi2,
        "heldout_scheme": scheme,
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
        fits.append(refit_without(fits[-1], step.effect))
    compared, before = [], start
    for step, result in zip(steps, reversed(fits), strict=True):
        after = end if result is end.fit else Design.of(result)
        compared.append(dataclasses.replace(step, **before_and_after(step.effect, before, after)))
        before = after
    return compared


def predicts_unseen(
    design: Design, terms: Sequence[Candidate], least: float, *, of_states: bool = True
) -> bool:
    """True if terms without a name predict states and parts of the field that they have not seen.

    One Gauss–Newton step of everything, with and without the terms, from all data but those of a unit gives the
    density of that unit, ln p = −½ (dᵀΣ⁻¹d + ln det Σ), Σ = s² (1 + A H⁻¹ Aᵀ): it is broad where the step leaves it
    open, and s² is the χ²/dof that a model leaves, 1 or more. Units are states (exposures that differ in nothing but
    the filter; not where the terms are about single ones), and the cells of the field, where there are several. The
    mean gain must exceed `least` times its standard error over the units, for both: a term that only follows what each
    setting of an element does by itself predicts the field, and no other setting. Nor must it bend the rest of the
    model: the mean of dᵀd over the states must not grow, where a density may become more probable by being broader
    alone.

    Symbols     d prediction error of the unit, A its rows of the Jacobian, H normal matrix of all others and priors
    """
    widths = np.concatenate([one.widths for one in terms])
    own = design.stacked([one.columns for one in terms])
    prior = np.zeros((len(widths), design.jacobian.shape[1]))
    rows = np.vstack([np.hstack([design.jacobian, own]), np.hstack([prior, np.diag(1.0 / widths)])])
    residual = np.append(design.residual, np.zeros(len(widths)))
    calset = design.fit.calset
    units = {"cells": field_cells(calset)[design.point]}
    if of_states:
        units["states"] = states(calset)[design.exposure]
    for kind, unit in units.items():
        if kind == "cells" and len(np.unique(unit)) < 2:
            continue
        before = _predictions(design.jacobian, design.residual, unit, design.projector.free)
        after = _predictions(rows, residual, unit, design.projector.free)
        gain, closer = (after - before).T
        if len(gain) < 2 or gain.mean() < least * gain.std(ddof=1) / np.sqrt(len(gain)):
            return False
        if kind == "states" and closer.mean() > 0.0:
            return False
    return True


def gains_by_kind(before: Design, after: Design) -> dict[str, float]:
    """Gain in ln p of the exposures of each KIND, as all others predict them, by what one design has beyond another.

    Polariser, Moon and standards see one instrument: what is true makes none of them less probable given the others.
    The gains of a KIND and of all others by themselves add up to the evidence.
    """
    kinds = before.fit.calset.exposures.kind[before.exposure]
    names = np.unique(kinds)
    if len(names) < 2:
        return {}
    one, other = ((d.jacobian, d.residual, d.projector.free, d.fit.noise_scale) for d in (before, after))
    return dict(zip(map(str, names), gains_of_units(kinds, one, other).tolist(), strict=True))


def gains_of_units(unit: np.ndarray, before: LaidOut, after: LaidOut) -> Float[np.ndarray, " u"]:
    """Gain in ln p of each unit of the data rows, as all others predict it, of one model over another.

    Of each model the Jacobian, the residuals at its minimum, priors last, its degrees of freedom, and the factor on the
    errors in whose units the data rows are.
    """
    count, found = np.unique(unit, return_counts=True)[1], []
    for rows, residual, free, noise in (before, after):
        density = _predictions(rows, residual, unit, free)[:, 0]
        found.append(density - count * free / len(unit) * np.log(noise))
    return found[1] - found[0]


def _predictions(
    rows: Float[np.ndarray, "r n"],
    residual: Float[np.ndarray, " r"],
    unit: np.ndarray,
    free: int,
) -> Float[np.ndarray, "u 2"]:
    """ln p of the data rows of each unit as all the others predict them, and the square of how far they are off.

    Rows beyond those of `unit` are priors.
    """
    norm = np.linalg.norm(rows, axis=0)
    scaled = rows / np.where(norm > 0, norm, 1.0)
    ridge = 1e-12 * np.eye(len(norm))
    gram, along = scaled.T @ scaled + ridge, scaled.T @ residual
    step = np.linalg.solve(gram, along)
    scale = max(1.0, float(residual @ residual - along @ step) / max(free, 1))
    whole = np.linalg.slogdet(gram)[1]
    found = []
    for one in np.unique(unit):
        a, r = scaled[: len(unit)][unit == one], residual[: len(unit)][unit == one]
        rest = gram - a.T @ a
        d = r - a @ np.linalg.solve(rest, along - a.T @ r)
        pull = a.T @ d
        square = d @ d - pull @ np.linalg.solve(gram, pull)
        spread = whole - np.linalg.slogdet(rest)[1]
        density = -0.5 * (square / scale + spread + len(r) * free / len(unit) * np.log(scale))
        found.append((density, float(d @ d)))
    return np.array(found)


# ----------------------------------------------------------------------------------------------------------- the search

State = TypeVar("State", bound=Evidence)


def search(state: State, judge: Any, policy: Policy) -> Iterator[tuple[Trial, State, State]]:
    """Additions until nothing is missing or none is found, each with the evidence before and after."""
    for _ in range(policy.most_steps):
        if not (state.alarm and judge.time_left()):
            return
        found = _next(state, judge, policy)
        if found is None:
            return
        before, state = state, judge.adopted(state, found)
        yield found, before, state


def linear_trials(state: Evidence, policy: Policy) -> list[Trial]:
    """The leading names, and sentences that are more probable than every name, by linear steps; best first."""
    trials = [linear_trial(state, item) for item in leaders(state.significant, policy)]
    said = state.sentences_before_names()[: policy.most_sentences]
    trials += [linear_trial(state, item) for item in said]
    return sorted(trials, key=lambda trial: names_first(trial, policy))


def linear_trial(state: Evidence, item: Ranked) -> Trial:
    """Trial of one candidate by its linear step; `linear` is what a fit should find, with its errors."""
    noise, statistic = state.table.noise_scale, item.score.statistic
    left = state.chi2 - statistic * (noise * state.scale) ** 2
    return Trial(
        item.effect,
        item.log_bayes,
        left,
        explains(left, state.dof - item.score.rank),
        item=item,
        linear=item.log_bayes + 0.5 * statistic * (noise**2 - 1.0),
    )


def names_first(trial: Trial, policy: Policy) -> float:
    """Order of trials: by evidence, but a sentence only where it is clearly more probable than a name."""
    return -trial.evidence + (policy.even_odds if trial.effect is Described else 0.0)


def _worth(state: Evidence, trial: Trial) -> bool:
    return state.is_worth_telling(
        trial.effect, trial.evidence, trial.left, noise=trial.noise, item=trial.item
    )


def _promising(state: Evidence, trial: Trial, policy: Policy) -> bool:
    """True if a linear trial could be worth telling, were it better by as much as linear steps may miss."""
    if trial.evidence <= policy.linear_below:
        return _worth(state, trial)
    more = 1.0 + policy.linear_share
    left = state.chi2 - more * (state.chi2 - trial.left)
    return _worth(state, dataclasses.replace(trial, evidence=more * trial.evidence, left=left))


def _next(state: Evidence, judge: Any, policy: Policy) -> Trial | None:
    """The addition with the highest evidence that is worth telling and confirmed; None where there is none."""
    waiting = [trial for trial in linear_trials(state, policy) if _promising(state, trial, policy)]
    tried, ready = list(waiting), []
    others_asked = sentences_asked = False
    while True:
        new = []
        while waiting and judge.time_left():
            first = waiting.pop(0)
            trial = judge.fitted(state, first)
            if trial is None or not _worth(state, trial):
                continue
            new.append(trial)
            tried = [trial if one is first else one for one in tried]
            error = abs(trial.evidence - trial.linear)
            reach = 2.0 * error if error > policy.linear_good else 0.0
            if trial.noise or not waiting or trial.linear - waiting[0].linear >= reach:
                break
        if not (new or sentences_asked):  # names that came first by linear steps that were not to be believed
            sentences_asked = True
            waiting = _sentences_behind(state, tried, policy)
            tried += waiting
            if waiting:
                continue
        missing = state.chi2 - state.dof
        explained = any(t.noise or state.chi2 - t.left > policy.good_share * missing for t in new)
        if not others_asked and not explained and (state.poor or not new):
            others_asked = True
            others = [trial for trial in judge.others(state) if _worth(state, trial)]
            new += others
            tried += others
        ready = judge.decided(sorted(new, key=lambda trial: names_first(trial, policy)))
        for trial in ready:
            if judge.confirmed(state, trial):
                return _with_rivals(state, trial, tried, policy)
        if not waiting or not judge.time_left():
            return None


def _sentences_behind(state: Evidence, tried: Sequence[Trial], policy: Policy) -> list[Trial]:
    """The leading sentences that are promising, without those that were tried."""
    known = [trial.item for trial in tried]
    some = [item for item in state.significant_sentences if item not in known][: policy.most_sentences]
    return [one for one in (linear_trial(state, item) for item in some) if _promising(state, one, policy)]


def _with_rivals(state: Evidence, trial: Trial, tried: Sequence[Trial], policy: Policy) -> Trial:
    """A trial with what is not improbable beside it, and other shapes of its effect that are as probable."""
    rivals, shapes = [], list(trial.alternatives)
    for other in tried:
        if other is trial:
            continue
        linear = other.fit is None and not np.isnan(trial.linear)
        apart = abs(other.linear - trial.linear if linear else other.evidence - trial.evidence)
        if other.effect is not trial.effect and apart < policy.improbable:
            rivals.append(other.effect.name)
        elif other.effect is trial.effect and other.fit is not None and apart < policy.even_odds:
            shapes.append(in_words(other.instance))
    item = trial.item or next((r for r in state.ranked if r.effect is trial.effect), None)
    nameless = () if item is None else state.nameless(item, trial.sentences)
    rivals += () if item is None else state.held_in_part(item)
    return dataclasses.replace(
        trial, alternatives=tuple(shapes), rivals=tuple(dict.fromkeys(rivals)), nameless=nameless
    )

"""The search for what is missing: names by evidence, one after the other, the same rules for every judge.

A *judge* says what an addition is worth. `Linear` takes its linear step (a Schur complement of the score space): no
model is computed, and the blind study (`tests/diagnosis/blind.py`) runs thousands of scenes through the rules below.
`workflow.Refit` fits it, but only what may be added:

1. Candidates are ordered by their linear evidence. What linear algebra finds not worth telling is not tried.
2. The best is fitted. If it leaves nothing but noise, no rival can be better. If its evidence differs from that of its
   linear step by more than `Policy.linear_good`, rivals that lie within twice the difference are fitted as well.
3. Where the model is far off and no name explains half of that, or none is found, what cannot be differentiated
   competes with the names: structural effects and other descriptions of the instrument (`choices`).
4. What data that took no part in the fit confirm joins the model (`adopted`), and what is left is scored again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import numpy as np

from walop_jax.diagnosis.examination import Evidence, Ranked, explains, leaders
from walop_jax.diagnosis.naming import Trial, in_words
from walop_jax.diagnosis.policy import Policy
from walop_jax.diagnosis.score import Scorer
from walop_jax.model.effects import Described

State = TypeVar("State", bound=Evidence)


class Linear:
    """What a trial is worth by its linear step; nothing is held out and no time runs. `workflow.Refit` fits instead."""

    def time_left(self) -> bool:
        """Whether another trial may begin."""
        return True

    def fitted(self, state: Any, trial: Trial) -> Trial | None:
        """A linear trial as the judge finds it; None where nothing comes of it."""
        return trial

    def others(self, state: Any) -> Iterator[Trial]:
        """Trials of what has no linear step."""
        return iter(())

    def decided(self, trials: list[Trial]) -> list[Trial]:
        """Trials, best first, with those of even odds in their order."""
        return trials

    def confirmed(self, state: Any, trial: Trial) -> bool:
        """Whether data that took no part in a trial agree better with it than without; a score space has no rows."""
        return True

    def adopted(self, state: Any, trial: Trial) -> Any:
        """The evidence of what is left once a trial has joined the model."""
        assert trial.item is not None
        return joined(state, trial.item)


def search(state: State, judge: Linear, policy: Policy) -> Iterator[tuple[Trial, State, State]]:
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
    """What one candidate explains by its linear step; `linear` is what a fit should find, with its errors."""
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
    return state.is_worth_telling(trial.effect, trial.evidence, trial.left, noise=trial.noise)


def _promising(state: Evidence, trial: Trial, policy: Policy) -> bool:
    """Whether a linear trial could be worth telling, were it better by as much as linear steps may miss."""
    if trial.evidence <= policy.linear_below:
        return _worth(state, trial)
    more = 1.0 + policy.linear_share
    left = state.chi2 - more * (state.chi2 - trial.left)
    return _worth(state, dataclasses.replace(trial, evidence=more * trial.evidence, left=left))


def _next(state: State, judge: Linear, policy: Policy) -> Trial | None:
    """The addition with the highest evidence that is worth telling and confirmed; None where there is none."""
    waiting = [trial for trial in linear_trials(state, policy) if _promising(state, trial, policy)]
    tried, ready = list(waiting), []
    others_asked = False
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


def joined(state: Evidence, item: Ranked, scorer: Scorer | None = None) -> Evidence:
    """The evidence once a candidate has joined the base, by a linear step."""
    space, reduce = state.space.with_base([item.probe.name])
    scores, square = reduce(state.scores, state.square)
    scorer = scorer or Scorer(space, np.random.default_rng(0), draws=0)
    return dataclasses.replace(
        state,
        scorer=scorer,
        scores=scores,
        square=square,
        table=scorer.after(state.table, scores),
        probes=[
            probe for probe in state.probes if probe.effect is not item.effect or probe.effect is Described
        ],
        sentences=[probe for probe in state.sentences if probe is not item.probe],
        parts=[
            (probe, {effect for effect in effects if effect is not item.effect})
            for probe, effects in state.parts
        ],
        chi2=state.chi2 - item.score.statistic * (state.table.noise_scale * state.scale) ** 2,
        dof=state.dof - item.score.rank,
    )

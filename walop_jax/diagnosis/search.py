"""The search for missing effects: while one is missing, additions are tried, refused with a reason, or adopted.

All is functions of a `State`, which never changes. `refused` has all rules by which an addition is not made, `search`
is the loop. What differs between the search that fits (`refits.Refits`) and the one of the blind study, which takes
linear steps (`tests/diagnosis/linear_judge.py`), is a `Judge`.

1. Candidates are ordered by their linear evidence: names, and descriptions that are more probable than every name that
   is not refused. Candidates that their linear step would refuse are not tried.
2. The best is fitted. If it leaves nothing but noise, no rival can be better. If its evidence differs from that of its
   linear step by more than `thresholds.LINEAR_GOOD`, rivals that lie within twice the difference are fitted as well.
3. Where the model is far off and no name explains half of that, or none is left, what cannot be differentiated
   competes with the names: structural effects and other descriptions of the instrument (`descriptions`).
4. The best that data which took no part in its fit confirm is adopted, and the residuals are scored again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.exact import Trial, beyond_prior, in_words
from walop_jax.diagnosis.examination import Evidence, explains, leaders
from walop_jax.diagnosis.findings import Choice, descriptions_of
from walop_jax.diagnosis.hypotheses import Ranked
from walop_jax.io.text import beside
from walop_jax.model.effects import Described

MOST_LISTED = 40
"""Candidates of a kind that a round lists without having tried them."""


@dataclasses.dataclass(frozen=True)
class Reason:
    """One candidate in a round: its evidence (ln B), corrected p, whether it was fitted, and why it was not added.

    `against` are KINDs of exposures that speak against it.
    """

    name: str
    evidence: float
    p_value: float
    fitted: bool
    reason: str
    against: str = ""


@dataclasses.dataclass(frozen=True)
class Round:
    """One round of a search: global p before it, what was added (empty: nothing), and all that was asked."""

    p_value: float
    added: str
    asked: tuple[Reason, ...]


@dataclasses.dataclass(frozen=True)
class State:
    """A search at one moment: the evidence of the current model, the additions so far, and why there are no others.

    `choices` are other descriptions of the instrument that were compared, `fits` counts exact fits of additions,
    `ended` says after how much the search was broken off (empty: it was not).
    """

    evidence: Any
    steps: tuple[Trial, ...] = ()
    rounds: tuple[Round, ...] = ()
    choices: Mapping[str, Choice] = dataclasses.field(default_factory=dict)
    fits: int = 0
    ended: str = ""


Judge = Any
"""Worth of an addition, by exact fits (`refits.Refits`) or by linear steps alone (the blind study):

over        amount of work after which nothing further is tried, in words; empty: there is more to spend
fitted      a linear trial as the judge finds it
others      trials of effects without a linear step, and other descriptions of the instrument that were compared
confronted  a trial with what data that took no part in its fit say of it
adopted     the state once a trial has joined the model
"""


def search(state: State, judge: Judge) -> State:
    """The state in which nothing is missing, or nothing more can be added."""
    for _ in range(thresholds.MOST_STEPS):
        if not state.evidence.alarm:
            break
        if ended := judge.over(state.fits):
            return dataclasses.replace(state, ended=ended)
        trial, state = _next(state, judge)
        if trial is None:
            break
        state = judge.adopted(state, trial)
    return state


def refused(evidence: Evidence, trial: Trial) -> str:
    """Reason not to add the effect of a trial; empty: there is none."""
    if trial.fit is not None and not trial.fit.converged:
        return "its fit did not converge"
    if not trial.predicts:
        return "by its linear step it does not predict settings and field points that it has not seen"
    # Linear evidence counts in the scatter behind all candidates already, that of fits in their errors.
    fitted, needed = trial.fit is not None, evidence.evidence_needed
    worth = trial.evidence / evidence.floor**2 if fitted else trial.evidence
    if worth <= needed:
        found, limit = beside(worth, needed, ".{}g")
        return f"ln B = {found} is not above {limit}"
    explained, least = evidence.chi2 - trial.left, _least_explained(evidence, trial)
    if explained < least:
        missing = evidence.chi2 - evidence.dof
        found, limit = beside(explained, least, ".{}g")
        return f"it explains {found} of {missing:.4g} that are missing in χ², less than {limit}"
    # The residuals are noise now: a pattern can only describe the same with more numbers.
    suffices = trial.noise and not explains(evidence.chi2, evidence.dof)
    if not suffices and not evidence.stands(trial.effect, trial.evidence, fitted):
        best = evidence.best_pattern(fitted=fitted)
        return f"a pattern without a name is more probable (ln B = {best:.3g}, its own {trial.evidence:.3g})"
    if trial.fit is not None and (far := _far_beyond(trial)):
        return far
    before, after = trial.compared.heldout_before, trial.compared.heldout_after
    if after >= before:
        return (
            f"data that were left out agree worse with it (mean squared residual {before:.4g} → {after:.4g})"
        )
    return f"exposures of {trial.against} speak against it" if trial.against else ""


def _far_beyond(trial: Trial) -> str:
    """An amplitude of an optical description so far beyond its prior that it explains nothing, in words; empty: none.

    Optics that are off by so much are another arrangement. A camera may be: its gain steps where something breaks.
    """
    if trial.effect is not Described or trial.fit is None:
        return ""
    optical = {change.label for change, *_ in descriptions_of(trial.fit) if not change.of_camera}
    far = beyond_prior(trial.fit, Described.name)
    beyond = {
        name: widths for name, widths in far.items() if name in optical and widths > thresholds.MOST_WIDTHS
    }
    if not beyond:
        return ""
    name = max(beyond, key=beyond.__getitem__)
    return f"{name} is {beyond[name]:.0f} widths of its prior, more than {thresholds.MOST_WIDTHS:g}: no explanation"


def _least_explained(evidence: Evidence, trial: Trial) -> float:
    """Part of the excess of χ² that an addition must explain."""
    # Of a poor fit the final model is asked (`thresholds.PART`): its misfit may have many causes.
    if evidence.poor or trial.effect is Described:
        return 0.0
    surely = evidence.chi2 - evidence.dof - 2.0 * np.sqrt(2.0 * evidence.dof)
    return thresholds.LEAST_SHARE_OF_NAME * surely


def hopeless(evidence: Evidence, trial: Trial) -> str:
    """Reason not to try an effect that is refused even if it is better by the error of linear steps."""
    if trial.evidence <= thresholds.LINEAR_BELOW:
        return refused(evidence, trial)
    factor = 1.0 + thresholds.LINEAR_SHARE
    remaining = evidence.chi2 - factor * (evidence.chi2 - trial.left)
    return refused(evidence, dataclasses.replace(trial, evidence=factor * trial.evidence, left=remaining))


def linear_trial(evidence: Evidence, item: Ranked) -> Trial:
    """Trial of one candidate by its linear step; `linear` is the expected result of a fit, with its errors."""
    noise, statistic = evidence.table.noise_scale, item.score.statistic
    remaining = evidence.chi2 - statistic * (noise * evidence.scale) ** 2
    suffices = explains(remaining, evidence.dof - item.score.rank)
    linear = item.log_bayes + evidence.by_fit(item.score)
    return Trial(item.effect, item.log_bayes, remaining, suffices, item=item, linear=linear)


def _by_evidence(trial: Trial) -> float:
    return -trial.evidence


@dataclasses.dataclass(frozen=True)
class _Log:
    """The trials of one round by name, each with the reason for which it was refused."""

    evidence: Evidence
    trials: dict[str, Trial] = dataclasses.field(default_factory=dict)

    def sentences(self, names: Iterable[Trial]) -> list[Trial]:
        """The leading sentences that are more probable than names and have not been tried; a few of a round."""
        least = max((name.item.log_bayes for name in names if name.item is not None), default=-np.inf)
        count = sum(trial.effect is Described for trial in self.trials.values())
        most = min(thresholds.MOST_SENTENCES, 2 * thresholds.MOST_SENTENCES - count)
        untried = (item for item in self.evidence.significant_sentences if item.name not in self.trials)
        probable = [item for item in untried if item.log_bayes > least]
        return self.passed((linear_trial(self.evidence, item) for item in probable[:most]), hopeless)

    def passed(self, trials: Iterable[Trial], why: Callable[[Evidence, Trial], str]) -> list[Trial]:
        """The trials that are not refused; all are noted."""
        judged = [dataclasses.replace(trial, refused=why(self.evidence, trial)) for trial in trials]
        self.trials.update((trial.name, trial) for trial in judged)
        return [trial for trial in judged if not trial.refused]


def _next(state: State, judge: Judge) -> tuple[Trial | None, State]:
    """The addition with the highest evidence that is not refused (None: all are), and the state with the reasons."""
    evidence, log, fits, choices = state.evidence, _Log(state.evidence), state.fits, state.choices
    waiting = log.passed((linear_trial(evidence, item) for item in leaders(evidence.significant)), hopeless)
    tried, accepted, others_asked, ended = list(waiting), None, False, ""
    while accepted is None:
        passed: list[Trial] = []
        while not (ended := judge.over(fits)):
            # Where names are refused, descriptions were behind them that are more probable than those that remain.
            more = log.sentences(trial for trial in (*passed, *waiting) if trial.effect is not Described)
            tried, waiting = [*tried, *more], sorted([*waiting, *more], key=_by_evidence)
            if not waiting:
                break
            linear, fits = waiting.pop(0), fits + 1
            if fitted := log.passed([judge.fitted(evidence, linear)], refused):
                passed += fitted
                tried = [fitted[0] if candidate is linear else candidate for candidate in tried]
                if _is_sure(fitted[0], waiting):
                    break
        missing = evidence.chi2 - evidence.dof
        explained = any(t.noise or evidence.chi2 - t.left > thresholds.GOOD_SHARE * missing for t in passed)
        if not others_asked and not explained and (evidence.poor or not passed):
            others_asked = True
            alternatives, choices = judge.others(dataclasses.replace(state, fits=fits))
            fits += len(alternatives)
            alternatives = log.passed(alternatives, refused)
            passed, tried = [*passed, *alternatives], [*tried, *alternatives]
        for trial in sorted(passed, key=_by_evidence):
            if accepted := next(iter(log.passed([judge.confronted(evidence, trial)], refused)), None):
                break
        if not waiting or (ended := judge.over(fits)):
            break
    if accepted is not None:
        ended, accepted = "", _with_rivals(evidence, accepted, tried)
    added = "" if accepted is None else accepted.name
    turn = Round(evidence.table.p_global, added, tuple(_asked(evidence, log.trials, added)))
    rounds = (*state.rounds, turn)
    return accepted, dataclasses.replace(state, rounds=rounds, choices=choices, fits=fits, ended=ended)


def _is_sure(trial: Trial, waiting: Sequence[Trial]) -> bool:
    """True if no trial that waits can be better: this one leaves noise, or agrees with its linear step."""
    error = abs(trial.evidence - trial.linear)
    reach = 2.0 * error if error > thresholds.LINEAR_GOOD else 0.0
    return trial.noise or not waiting or trial.linear - waiting[0].linear >= reach


def _with_rivals(evidence: Evidence, trial: Trial, tried: Sequence[Trial]) -> Trial:
    """A trial with the alternatives that are not improbable, and other shapes of its effect that are as probable."""
    rivals, shapes = [], list(trial.alternatives)
    for rival in tried:
        if rival.name == trial.name:
            continue
        linear = rival.fit is None and not np.isnan(trial.linear)
        apart = abs(rival.linear - trial.linear if linear else rival.evidence - trial.evidence)
        if rival.effect is not trial.effect and apart < thresholds.IMPROBABLE:
            rivals.append(rival.effect.name)
        elif rival.effect is trial.effect and rival.fit is not None and apart < thresholds.EVEN_ODDS:
            shapes.append(in_words(rival.instance))
    item = trial.item or next((r for r in evidence.ranked if r.effect is trial.effect), None)
    nameless = () if item is None else evidence.nameless(item, trial.sentences)
    rivals += () if item is None else evidence.held_in_part(item)
    others = tuple(dict.fromkeys(rivals))
    named = {trial.name: "" if item is None else item.probe.name, **{name: name for name in nameless}}
    also = {name: evidence.also[probe] for name, probe in named.items() if probe in evidence.also}
    return dataclasses.replace(trial, alternatives=tuple(shapes), rivals=others, nameless=nameless, also=also)


def _asked(evidence: Evidence, trials: Mapping[str, Trial], added: str) -> Iterable[Reason]:
    """Everything that was tried in a round, and the leading candidates that were only ranked, with the reasons."""
    table = evidence.table
    for name, trial in trials.items():
        first = f"{added} was added first" if added else "the search was broken off before it was its turn"
        reason = trial.refused or ("" if name == added else first)
        p = table.p_global if trial.item is None else table.corrected(trial.item.score)
        yield Reason(name, trial.evidence, p, trial.fit is not None, reason, trial.against)
    for ranked in (evidence.significant, evidence.significant_sentences):
        for item in ranked[:MOST_LISTED]:
            if item.name not in trials:
                reason = _too_far(evidence, item)
                yield Reason(item.name, item.log_bayes, table.corrected(item.score), False, reason)


def _too_far(evidence: Evidence, item: Ranked) -> str:
    """Reason for which a significant candidate was not tried: the candidates before it."""
    leading = *evidence.significant[:1], *evidence.significant_sentences[:1]
    best = max(leading, key=lambda ranked: ranked.log_bayes)
    gap = best.log_bayes - item.log_bayes
    return f"{best.name} is more probable, by {gap:.3g} in ln B" if gap > 0.0 else "others were tried first"

"""The search for missing effects: while something is missing, the most probable name of it is fitted and added.

1. `selection` says how many things are missing, and which names each of them may have, by linear steps from the fit.
2. The names of the thing with the most evidence are fitted, the most probable first. That ends when a name
   leaves nothing but noise, or is, by its fit, more probable than every name not fitted yet is by its linear step.
   Where that is a description, and the misfit is gross, the effect with the most evidence is fitted as well: of a gross
   misfit linear steps miss more than the evidence of the one differs from that of the other.
3. Where the fit is poor (`Evidence.poor`) and no name explains all but a tenth of the misfit (`thresholds.PART`), or
   where no name is left, changes that have no derivative compete with the names (`Refits.others`): structural effects
   and other descriptions of the instrument; where the fit is not poor, other curves of dispersion alone.
4. The most probable name that held-out data confirm joins the model, and the residuals are scored again. If they
   confirm none, the other names of its set are fitted. After these the next thing is tried, unless the first one is
   best described by a pattern: a weaker thing would then be fitted to a model that lacks the stronger one, and imitate
   it.

All are functions of a `State`, which never changes. `against` has the rules by which a trial is refused; one more is
that a pattern without a name is more probable (`_RoundInProgress._is_pattern`). A `TrialJudge`
says what a name is worth: by exact fits (`refits.Refits`) or, in tests, by linear steps
(`tests/diagnosis/linear_judge.py`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.exact import Trial, beyond_prior
from walop_jax.diagnosis.examination import Evidence
from walop_jax.diagnosis.findings import Choice, descriptions_of
from walop_jax.diagnosis.hypotheses import Ranked
from walop_jax.diagnosis.selection import MissingThings, Thing, most_probable
from walop_jax.fit.verdict import explains
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

    `choices` are other descriptions of the instrument that were compared, `fits` counts exact fits of additions.
    `ended` says after how much work the search was broken off ("40 fits"); empty: it was not broken off.
    """

    evidence: Any
    steps: tuple[Trial, ...] = ()
    rounds: tuple[Round, ...] = ()
    choices: Mapping[str, Choice] = dataclasses.field(default_factory=dict)
    fits: int = 0
    ended: str = ""


@runtime_checkable
class TrialJudge(Protocol):
    """What an addition to a model is worth: by exact fits (`refits.Refits`), or by linear steps alone.

    The evidence that it is given is the one that it put into its states: Refits works with an `Examination`.
    """

    def over(self, fits: int) -> str:
        """Amount of work after which nothing further is tried, in words ("40 fits"); empty: there is more to spend."""
        ...

    def fitted(self, evidence: Any, trial: Trial) -> Trial:
        """A trial that has a linear step, with what the judge finds for it: Refits fits it exactly."""
        ...

    def others(self, state: State) -> tuple[Sequence[Trial], Mapping[str, Choice]]:
        """Trials of effects without a linear step, and the other descriptions of the instrument that were compared."""
        ...

    def confronted(self, evidence: Any, trial: Trial) -> Trial:
        """A trial with its test against held-out data."""
        ...

    def adopted(self, state: State, trial: Trial) -> State:
        """The state after a trial has joined the model."""
        ...


def search(state: State, judge: TrialJudge) -> State:
    """The state in which nothing is missing, or nothing more can be added."""
    for _ in range(thresholds.MOST_STEPS):
        if not state.evidence.alarm:
            break
        if ended := judge.over(state.fits):
            return dataclasses.replace(state, ended=ended)
        if too_many_descriptions(state):
            break  # a further one would not make them an explanation
        trial, state = _next(state, judge)
        if trial is None:
            break
        state = judge.adopted(state, trial)
    return state


def too_many_descriptions(state: State) -> bool:
    """True if a model has more descriptions without a name than can explain data: what no two hold is unexplained."""
    return sum(len(step.groups) for step in state.steps) > thresholds.MOST_SENTENCES


def against(trial: Trial) -> str:
    """Reason not to add the name of a trial; empty: there is none."""
    if trial.fit is not None and not trial.fit.converged:
        return "its fit did not converge"
    if trial.evidence <= 0.0:
        return f"ln B = {trial.evidence:.3g} is not above 0: the model is more probable without it"
    if trial.fit is not None and (far := _far_beyond(trial)):
        return far
    before, after = trial.compared.heldout_before, trial.compared.heldout_after
    if after >= before and not trial.compared.confirmed:
        return (
            f"data that were left out agree worse with it (mean squared residual {before:.4g} → {after:.4g})"
        )
    return f"exposures of {trial.against} speak against it" if trial.against else ""


def _far_beyond(trial: Trial) -> str:
    """An amplitude of an optical description so far beyond its prior that it explains nothing, in words; empty: none.

    Optics that deviate by so much are another arrangement of the elements. A camera may deviate by so much: its gain
    steps when something breaks.
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


def linear_trial(evidence: Evidence, item: Ranked) -> Trial:
    """Trial of one candidate by its linear step; `expected` is the evidence that a fit should find, with its errors."""
    noise, statistic = evidence.table.noise_scale, item.score.statistic
    remaining = evidence.chi2 - statistic * (noise * evidence.scale) ** 2
    suffices = explains(remaining, evidence.dof - item.score.rank)
    linear = item.log_bayes + evidence.by_fit(item.score)
    return Trial(item.effect, item.log_bayes, remaining, suffices, item=item, expected=linear)


# ------------------------------------------------------------------------------------------------------- one round


Probable = tuple[float, Trial]
"""A trial with the logarithm of its probability among the names of its thing."""


@dataclasses.dataclass
class _RoundInProgress:
    """One round as it goes on: its trials by name, with what speaks against each, and what it has cost.

    `fits` and `choices` start from those of the state.
    """

    state: State
    judge: TrialJudge
    posterior: MissingThings
    fits: int
    choices: Mapping[str, Choice]
    trials: dict[str, Trial] = dataclasses.field(default_factory=dict)
    others_asked: bool = False

    @classmethod
    def of(cls, state: State, judge: TrialJudge) -> _RoundInProgress:
        """The round of a state, in which nothing has been tried."""
        return cls(state, judge, most_probable(state.evidence), state.fits, state.choices)

    @property
    def evidence(self) -> Evidence:
        """The evidence of the current model."""
        return self.state.evidence

    def passes(self, trial: Trial) -> bool:
        """True if nothing speaks against a trial. The trial is recorded in `trials` in any case."""
        self.trials[trial.name] = dataclasses.replace(trial, refused=against(trial))
        return not self.trials[trial.name].refused

    def names_of(self, thing: Thing) -> list[Probable]:
        """The names of a thing that nothing speaks against, as they were fitted.

        Names outside the set of the thing are fitted only if a name of the set passed and its fit made it less
        probable than the next name is by its linear step. If a pattern describes the thing best, the first name alone
        is fitted: linear steps are off by parts of a per cent, which a pattern can follow and a name cannot.
        """
        passed = list[Probable]()
        for number, (name, probability) in enumerate(thing.probabilities.items()):
            if not passed and (name not in thing.names or (thing.is_pattern and number)):
                break
            item = _candidate(self.evidence, name, thing)
            if item is None or item.name in self.trials:
                continue
            expected = float(np.log(max(probability, 1e-300)))
            settled = any(trial.leaves_noise or worth >= expected for worth, trial in passed)
            if settled or self.judge.over(self.fits):
                break
            self.fits += 1
            trial = self.judge.fitted(self.evidence, linear_trial(self.evidence, item))
            worth = expected + (trial.evidence - trial.expected) / self.evidence.scatter**2
            if self.passes(trial) and not self._is_pattern(thing, trial, worth):
                passed.append((worth, trial))
        return passed

    def effect_instead(self, passed: Sequence[Probable]) -> list[Probable]:
        """The effect with the most evidence, fitted, where a misfit is gross and descriptions alone passed.

        A misfit is gross if errors had to be scaled, or if the descriptions leave a poor fit. Linear steps are off by
        parts of it, which the hundreds of amplitudes of a smooth field follow and the one amplitude of an effect
        cannot. Which of the two is more probable their fits tell.
        """
        gross = self.evidence.scale > 1.0 or all(self._is_poor(trial) for _, trial in passed)
        if not passed or not gross or any(trial.effect is not Described for _, trial in passed):
            return []
        item = next((item for item in self.evidence.ranked if item.name not in self.trials), None)
        if item is None or self.judge.over(self.fits):
            return []
        self.fits += 1
        trial = self.judge.fitted(self.evidence, linear_trial(self.evidence, item))
        return self._by_fits([trial], passed)

    @staticmethod
    def _is_poor(trial: Trial) -> bool:
        """True if the fit of a trial is poor."""
        return trial.fit is not None and trial.remaining > thresholds.POOR_FIT * trial.fit.dof

    def _is_pattern(self, thing: Thing, trial: Trial, worth: float) -> bool:
        """True if a thing is more probably a pattern without a name than what a trial says; the trial is then refused.

        False if something was clearly missing and the trial leaves nothing but noise: a pattern could only describe
        the same with more numbers.
        """
        if worth > thing.patterns or (
            trial.leaves_noise and not explains(self.evidence.chi2, self.evidence.dof)
        ):
            return False
        refused = f"a pattern without a name is more probable, by {thing.patterns - worth:.3g} in ln B"
        self.trials[trial.name] = dataclasses.replace(trial, refused=refused)
        return True

    def explains(self, trial: Trial) -> bool:
        """Whether a trial explains so much that what has no linear step need not be asked."""
        missing, left = (chi2 - self.evidence.dof for chi2 in (self.evidence.chi2, trial.remaining))
        return trial.leaves_noise or left * thresholds.PART < missing

    def others(self, names: Sequence[Probable]) -> list[Probable]:
        """Trials of what has no linear step, once in a round; [] when asked again.

        They are compared with `names` by the evidence of their fits. A round that adds a description has refuted them:
        they are not asked beside it, where each would be another program with all amplitudes of the description.
        """
        if self.others_asked or any(step.groups for step in self.state.steps):
            return []
        self.others_asked = True
        trials, self.choices = self.judge.others(dataclasses.replace(self.state, fits=self.fits))
        self.fits += len(trials)
        return self._by_fits(trials, names)

    def _by_fits(self, trials: Iterable[Trial], names: Sequence[Probable]) -> list[Probable]:
        """The trials that nothing speaks against, compared with `names` by the evidence of their fits."""
        unit = self.evidence.scatter**2
        best = max(names, key=lambda pair: pair[1].evidence, default=None)
        level = 0.0 if best is None else best[0] - best[1].evidence / unit
        return [(level + trial.evidence / unit, trial) for trial in trials if self.passes(trial)]

    def compared(self, passed: Sequence[Probable]) -> list[Probable]:
        """The trials as they are, or by their fits alone where errors had to be scaled.

        In errors that the model without a trial asks for (`FitResult.noise_scale`), a misfit that one trial leaves and
        another one does not would hardly count: what they explain is compared in the errors that the best of their fits
        asks for.
        """
        scale, chi2 = self.evidence.scale, self.evidence.chi2
        if scale <= 1.0 or not passed:
            return list(passed)
        needed = max(1.0, min(trial.remaining for _, trial in passed) / max(self.evidence.dof, 1))
        finer = 0.5 * (1.0 / needed - 1.0 / scale**2)
        return [(trial.evidence + finer * (chi2 - trial.remaining), trial) for _, trial in passed]

    def confirmed(self, passed: Iterable[Probable]) -> Trial | None:
        """The most probable trial that data which took no part in its fit confirm; None: there is none."""
        for _, trial in sorted(passed, key=lambda pair: -pair[0]):
            confronted = self.judge.confronted(self.evidence, trial)
            if self.passes(confronted):
                return confronted
        return None

    def reasons(self, added: str) -> Iterator[Reason]:
        """Everything that was tried, and the leading candidates that were only scored, with the reasons."""
        table = self.evidence.table
        for name, trial in self.trials.items():
            first = (
                f"{added} was added first" if added else "the search was broken off before it was its turn"
            )
            reason = trial.refused or ("" if name == added else first)
            p = table.p_global if trial.item is None else table.corrected(trial.item.score)
            yield Reason(name, trial.evidence, p, trial.fit is not None, reason, trial.against)
        for ranked in (self.evidence.significant, self.evidence.significant_descriptions):
            for item in ranked[:MOST_LISTED]:
                if item.name not in self.trials:
                    p = table.corrected(item.score)
                    yield Reason(item.name, item.log_bayes, p, False, self._less_probable(item.name))

    def _less_probable(self, name: str) -> str:
        """What is more probable than a name that was not tried, in words."""
        things, least = self.posterior.things, 1.0 - thresholds.CERTAIN
        if not things:
            return f"nothing more is missing with a probability of {self.posterior.nothing_more:.2g}"
        # A name that is improbable for every thing is compared with the thing that is missing most clearly.
        thing = next((t for t in things if t.probabilities.get(name, 0.0) > least), things[0])
        if thing.is_pattern:
            return f"a pattern without a name is more probable ({thing.candidate})"
        best, probability = next(iter(thing.probabilities)), thing.probabilities.get(name, 0.0)
        if best == name:
            return "something else is missing more clearly, and was asked first"
        return f"{best} is more probable: {thing.probabilities[best]:.2g}, and this {probability:.1g}"


def _next(state: State, judge: TrialJudge) -> tuple[Trial | None, State]:
    """The most probable addition that nothing speaks against (None: there is none), and the state with the reasons."""
    turn, accepted = _RoundInProgress.of(state, judge), None
    things = list(turn.posterior.things)
    while accepted is None and not judge.over(turn.fits):
        thing = things.pop(0) if things else None
        names = [] if thing is None else turn.names_of(thing)
        passed = names + turn.effect_instead(names)
        if (state.evidence.poor or thing is None) and not any(turn.explains(trial) for _, trial in passed):
            passed += turn.others(passed)
        passed = turn.compared(passed)
        accepted = turn.confirmed(passed)
        if accepted is not None:
            of_thing = any(accepted.name == trial.name for _, trial in names)
            accepted = _with_rivals(state.evidence, accepted, thing if of_thing else None, passed)
        elif thing is None:
            break
        elif names and not thing.is_pattern:  # other names of its set may be confirmed
            things.insert(0, thing)
        elif thing.is_pattern:  # a weaker one, fitted without it, would imitate it
            things = []
    added = "" if accepted is None else accepted.name
    rounds = (*state.rounds, Round(state.evidence.table.p_global, added, tuple(turn.reasons(added))))
    ended = judge.over(turn.fits) if accepted is None else ""
    return accepted, dataclasses.replace(
        state, rounds=rounds, choices=turn.choices, fits=turn.fits, ended=ended
    )


def _candidate(evidence: Evidence, name: str, thing: Thing) -> Ranked | None:
    """The candidate of a name, with the shapes that it may have as this thing; None where it cannot be fitted."""
    if evidence.smooth is not None and name in evidence.smooth.names:
        item = evidence.smooth.ranked(name, evidence.table.noise_scale)
        return dataclasses.replace(item, log_bayes=item.log_bayes - evidence.price)
    item = evidence.by_name.get(name)
    shapes = [p for p in thing.shapes.get(name, ()) if item is not None and p.effect is item.effect]
    if item is None or not shapes:
        return item
    scored = [(probe, evidence.table[probe.name]) for probe in shapes[: thresholds.MOST_FITTED]]
    (probe, score), *others = scored
    return dataclasses.replace(item, probe=probe, score=score, others=tuple(others))


def _with_rivals(evidence: Evidence, trial: Trial, thing: Thing | None, passed: Iterable[Probable]) -> Trial:
    """A trial with its rivals, and its probability among them.

    Rivals are the other names in the set of its thing (None: only its fit spoke for it, and the set is one of linear
    steps), and names that passed and are not improbable beside it.
    """
    worth = {other.name: probable for probable, other in passed}
    near = [name for name, value in worth.items() if value > worth[trial.name] - thresholds.IMPROBABLE]
    linear, in_set = ({}, ()) if thing is None else (thing.probabilities, thing.names)
    own = trial.name, trial.effect.name
    names = [name for name in dict.fromkeys([*in_set, *near]) if name not in own]
    effects = {item.effect.name for item in evidence.ranked}
    nameless = tuple(name for name in names if name not in effects)[: thresholds.MOST_CLASSES]
    probes = {trial.name: "" if trial.item is None else trial.item.probe.name} | {n: n for n in nameless}
    logs = {name: float(np.log(max(value, 1e-300))) for name, value in linear.items()} | worth
    also = {**evidence.synonyms, **({} if evidence.smooth is None else evidence.smooth.synonyms)}
    return dataclasses.replace(
        trial,
        rivals=tuple(name for name in names if name in effects),
        nameless=nameless,
        synonyms={name: also[probe] for name, probe in probes.items() if probe in also},
        probability=float(np.exp(worth[trial.name] - np.logaddexp.reduce(list(logs.values())))),
    )

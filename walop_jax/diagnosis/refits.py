"""The judge of the search that fits: trials, the data left out of their fits, and the model that goes on."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from walop_jax.diagnosis import grammar, thresholds
from walop_jax.diagnosis.descriptions import other_descriptions
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.exact import (
    Trial,
    refit_without,
    try_effect,
    try_sentences,
    try_shapes,
    with_refuted_priors_widened,
)
from walop_jax.diagnosis.examination import Examination, examine, shortest
from walop_jax.diagnosis.findings import Choice
from walop_jax.diagnosis.hypotheses import Hypotheses, Ranked, sentences_of
from walop_jax.diagnosis.predictions import before_and_after, gains_by_kind, predicts_unseen
from walop_jax.diagnosis.search import State, names_first
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.progress import Stage
from walop_jax.likelihood.columns import columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Context, Described


@dataclasses.dataclass(frozen=True)
class Refits:
    """All that the fits of a search have in common; `adopt` is the only function that gives a state another fit.

    Nothing further is tried after `most` fits, nor `minutes` after the time `began` (infinite: no matter how long it
    takes).
    """

    context: Context
    hypotheses: Hypotheses
    rng: np.random.Generator
    tell: Callable[[str], None]
    minutes: float = np.inf
    began: float = 0.0
    most: int = thresholds.MOST_FITS

    def over(self, fits: int) -> str:
        """Amount of work after which nothing further is tried, in words; empty: there is more to spend."""
        if time.perf_counter() >= self.began + 60.0 * self.minutes:
            return f"{self.minutes:g} minutes"
        return f"{fits} fits" if fits >= self.most else ""

    def examined(self, result: FitResult, earlier: Examination | None = None) -> Examination:
        """A fit, scored; the columns of an `earlier` one serve again where the light has hardly changed."""
        evidence = examine(result, self.hypotheses, self.rng, earlier)
        if evidence.alarm:
            self.tell(Stage(f"p = {evidence.table.p_global:.2g}: something is missing", "naming"))
        return evidence

    def adopt(
        self, state: State, result: FitResult, steps: Sequence[Trial], earlier: Examination | None = None
    ) -> State:
        """The state with another fit of its set, and with the additions that this has."""
        evidence = self.examined(result, earlier or state.evidence)
        return dataclasses.replace(state, evidence=evidence, steps=tuple(steps))

    # ------------------------------------------------------------------------------------------ as a judge

    def fitted(self, evidence: Examination, trial: Trial) -> Trial:
        """A linear trial fitted exactly."""
        item = trial.item
        assert item is not None
        self.tell(f"trying {item.name}")
        if item.effect is Described:
            if not self._hopeful(evidence, item):
                return dataclasses.replace(trial, predicts=False)
            description = self._with_best_times(evidence, shortest(item))
            refitted = try_sentences(evidence.result, description, self.context, len(evidence.sentences))
        else:
            shapes = sum(probe.effect is item.effect for probe in evidence.probes)
            refitted = try_shapes(evidence.result, item, self.context, shapes)
        return dataclasses.replace(refitted, item=item, linear=trial.linear)

    def _with_best_times(self, evidence: Examination, description: Described) -> Described:
        """A description that starts or stops in time, where it explains most by linear steps; any other as it is."""
        ((change, amplitude), *further) = description.terms()
        result = evidence.result
        for end in (0, 1) if not further else ():
            if times := grammar.retimed(change, result.calset.exposures, end):
                c = columns(result.likelihood, result.values, [[(1.0, sentence)] for sentence in times])
                c = evidence.design.projector(evidence.design.stacked([c]))
                along, square = c.T @ evidence.design.residual, np.sum(c**2, axis=0)
                best = int(np.argmax(along**2 / np.where(square > 0, square, np.inf)))
                change, amplitude = times[best], -along[best] / square[best]
        return description if further else Described.saying([change.text], [float(amplitude)])

    def _hopeful(self, evidence: Examination, item: Ranked) -> bool:
        """True if a sentence predicts held-out data by its linear step: it has no name that would support it."""
        single = any("exposure" in text for text in sentences_of(item.probe))
        column = [evidence.candidates[item.probe.name]]
        return predicts_unseen(evidence.design, column, thresholds.HOPEFUL, of_states=not single)

    def others(self, state: State) -> tuple[list[Trial], Mapping[str, Choice]]:
        """The instrument described otherwise; where the model is far off in all ways, and structural effects."""
        result, trials = state.evidence.result, list[Trial]()

        def allowed() -> bool:
            return not self.over(state.fits + len(trials))

        for effect in self.hypotheses.effects if state.evidence.poor else ():
            if effect.is_structural() and effect.name not in result.model.effect_names and allowed():
                self.tell(f"trying {effect.name}")
                trials.append(try_effect(result, effect.neutral(self.context), self.context))
        described, compared = other_descriptions(
            result, self.context, allowed, self.tell, all_of_them=state.evidence.poor, earlier=state.choices
        )
        return [*trials, *described], {**state.choices, **compared}

    def confronted(self, evidence: Examination, trial: Trial) -> Trial:
        """A trial with the exposures and places left out of its fit, and the evidence of each KIND against it."""
        assert trial.fit is not None
        after = Design.of(trial.fit)
        compared = before_and_after(trial.effect.name, evidence.design, after)
        closer = compared["heldout_after"] < compared["heldout_before"]
        against = contradicting(evidence.design, after) if closer else ""
        if against:
            self.tell(f"{trial.name}: exposures of {against} speak against it")
        return dataclasses.replace(trial, compared=compared, against=against)

    def decided(self, trials: list[Trial]) -> list[Trial]:
        """Trials in order of evidence; what scaled errors leave even at the top is decided with errors as stated."""
        even = [trial for trial in trials if trials[0].evidence - trial.evidence < thresholds.EVEN_ODDS]
        fits = [trial.fit for trial in even if trial.fit is not None and trial.fit.noise_scale > 1.0]
        if len(even) < 2 or len(fits) < len(even):
            return trials
        exact = [fit(scaled.likelihood, start=scaled.values, noise_scale=1.0) for scaled in fits]
        best, clearly = min(again.expansion.objective for again in exact), []
        for trial, again in zip(even, exact, strict=True):
            evidence = trial.evidence - 0.5 * (again.expansion.objective - best)
            clearly.append(dataclasses.replace(trial, fit=again, evidence=evidence))
        remaining = [trial for trial in trials if all(trial is not t for t in even)]
        return [*sorted(clearly, key=names_first), *remaining]

    def adopted(self, state: State, trial: Trial) -> State:
        """The state with the model of a trial, fitted again where priors or errors were in its way."""
        assert trial.fit is not None
        evidence, name = state.evidence, trial.effect.name
        result = settled(trial.fit, [name, *(step.effect.name for step in state.steps)])
        compared, groups = dict(trial.compared), (trial.name,) if trial.effect is Described else ()
        if result is not trial.fit:
            compared |= before_and_after(name, evidence.design, Design.of(result))
        item = trial.item or next((r for r in evidence.ranked if r.effect is trial.effect), None)
        table = evidence.table
        compared["score"] = item.score.statistic if item else evidence.chi2 - trial.left
        compared["p_value"] = table.corrected(item.score) if item else table.p_global
        steps = [step for step in state.steps if step.effect is not trial.effect]
        # A further change of the description joins those before.
        for earlier in (step for step in state.steps if step.effect is trial.effect):
            before = "chi2_before", "heldout_before", "residual_before"
            compared |= {key: earlier.compared[key] for key in before}
            groups = (*earlier.groups, *groups)
        step = dataclasses.replace(trial, compared=compared, groups=groups)
        self.tell(f"added {name}; scoring the residuals")
        return self.adopt(state, result, [*steps, step])


def settled(result: FitResult, names: Collection[str]) -> FitResult:
    """A fit with errors as given where they need not be scaled any more, and the refuted priors of effects widened."""
    if result.noise_scale > 1.0:
        result = fit(result.likelihood, start=result.values)
    model = result.model
    for name in names:
        model = with_refuted_priors_widened(model, result.values, name)
    if model is not result.model:
        result = fit(Likelihood.of(result.calset, model), start=result.values)
    return result


def without(result: FitResult, name: str, remaining: Collection[str]) -> FitResult:
    """A fit without an effect, beside the `rest` of those that were added."""
    return settled(refit_without(result, name), remaining)


def contradicting(before: Design, after: Design) -> str:
    """KINDs of exposures that all others predict worse with the additions of a fit; empty: none."""
    gains = gains_by_kind(before, after)
    return ", ".join(f"KIND {kind}" for kind, gain in gains.items() if gain < -thresholds.EVEN_ODDS)


def refitted_in_order(steps: Sequence[Trial], start: Design, end: Design) -> list[Trial]:
    """The steps as they lead, one after the other, from one fit to another that has no effects beside theirs.

    The models between the two are fitted again; what belongs to the discovery of an effect stays.
    """
    fits = [end.fit] if steps else []
    for step in reversed(steps[1:]):
        fits.append(refit_without(fits[-1], step.effect.name))
    compared, before = [], start
    for step, result in zip(steps, reversed(fits), strict=True):
        after = end if result is end.fit else Design.of(result)
        changed = {**step.compared, **before_and_after(step.effect.name, before, after)}
        compared.append(dataclasses.replace(step, compared=changed))
        before = after
    return compared

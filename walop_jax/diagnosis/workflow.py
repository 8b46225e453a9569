"""The workflow: alarm, name, addition, until the data are explained or what is left has no name.

1. Fit the model. 2. Score every effect of the catalogue, every sentence (`grammar`) and every pattern without a
name; global p by Monte Carlo. 3. Below `Policy.alarm`: add names one after the other (`search`), each fitted together
with everything before it is added. 4. Drop names that are not needed beside the others. 5. Names that leave a poor fit
nearly as poor are told as parts of what is missing, and taken out again. 6. What no name explains is described, and the
verdict is `unexplained`; a free-form term for it stays in the model where it predicts settings and parts of the field
that it has not seen, and names that only stood in for it are dropped. 7. List for each name what the data cannot tell
from it, and give the verdict. Names are given at any size; `Step.negligible` says when it does not matter for q and u.

Nothing further is tried after `Policy.minutes`, fewer where the model is far from the data: the best found so far
comes back, and says so.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from walop_jax.calibration.accuracy import largest_change
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar
from walop_jax.diagnosis.class_members import classes_of
from walop_jax.diagnosis.class_product import only_a_class, with_average
from walop_jax.diagnosis.descriptions import other_descriptions
from walop_jax.diagnosis.design import Design, held_out, strata
from walop_jax.diagnosis.exact import (
    Trial,
    beyond_prior,
    evidence_of_presence,
    refit_without,
    signature,
    spoken_choices,
    try_effect,
    try_sentences,
    try_shapes,
    with_refuted_priors_widened,
)
from walop_jax.diagnosis.examination import Examination, examine, most_points, shortest
from walop_jax.diagnosis.findings import Choice, Diagnosis, Outcome, Step, Unexplained, describe, told
from walop_jax.diagnosis.hypotheses import Probe, Ranked, applicable, said_by
from walop_jax.diagnosis.hypotheses import probes as all_probes
from walop_jax.diagnosis.policy import POLICY, Policy
from walop_jax.diagnosis.readings import mixups_of, refusal
from walop_jax.diagnosis.search import (
    before_and_after,
    gains_by_kind,
    names_first,
    predicts_unseen,
    refitted_in_order,
    search,
)
from walop_jax.diagnosis.stated_conditions import instead_of_names, rival_conditions
from walop_jax.diagnosis.trust import examined, pixel_structure
from walop_jax.fit.model_file import base_model
from walop_jax.fit.refit import FitResult, fit, with_honest_errors
from walop_jax.fit.stand_in import in_field_points
from walop_jax.fit.verdict import Quality
from walop_jax.io.progress import Stage
from walop_jax.likelihood import limits
from walop_jax.likelihood.columns import columns
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Context, Described, EffectKind, FreeForm, OtherDescription
from walop_jax.model.parameters import values_of
from walop_jax.model.specification import Model, effect_context


def diagnose(
    calset: CalibrationSet,
    model: Model | None = None,
    *,
    catalogue: Sequence[EffectKind] | None = None,
    seed: int = 0,
    minutes: float | None = None,
    as_written: bool = False,
    policy: Policy = POLICY,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what `model` (default: the base model) lacks to explain a calibration set.

    `catalogue` are the effects that may be named (default: those that the model knows), `policy` the thresholds. Of a
    set with more than `limits.DIAGNOSED_ROWS` (exposure, point) pairs, or whose columns would be more than
    `limits.DIAGNOSED_NUMBERS`, points spread over the field are looked at. Nothing further is tried after `minutes`
    (default: those of the policy for such a model);
    what is left then has no name, and `Diagnosis.caution` says so. Both fits are examined. Other readings of the data
    are not tried where the caller has done that already (`as_written`). Raises what `fit` raises, and `DataError` for
    data that another reading explains (`readings`).
    """
    began = time.perf_counter()
    tell = progress or (lambda text: None)
    policy = policy if minutes is None else dataclasses.replace(policy, minutes=minutes)
    model = model or base_model(calset)
    catalogue = model.catalogue if catalogue is None else catalogue
    calset = in_field_points(calset, model, tell, pixel_structure)
    context = effect_context(model.template, calset.exposures)
    every = grammar.sentences(model.template, calset.exposures, len(calset.points))
    amplitudes = sum(len(probe.widths) for probe in (*all_probes(tuple(catalogue), context), *every))
    some = thinned(calset, most_points(calset, model.template, amplitudes), neighbours=1)
    if len(some.points) < len(calset.points):
        tell(f"looking at {len(some.points)} of {len(calset.points)} field points")
    judge = Refit.of(some, model, catalogue, every, np.random.default_rng(seed), tell, policy, began)
    readings = () if as_written else mixups_of(judge.fit, policy)
    if readings and readings[0].explained < policy.reading_sure:
        raise refusal(judge.fit, readings)
    before = judge.fit
    if minutes is None and judge.fit.noise_scale > 1.0:
        policy = dataclasses.replace(policy, minutes=min(policy.minutes, policy.minutes_far_off))
        judge = dataclasses.replace(judge, policy=policy, until=began + 60.0 * policy.minutes)
    tell(Stage("scoring every effect and pattern", "scoring"))
    first = judge.examined()
    last, nameless = judge.conclusion(first, _left(first, judge, policy))
    # Another reading that comes near competes with names and with other descriptions of the instrument.
    if nameless and readings and readings[0].explained * judge.fit.dof < judge.fit.chi2:
        raise refusal(before, readings)
    if (judge.steps or nameless) and (stated := instead_of_names(before, judge.fit, policy)):
        parts = () if nameless is None else nameless.parts
        names = ", ".join([step.effect for step in judge.steps] or parts) or "none that holds"
        text = f"one number that the set states explains more than names do ({names}), if it is {stated}"
        nameless = Unexplained(first.table.p_global, text, (), parts=parts)
        judge, last = dataclasses.replace(judge, fit=before, steps=[]), first
    steps = tuple(judge.finished(step, last) for step in judge.steps)
    verdict: Outcome = "unexplained" if nameless else "effect_found" if steps else "consistent"
    tell("examining what is left")
    names = {step.effect for step in steps}
    alike = {name for step in steps for name in (*step.equivalent, *step.nameless)} - {Described.name}
    examined_last = last.result is judge.fit
    members = classes_of(last, judge.context, names, judge.said, alike) if examined_last else ()
    found = Diagnosis(
        verdict=verdict,
        steps=steps,
        candidates=first.summary(),
        limits=tuple(last.limits()),
        untestable=first.untestable(judge.catalogue),
        unexplained=nameless,
        p_value=first.table.p_global,
        remaining_p=last.table.p_global,
        noise_scale=judge.fit.noise_scale * last.table.noise_scale,
        noise_p=last.noise_p,
        before=before,
        after=judge.fit,
        seconds=time.perf_counter() - began,
        points=len(calset.points),
        choices=tuple(sorted(judge.choices.values(), key=_promise)),
        classes=tuple(first.classes()),
        policy=policy,
        ended=judge.ended,
        members=members,
    )
    del first, last  # the columns of all candidates, gigabytes of a large set
    return _examined(found, seed)


def _left(first: Examination, judge: Refit, policy: Policy) -> Examination:
    """The evidence that the search leaves."""
    last = first
    for _, _, left in search(first, judge, policy):
        last = left
    return last


def _examined(found: Diagnosis, seed: int) -> Diagnosis:
    """A diagnosis with the verdicts on its fits; what a wrong statement of the set explains as well is remarked."""
    after = examined(with_honest_errors(found.after), seed, as_written=True, policy=found.policy)
    for sentence in only_a_class(found.members):
        after = after.doubted(Quality.CLASS_ONLY, sentence)
    after = with_average(after, found.members)
    if found.before is found.after:
        return dataclasses.replace(found, before=after, after=after)
    for sentence in rival_conditions(Design.of(found.before), found.after.chi2, found.policy):
        after = after.remarked(sentence)
    # Where χ² speaks against the model given, the steps say what is missing.
    explained = found.before.explains_data or found.before.nearly_explains_data
    before = found.before.judged()
    if explained:
        before = examined(found.before, seed, as_written=True, policy=found.policy)
    return dataclasses.replace(found, before=before, after=after)


def _promise(choice: Choice) -> tuple[float, float]:
    """Order of other descriptions: by the gain where it is known, then by what is left."""
    return (-choice.better_by if np.isfinite(choice.better_by) else np.inf), choice.left


@dataclasses.dataclass
class Refit:
    """The judge that fits: the current fit of a diagnosis, and the steps so far.

    `wanted` are the probes of `catalogue`, `sentences` and `parts` what else can be said (`grammar`). `choices` are
    other descriptions that were tried, `said` the groups of sentences that were added, `contradicted` what exposures of
    another KIND speak against, in words. `ended` says that there was no time for something.
    """

    calset: CalibrationSet
    context: Context
    catalogue: tuple[EffectKind, ...]
    wanted: Sequence[Probe]
    sentences: Sequence[Probe]
    parts: Sequence[tuple[Probe, frozenset[EffectKind]]]
    rng: np.random.Generator
    tell: Callable[[str], None]
    policy: Policy
    until: float
    fit: FitResult
    steps: list[Step] = dataclasses.field(default_factory=list)
    choices: dict[str, Choice] = dataclasses.field(default_factory=dict)
    said: list[str] = dataclasses.field(default_factory=list)
    contradicted: dict[str, str] = dataclasses.field(default_factory=dict)
    ended: bool = False
    _compared: dict[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        calset: CalibrationSet,
        model: Model,
        catalogue: Sequence[EffectKind],
        sentences: Sequence[Probe],
        rng: np.random.Generator,
        tell: Callable[[str], None],
        policy: Policy,
        began: float,
    ) -> Refit:
        """Fit a model to a set and lay out what may be said beyond it."""
        context = effect_context(model.template, calset.exposures)
        fitting = applicable(catalogue, context, model.template)
        alone, parts = grammar.beside_names(sentences, fitting, context, model.template)
        tell(Stage("fitting the model", "fitting"))
        return cls(
            calset=calset,
            context=context,
            catalogue=fitting,
            wanted=list(all_probes(fitting, context)),
            sentences=alone,
            parts=parts,
            rng=rng,
            tell=tell,
            policy=policy,
            until=began + 60.0 * policy.minutes,
            fit=fit(Likelihood.of(calset, model)),
        )

    def examined(self, earlier: Examination | None = None) -> Examination:
        """The current fit, scored."""
        found = examine(self.fit, self.wanted, self.rng, earlier, self.sentences, self.parts, self.policy)
        if found.alarm:
            self.tell(Stage(f"p = {found.table.p_global:.2g}: something is missing", "naming"))
        return found

    # ------------------------------------------------------------------------------------------ as a judge

    def time_left(self) -> bool:
        """True if another trial may begin."""
        self.ended |= time.perf_counter() >= self.until
        return not self.ended

    def fitted(self, state: Examination, trial: Trial) -> Trial | None:
        """A linear trial fitted exactly; None where the fit does not converge."""
        item = trial.item
        assert item is not None
        self.tell(f"trying {item.probe.name if item.effect is Described else item.effect.name}")
        if item.effect is Described:
            if not self._hopeful(state, item):
                return None
            said = self._dated(state, shortest(item, self.policy.most_together))
            found = try_sentences(self.fit, said, self.context, len(state.sentences))
        else:
            shapes = sum(probe.effect is item.effect for probe in state.probes)
            found = try_shapes(self.fit, item, self.context, shapes, self.policy)
        if found.fit is None or not found.fit.converged:
            return None
        return dataclasses.replace(found, item=item, linear=trial.linear)

    def _dated(self, state: Examination, said: Described) -> Described:
        """A description that starts or stops in time, where it explains most by linear steps; any other as it is."""
        ((change, amplitude), *more) = said.terms()
        for end in (0, 1) if not more else ():
            if times := grammar.retimed(change, self.calset.exposures, end):
                own = columns(self.fit.likelihood, self.fit.values, [[(1.0, one)] for one in times])
                own = state.design.projector(state.design.stacked([own]))
                along, square = own.T @ state.design.residual, np.sum(own**2, axis=0)
                best = int(np.argmax(along**2 / np.where(square > 0, square, np.inf)))
                change, amplitude = times[best], -along[best] / square[best]
        return said if more else Described.saying([change.text], [float(amplitude)])

    def _hopeful(self, state: Examination, item: Ranked) -> bool:
        """True if a sentence predicts what it has not seen, by its linear step: nobody has a name for it to believe."""
        single = any("exposure" in text for text in said_by(item.probe))
        columns = [state.said[item.probe.name]]
        return predicts_unseen(state.design, columns, self.policy.hopeful, of_states=not single)

    def others(self, state: Examination) -> Iterator[Trial]:
        """The instrument described otherwise; where the model is far off in all ways, and structural effects."""
        for effect in self.catalogue if state.poor else ():
            if effect.is_structural() and effect.name not in self.fit.model.effect_names and self.time_left():
                self.tell(f"trying {effect.name}")
                yield try_effect(self.fit, effect.neutral(self.context), self.context)
        how = self.policy, self.time_left, self.tell, self.choices
        yield from other_descriptions(self.fit, self.context, *how, all_of_them=state.poor)

    def decided(self, trials: list[Trial]) -> list[Trial]:
        """Trials in order of evidence; what scaled errors leave even at the top is decided with errors as stated."""
        even = [t for t in trials if trials[0].evidence - t.evidence < self.policy.even_odds]
        exact = [
            (t, fit(t.fit.likelihood, start=t.fit.values, noise_scale=1.0))
            for t in (even if self.fit.noise_scale > 1.0 and len(even) > 1 else ())
            if t.fit is not None
        ]
        best = min((f.posterior.objective for _, f in exact), default=0.0)
        clearly = [
            dataclasses.replace(t, fit=f, evidence=t.evidence - 0.5 * (f.posterior.objective - best))
            for t, f in exact
        ]
        others = [t for t in trials if not any(t is one for one, _ in exact)]
        return [*sorted(clearly, key=lambda trial: names_first(trial, self.policy)), *others]

    def confirmed(self, state: Examination, trial: Trial) -> bool:
        """True if data that took no part in the fit agree better with the effect than without, and no KIND worse."""
        assert trial.fit is not None
        after = Design.of(trial.fit)
        self._compared = before_and_after(trial.effect.name, state.design, after)
        if self._compared["heldout_after"] >= self._compared["heldout_before"]:
            return False
        worse = self._contradicted(state.design, after)
        if worse:
            name = trial.effect.name if trial.effect is not Described else "; ".join(trial.sentences)
            self.contradicted[name] = f"{name} (exposures of {worse} speak against it)"
            self.tell(f"{name}: exposures of {worse} speak against it")
        return not worse

    def _contradicted(self, before: Design, after: Design) -> str:
        """KINDS of exposures that all others predict worse with what a fit has more; empty: none."""
        gains = gains_by_kind(before, after)
        return ", ".join(f"KIND {kind}" for kind, gain in gains.items() if gain < -self.policy.contradicted)

    def adopted(self, state: Examination, trial: Trial) -> Examination:
        """Go on with the model of a trial, everything fitted again where priors or errors were in its way."""
        name = trial.effect.name
        assert trial.fit is not None
        item = trial.item or next((r for r in state.ranked if r.effect is trial.effect), None)
        step = Step(
            effect=name,
            parameters={},
            score=item.score.statistic if item else state.chi2 - trial.left,
            p_value=state.table.corrected(item.score) if item else state.table.p_global,
            log_bayes=trial.evidence,
            nameless=trial.nameless,
            negligible_below=self.policy.negligible,
            equivalent=trial.rivals,
            alternatives=trial.alternatives,
            **self._compared,
        )
        if trial.effect is Described and item is not None:
            self.said.append(item.probe.name)
        # A further change of the description joins those before.
        earlier = next((s for s in self.steps if s.effect == name), None)
        self.steps = [*(s for s in self.steps if s is not earlier), step]
        self._go_on_with(trial.fit)
        if self.fit is not trial.fit:
            step = dataclasses.replace(step, **before_and_after(name, state.design, Design.of(self.fit)))
        if earlier is not None:
            step = dataclasses.replace(
                step,
                chi2_before=earlier.chi2_before,
                heldout_before=earlier.heldout_before,
                residual_before=earlier.residual_before,
            )
        self.steps[-1] = step
        self.tell(f"added {name}; scoring what is left")
        return self.examined(state)

    def _go_on_with(self, result: FitResult) -> None:
        """Take a fit: errors as given where they need not be scaled any more, refuted priors widened."""
        if result.noise_scale > 1.0:
            result = fit(result.likelihood, start=result.values)
        model = result.model
        for step in self.steps:
            model = with_refuted_priors_widened(model, result.values, step.effect)
        if model is not result.model:
            result = fit(Likelihood.of(self.calset, model), start=result.values)
        self.fit = result

    # ---------------------------------------------------------------------------------------------- the end

    def conclusion(self, first: Examination, last: Examination) -> tuple[Examination, Unexplained | None]:
        """Drop what is not needed, then ask what has no name: the examination of the final model, and that."""
        state, nameless = self._concluded(first, last)
        if self.steps and (worse := self._worse(first, state)):
            return self._not_adopted(first, worse)
        if nameless is not None and self.contradicted:
            told = tuple(text for name, text in self.contradicted.items() if name not in self.said)
            nameless = dataclasses.replace(nameless, parts=(*nameless.parts, *told))
        if nameless is not None or len(self.said) <= self.policy.most_sentences:
            return state, nameless
        # Something that no sentence holds looks like several that are there.
        text = f"{len(self.said)} descriptions were needed: they say where it sits, no single one of them what it is"
        nameless = Unexplained(state.table.p_global, f"{text} ({' | '.join(self.said)})", ())
        said = [first.said[name] for name in self.said]
        if predicts_unseen(first.design, said, self.policy.useful):
            return state, nameless
        self._without(Described.name)
        state = self.examined(first)
        self.steps = refitted_in_order(self.steps, first.design, state.design)
        return state, _and(dataclasses.replace(nameless, p_value=state.table.p_global), _LEFT_OUT)

    def _worse(self, first: Examination, last: Examination) -> str:
        """Exposures that the final model predicts worse than the first, in words; empty: none."""
        if kinds := self._contradicted(first.design, last.design):
            return f"exposures of {kinds}, as all others predict them"
        before, after = (held_out(one.design, "exposures") for one in (first, last))
        if after > (1.0 + self.policy.held_out_worse) * before:
            return f"exposures that are left out (mean squared residual {before:.3g} → {after:.3g})"
        return ""

    def _not_adopted(self, first: Examination, worse: str) -> tuple[Examination, Unexplained]:
        """Go back to the first model: what was found is told as parts."""
        steps, self.steps, self.fit = self.steps, [], first.result
        parts = tuple(f"{step.effect} (χ² {step.chi2_before:.4g} → {step.chi2_after:.4g})" for step in steps)
        text = f"with what was found the model predicts worse {worse}, so nothing was adopted: {'; '.join(parts)}"
        self.said.clear()
        found = _and(unexplained(first, tuple(first.patterns_needed())), text)
        return first, dataclasses.replace(found, parts=(*parts, *self.contradicted.values()))

    def _concluded(self, first: Examination, state: Examination) -> tuple[Examination, Unexplained | None]:
        dropped, parts = self._drop_what_is_not_needed(), ()
        while True:
            if dropped:
                state = self.examined(first)
                self.steps = refitted_in_order(self.steps, first.design, state.design)
            # Errors that are a few per cent too small are no effect: nothing but their size is wrong.
            if not state.alarm and (self.fit.explains_data or self.fit.nearly_explains_data):
                return state, None
            self.tell("an unidentified residual remains")
            if not parts and (parts := self._parts(first)):
                dropped = True
                continue
            nameless = self._unexplained(state)
            if parts:
                text = "explains a part and may stand in for something else, not added"
                nameless = dataclasses.replace(_and(nameless, f"{text}: {'; '.join(parts)}"), parts=parts)
            if not nameless.term:
                return state, nameless
            dropped = self._drop_what_is_not_needed()
            if not dropped:
                return self.examined(state), nameless
            # Those names only stood in for what has none: what is it without them?
            self._go_on_with(refit_without(self.fit, FreeForm.name))

    def _drop_what_is_not_needed(self) -> bool:
        """Take out, one by one, names that the final model does not need; whether there were any."""
        dropped = False
        while self.steps and len(self.fit.model.template.effects) > 1:
            worth = {s.effect: evidence_of_presence(self.fit, s.effect) for s in self.steps}
            least = min(worth, key=lambda name: worth[name])
            if worth[least] >= self.policy.least_evidence:
                break
            self.tell(f"{least} is no longer needed")
            self._without(least)
            dropped = True
        return dropped

    def _without(self, name: str) -> None:
        self.steps = [s for s in self.steps if s.effect != name]
        self._go_on_with(refit_without(self.fit, name))

    def _parts(self, first: Examination) -> tuple[str, ...]:
        """Take out names that leave a poor fit nearly as poor: in words what each of them would explain.

        Such a name explains no more than it can borrow from what is missing, and the matrix between the points is worse
        with it. Other descriptions of the instrument stay: they have no amplitude that could bend.
        """
        names = [step for step in self.steps if step.effect != OtherDescription.name]
        left, missing = (f.chi2 / max(f.dof, 1) - 1.0 for f in (self.fit, first.result))
        if not names or left < self.policy.poor_fit - 1.0 or left * self.policy.part < missing:
            return ()
        found = []
        for step in names:
            before, after = (chi2 / max(first.dof, 1) for chi2 in (step.chi2_before, step.chi2_after))
            found.append(f"{step.effect} (χ²/dof {before:.3g} → {after:.3g})")
            self.tell(f"{step.effect} explains a part only: not added")
        for step in names:
            self._without(step.effect)
        return tuple(found)

    def _unexplained(self, state: Examination) -> Unexplained:
        patterns = tuple(state.patterns_needed())
        found = unexplained(state, patterns)
        blocks = dict.fromkeys(block for name, _ in patterns if (block := state.blocks[name]) is not None)
        if len(self.calset.exposures) > limits.FREE_EXPOSURES:
            blocks.pop("exposures", None)
        if FreeForm.name in self.fit.model.effect_names or not blocks or not self.time_left():
            return found
        # A block has all patterns of its kind: those that are not needed cost errors as well.
        measured, every = state.design.measured, list(strata(state.design.measured))
        useful = tuple(
            block
            for block in blocks
            if predicts_unseen(
                state.design,
                [measured.candidate(one) for one in every if one.block == block],
                self.policy.useful,
            )
        )
        return self._with_free_form(state, found, useful) if useful else _and(found, _LEFT_OUT)

    def _with_free_form(self, state: Examination, found: Unexplained, blocks: tuple[str, ...]) -> Unexplained:
        """Add a free-form term for patterns without a name, so that the calibration improves all the same."""
        term = FreeForm.of(self.context, blocks=blocks)
        trial = try_effect(self.fit, term, self.context)
        if trial.fit is None or not trial.fit.converged:
            return found
        before = self.fit
        self._go_on_with(trial.fit)
        change = largest_change(instrument_matrices(before), instrument_matrices(self.fit))
        return dataclasses.replace(
            found, term=blocks, chi2_before=before.chi2, chi2_after=self.fit.chi2, change_of_qu=change
        )

    def finished(self, step: Step, state: Examination) -> Step:
        """The step with final parameters, what cannot be told from it, and where it sits."""
        change = signature(self.fit, step.effect, self.context)
        separation = state.separation(step.effect, change)
        close = {name for name, s in separation.items() if s < self.policy.separation} | set(step.equivalent)
        close -= {other.effect for other in self.steps}
        effect = self.fit.model.instrument(self.fit.values).effect(step.effect)
        standard = np.asarray(values_of(effect.standard_form())) if not effect.kind.is_structural() else ()
        parameters = {}
        for i, value in zip(self.fit.model.positions(step.effect), standard, strict=True):
            p = self.fit.model.parameters[i]
            label = p.name.removeprefix(f"{step.effect}.")
            parameters[label] = (float(value), float(self.fit.sigma[i]), p.unit)
        return dataclasses.replace(
            step,
            parameters=parameters,
            told=told(self.fit) if step.effect == Described.name else (),
            far=beyond_prior(self.fit, step.effect),
            choices=spoken_choices(effect),
            robust_ratio=state.design.robust_ratio(step.effect),
            equivalent=tuple(sorted(close, key=lambda name: (separation.get(name, np.inf), name))),
            separation=separation,
            separated_by=effect.kind.separated_by if close or step.nameless else "",
            where=describe(state.design, change),
        )


# -------------------------------------------------------------------------------------------- without a name


def unexplained(state: Examination, patterns: tuple[tuple[str, float], ...]) -> Unexplained:
    """Remainder of an examination without a name: its patterns, and where the residuals sit."""
    if not state.alarm:
        ratio = state.chi2 / state.dof
        text = f"residuals scatter more than N_ERR says (χ²/dof = {ratio:.3g}) without a known pattern"
    elif patterns:
        text = f"unidentified patterns: {'; '.join(f'{name} (p = {p:.1g})' for name, p in patterns)}"
    else:
        text = "something is missing, but no single pattern is significant by itself"
    leading = [*state.significant[:1], *state.significant_sentences[:1]] if state.alarm else []
    if leading:
        nearest = max(leading, key=lambda item: item.log_bayes)
        p = state.table.corrected(nearest.score)
        text += f". Nearest comes '{nearest.probe.name}' (p = {p:.1g}), which was not confirmed"
    where = describe(state.design, state.design.residual)
    words = {"cameras": "camera", "kinds": "kind", "field": "field"}
    words |= {prefix: prefix for prefix in state.design.measured.likelihood.plan.moving}
    told = (f"{name} {where[key]}" for name, key in words.items() if where.get(key) is not None)
    text += f". Residuals sit in: {'; '.join(told)}"
    return Unexplained(state.table.p_global, text, patterns)


_LEFT_OUT = (
    "a free-form term was left out: it does not predict settings and field points that it was not fitted to"
)


def _and(found: Unexplained, text: str) -> Unexplained:
    return dataclasses.replace(found, description=f"{found.description}. {text}")

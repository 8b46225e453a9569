"""The workflow: alarm, name, addition, until the data are explained or what is left has no name.

1. Fit the model. 2. Score every effect of the catalogue and every pattern of the free-form basis; global p by Monte
Carlo. 3. Below `ALARM`: refit the leaders and take the one with the highest evidence that data which took no part in
the fit confirm, provided that it is significant after correction for all that was tried. A sentence (`grammar`) that
is more probable than every name is added in their place, as effect `described`; what patterns without a name explain
better is not added at all. Other descriptions of the instrument (`choices`) compete with the names where the model is
badly off, or no name is found. 4. It joins the model, and everything is fitted again. 5. Repeat. 6. Drop names that are
not needed beside the others. 7. What no name explains is added as a free-form term, labelled, and the verdict is
`unexplained`; names that only stood in for it are dropped as well. 8. List for each name what the data cannot tell from
it, and give the verdict. Names are given at any size; `Step.negligible` says when it does not matter for q and u.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar, history, location, naming
from walop_jax.diagnosis.change_of_stokes import instrument_matrices, largest_change
from walop_jax.diagnosis.choices import Choices
from walop_jax.diagnosis.design import Design, held_out
from walop_jax.diagnosis.effect_columns import Probe, applicable
from walop_jax.diagnosis.effect_columns import probes as all_probes
from walop_jax.diagnosis.examination import Examination, most_points
from walop_jax.diagnosis.findings import Choice, Diagnosis, Outcome, Step, Unexplained
from walop_jax.diagnosis.mixups import SURE, mixups_of, refusal
from walop_jax.diagnosis.score import Score
from walop_jax.diagnosis.step_summary import before_and_after, refitted_in_order
from walop_jax.diagnosis.telling import told, too_many_sentences, unexplained
from walop_jax.fit.model_builder import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.fit.stand_in import in_field_points
from walop_jax.likelihood import limits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.thinning import thinned
from walop_jax.model.compiled import forget_programs
from walop_jax.model.effects import EFFECTS, Context, Described, Effect, FreeForm, OtherDescription
from walop_jax.model.parameters import values_of
from walop_jax.model.specification import Model, effect_context

MOST_STEPS = 6
MOST_SENTENCES = 2  # that are refitted at a time; more than can be one thing that a sentence holds
LEAST_EVIDENCE = 1.0  # ln B that an effect must be worth to the final model to stay in it
MINUTES = 20.0  # after which no further name is sought
POOR_FIT = 1.5  # χ²/dof above which effects that cannot be differentiated are tried
_SMALL = 200  # field points up to which programs of earlier models may stay: half a gigabyte


def diagnose(
    calset: CalibrationSet,
    model: Model | None = None,
    *,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    seed: int = 0,
    minutes: float = MINUTES,
    as_written: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what `model` (default: the base model) lacks to explain a calibration set.

    `catalogue` are the effects that may be named. Of a set with more than `limits.DIAGNOSED_ROWS` (exposure, point)
    pairs, or whose columns would be more than `limits.DIAGNOSED_NUMBERS`, points spread over the field are looked at.
    The search for a further name, or for a free-form term, does not begin after `minutes`; what is left then has no
    name. Other readings of the data are not tried where the caller has done that already (`as_written`). Raises what
    `fit` raises, and `DataError` for data that another reading explains (`mixups`).
    """
    began = time.perf_counter()
    tell = progress or (lambda text: None)
    model = model or base_model(calset)
    calset = in_field_points(calset, model, tell)
    context = effect_context(model.template, calset.exposures)
    every = grammar.sentences(model.template, calset.exposures, len(calset.points))
    amplitudes = sum(len(probe.widths) for probe in (*all_probes(tuple(catalogue), context), *every))
    some = thinned(calset, most_points(calset, model.template, amplitudes), neighbours=1)
    if len(some.points) < len(calset.points):
        tell(f"looking at {len(some.points)} of {len(calset.points)} field points")
    until = began + 60.0 * minutes
    found = _Diagnosing(some, model, catalogue, every, seed, tell, until, as_written=as_written).run(began)
    return dataclasses.replace(found, points=len(calset.points))


def _promise(choice: Choice) -> tuple[float, float]:
    """What other descriptions are sorted by: the gain where it is known, then what is left."""
    return (-choice.better_by if np.isfinite(choice.better_by) else np.inf), choice.left


class _Diagnosing:
    """The state of one diagnosis: the current fit and the steps so far."""

    def __init__(
        self,
        calset: CalibrationSet,
        model: Model,
        catalogue: Sequence[type[Effect]],
        sentences: Sequence[Probe],
        seed: int,
        tell: Callable[[str], None],
        until: float,
        *,
        as_written: bool = False,
    ) -> None:
        self.calset, self.tell, self.until = calset, tell, until
        self.rng = np.random.default_rng(seed)
        self.context: Context = effect_context(model.template, calset.exposures)
        self.catalogue = applicable(catalogue, self.context, model.template)
        self.wanted: list[Probe] = list(all_probes(self.catalogue, self.context))
        every = sentences, self.catalogue, self.context, model.template
        self.sentences = history.uncovered(*every)
        self.parts = history.parts(*every)
        self.steps: list[Step] = []
        self.added = self.said = 0
        self.choices: dict[str, Choice] = {}
        tell("fitting the model")
        self.fit: FitResult = fit(Likelihood.of(calset, model))
        self.readings = () if as_written else mixups_of(self.fit)
        if self.readings and self.readings[0].explained < SURE:
            raise refusal(self.fit, self.readings)

    def run(self, began: float) -> Diagnosis:
        before = self.fit
        self.tell("scoring every effect and pattern")
        first = self._examine()
        examination, nameless = self._conclude(first, self._add_names(first))
        nameless = nameless or self._too_many_sentences(examination)
        # Another reading that comes near competes with names and with other descriptions of the instrument.
        if nameless and self.readings and self.readings[0].explained * self.fit.dof < self.fit.chi2:
            raise refusal(before, self.readings)
        steps = tuple(self._finished(step, examination) for step in self.steps)
        verdict: Outcome = "unexplained" if nameless else "effect_found" if steps else "consistent"
        return Diagnosis(
            verdict=verdict,
            steps=steps,
            candidates=first.summary(),
            limits=tuple(examination.limits()),
            untestable=first.untestable(self.catalogue),
            unexplained=nameless,
            p_value=first.table.p_global,
            remaining_p=examination.table.p_global,
            noise_scale=self.fit.noise_scale * examination.table.noise_scale,
            noise_p=examination.noise_p,
            before=before,
            after=self.fit,
            seconds=time.perf_counter() - began,
            points=len(self.calset.points),
            choices=tuple(sorted(self.choices.values(), key=_promise)),
            classes=tuple(first.classes()),
        )

    def _examine(self, earlier: Examination | None = None) -> Examination:
        forgetting = earlier is not None and len(self.calset.points) > _SMALL
        if forgetting:
            forget_programs()  # of models with fewer effects: they are not asked for again
        found = Examination(self.fit, self.wanted, self.rng, earlier, self.sentences, self.parts)
        if forgetting:
            forget_programs()  # of columns
        return found

    # ------------------------------------------------------------------------------------------------ a name

    def _add_names(self, examination: Examination) -> Examination:
        """Add names until nothing is missing or none is found; the examination of what they leave."""
        while examination.alarm and self.added < MOST_STEPS and self._time_left():
            self.tell(f"p = {examination.table.p_global:.2g}: something is missing; trying names")
            poor = self.fit.chi2 > POOR_FIT * self.fit.dof
            redescribed = any(step.effect == OtherDescription.name for step in self.steps)
            every = poor and (redescribed or not self.steps)
            added = self._add_best(examination, self._trials(examination), others=every)
            if added is None and not every:
                added = self._add_best(examination, iter(()), others=True)
            if added is None:
                break
            self.added += 1
            self.said += added == Described.name
            self.tell(f"added {added}; scoring what is left")
            examination = self._examine(examination)
        return examination

    def _time_left(self) -> bool:
        return time.perf_counter() < self.until

    def _trials(self, examination: Examination) -> Iterator[naming.Trial]:
        for item in naming.leaders(examination.significant) if examination.significant else ():
            if not self._time_left():
                return
            self.tell(f"trying {item.effect.name}")
            shapes = sum(probe.effect is item.effect for probe in examination.probes)
            yield naming.try_shapes(self.fit, item, self.context, shapes)
        yield from self._sentences(examination)
        if self.fit.chi2 > POOR_FIT * self.fit.dof:
            for effect in self.catalogue:
                if effect.is_structural() and effect.name not in self.fit.model.effect_names:
                    self.tell(f"trying {effect.name}")
                    yield naming.try_effect(self.fit, effect.neutral(self.context), self.context)

    def _sentences(self, examination: Examination) -> Iterator[naming.Trial]:
        """Sentences that are more probable than every name, by linear steps."""
        for item in examination.sentences_before_names()[:MOST_SENTENCES]:
            if self._time_left():
                self.tell(f"trying {item.probe.name}")
                said, count = naming.shortest(item), len(examination.sentences)
                yield naming.try_sentences(self.fit, said, self.context, count)

    def _other_descriptions(self) -> Iterator[naming.Trial]:
        """The instrument described otherwise; what was tried is kept."""
        choices = Choices(self.fit, self.context, self._time_left, self.tell)
        yield from choices.trials()
        self.choices |= choices.tried

    def _add_best(
        self, examination: Examination, names: Iterator[naming.Trial], *, others: bool
    ) -> str | None:
        """Add the name with the highest evidence that held-out data confirm; None when there is none.

        `others`: descriptions compete with the names.
        """
        trials = [
            t
            for t in itertools.chain(names, self._other_descriptions() if others else ())
            if t.fit.converged and examination.is_worth_telling(t)
        ]
        trials = self._decided(sorted(trials, key=naming.names_first))
        for trial in trials:
            step = self._step(examination, *naming.with_rivals(trial, trials))
            if step.confirmed:
                # A further change of the description joins those before.
                earlier = next((s for s in self.steps if s.effect == step.effect), None)
                self.steps = [*(s for s in self.steps if s is not earlier), step]
                self._adopt(trial.fit)
                if self.fit is not trial.fit:
                    compared = before_and_after(step.effect, examination.design, Design.of(self.fit))
                    self.steps[-1] = dataclasses.replace(step, **compared)
                if earlier is not None:
                    self.steps[-1] = dataclasses.replace(
                        self.steps[-1],
                        chi2_before=earlier.chi2_before,
                        heldout_before=earlier.heldout_before,
                        residual_before=earlier.residual_before,
                    )
                return step.effect
        return None

    def _decided(self, trials: list[naming.Trial]) -> list[naming.Trial]:
        """Trials in order of evidence; what scaled errors leave even at the top is decided with errors as stated."""
        even = [t for t in trials if trials[0].log_bayes - t.log_bayes < naming.EVEN_ODDS]
        if self.fit.noise_scale == 1.0 or len(even) < 2:
            return trials
        refitted = [
            dataclasses.replace(t, fit=fit(t.fit.likelihood, start=t.fit.values, noise_scale=1.0))
            for t in even
        ]
        refitted.sort(key=lambda t: t.fit.posterior.objective)
        best = refitted[0].fit.posterior.objective
        clearly = [
            dataclasses.replace(t, log_bayes=t.log_bayes - 0.5 * (t.fit.posterior.objective - best))
            for t in refitted
        ]
        return [*clearly, *trials[len(even) :]]

    def _adopt(self, result: FitResult) -> None:
        """Go on with a fit: errors as given where they need not be scaled any more, refuted priors widened."""
        if result.noise_scale > 1.0:
            result = fit(result.likelihood, start=result.values)
        model = result.model
        for step in self.steps:
            model = naming.with_refuted_priors_widened(model, result.values, step.effect)
        if model is not result.model:
            result = fit(Likelihood.of(self.calset, model), start=result.values)
        self.fit = result

    def _step(self, examination: Examination, trial: naming.Trial, close: tuple[str, ...]) -> Step:
        name = trial.effect.name
        score: Score | None = next((r.score for r in examination.ranked if r.effect is trial.effect), None)
        return Step(
            effect=name,
            parameters={},
            score=score.statistic if score else examination.result.chi2 - trial.fit.chi2,
            p_value=examination.table.corrected(score) if score else examination.table.p_global,
            log_bayes=trial.log_bayes,
            nameless=examination.nameless(trial),
            equivalent=tuple(dict.fromkeys((*close, *examination.held_in_part(trial)))),
            alternatives=trial.alternatives,
            **before_and_after(name, examination.design, Design.of(trial.fit)),
        )

    # --------------------------------------------------------------------------------------- what has no name

    def _unexplained(self, examination: Examination) -> Unexplained:
        patterns = tuple(examination.patterns_needed())
        found = unexplained(examination, patterns)
        blocks = tuple(
            dict.fromkeys(b for name, _ in patterns if (b := examination.blocks[name]) is not None)
        )
        there = FreeForm.name in self.fit.model.effect_names
        if len(self.calset.exposures) > limits.FREE_EXPOSURES:
            blocks = tuple(block for block in blocks if block != "exposures")
        ready = bool(blocks) and not there and self._time_left()
        return self._with_free_form(examination, found, blocks) if ready else found

    def _too_many_sentences(self, examination: Examination) -> Unexplained | None:
        """Something that no sentence holds looks like several that are there."""
        if self.said <= MOST_SENTENCES:
            return None
        return too_many_sentences(examination, self.said)

    def _with_free_form(
        self, examination: Examination, found: Unexplained, blocks: tuple[str, ...]
    ) -> Unexplained:
        """Add a free-form term for patterns without a name, so that the calibration improves all the same.

        It need not be probable, only useful: it stays when it predicts parts of the field that it has not seen.
        """
        term = FreeForm.of(self.context, blocks=blocks)
        trial = naming.try_effect(self.fit, term, self.context)
        if not trial.fit.converged:
            return found
        without, with_term = (
            held_out(design, "field blocks").mean for design in (examination.design, Design.of(trial.fit))
        )
        if with_term >= without:
            return found
        before = self.fit
        self._adopt(trial.fit)
        change = largest_change(instrument_matrices(before), instrument_matrices(self.fit))
        return dataclasses.replace(
            found, term=blocks, chi2_before=before.chi2, chi2_after=self.fit.chi2, change_of_qu=change
        )

    # ---------------------------------------------------------------------------------------------- the end

    def _conclude(
        self, first: Examination, examination: Examination
    ) -> tuple[Examination, Unexplained | None]:
        """Drop what is not needed, then ask what has no name: the examination of the final model, and that."""
        dropped = self._drop_what_is_not_needed()
        while True:
            if dropped:
                examination = self._examine(first)
                self.steps = refitted_in_order(self.steps, first.design, examination.design)
            # Errors that are a few per cent too small are no effect: nothing but their size is wrong.
            if not examination.alarm and (self.fit.explains_data or self.fit.nearly_explains_data):
                return examination, None
            self.tell("something without a name is left")
            nameless = self._unexplained(examination)
            if not nameless.term:
                return examination, nameless
            dropped = self._drop_what_is_not_needed()
            if not dropped:
                return self._examine(examination), nameless
            # Those names only stood in for what has none: what is it without them?
            self._adopt(naming.refit_without(self.fit, FreeForm.name))

    def _drop_what_is_not_needed(self) -> bool:
        """Take out, one by one, names that the final model does not need; whether there were any."""
        dropped = False
        while self.steps and len(self.fit.model.template.effects) > 1:
            worth = {
                s.effect: naming.evidence_of_presence(self.fit, s.effect, self.context) for s in self.steps
            }
            least = min(worth, key=lambda name: worth[name])
            if worth[least] >= LEAST_EVIDENCE:
                break
            self.tell(f"{least} is no longer needed")
            self.steps = [s for s in self.steps if s.effect != least]
            self._adopt(naming.refit_without(self.fit, least))
            dropped = True
        return dropped

    def _finished(self, step: Step, examination: Examination) -> Step:
        """The step with final parameters, what cannot be told from it, and where it sits."""
        change = naming.signature(self.fit, step.effect, self.context)
        separation = examination.separation(step.effect, change)
        close = {name for name, s in separation.items() if s < naming.SEPARATION} | set(step.equivalent)
        close -= {other.effect for other in self.steps}
        effect = self.fit.model.instrument(self.fit.values).effect(step.effect)
        standard = np.asarray(values_of(effect.standard_form())) if not type(effect).is_structural() else ()
        parameters = {}
        for i, value in zip(self.fit.model.positions(step.effect), standard, strict=True):
            p = self.fit.model.parameters[i]
            label = p.name.removeprefix(f"{step.effect}.")
            parameters[label] = (float(value), float(self.fit.sigma[i]), p.unit)
        return dataclasses.replace(
            step,
            parameters=parameters,
            told=told(self.fit) if step.effect == Described.name else (),
            far=naming.beyond_prior(self.fit, step.effect),
            choices=naming.spoken_choices(effect),
            robust_ratio=examination.design.robust_ratio(step.effect),
            equivalent=tuple(sorted(close, key=lambda name: (separation.get(name, np.inf), name))),
            separation=separation,
            separated_by=effect.separated_by if close or step.nameless else "",
            where=location.describe(examination.design, change),
        )

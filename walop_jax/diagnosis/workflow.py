"""The workflow: fit, examine, and while something is missing search for its name; then what remains.

1. Fit the model. 2. Score every effect of the catalogue, every description (`grammar`) and every pattern without a
name; global p by Monte Carlo. 3. Below `thresholds.ALARM`: add names one after the other (`search`), each fitted
together with everything before it is added (`refits`). 4. Drop names that are not needed beside the others. 5. Names
that leave a poor fit nearly as poor are reported as parts of the missing effect, and taken out again. 6. What no name
explains is described, and the verdict is `unexplained`. A free-form term for it stays in the model if it predicts
held-out settings and parts of the field; names that only imitated it are dropped (`remainder`). 7. List for each name
what the data cannot separate from it, and give the verdict. An effect is named however small it is; `Step.negligible`
is True if it does not matter for q and u.

Work is limited by the number of fits, so that the answer does not depend on how busy the machine is. With `minutes` the
search ends when they are over, with the best that was found so far and a note that says so.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from walop_jax.data.joined_cells import joined_cells
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.class_product import Questions, only_a_class, with_average
from walop_jax.diagnosis.discrepancy import ambiguities
from walop_jax.diagnosis.discrete import causes_before_a_fit, causes_of, refusal
from walop_jax.diagnosis.exact import Trial, beyond_prior, signature, spoken_choices
from walop_jax.diagnosis.examination import Examination, most_points
from walop_jax.diagnosis.findings import (
    Diagnosis,
    DiagnosisVerdict,
    Step,
    Unexplained,
    describe,
    descriptions_of,
)
from walop_jax.diagnosis.grammar import hypotheses
from walop_jax.diagnosis.held_errors import fits_errors, held_closer, with_errors_free, with_errors_held
from walop_jax.diagnosis.hypotheses import Hypotheses
from walop_jax.diagnosis.readings import Alternative
from walop_jax.diagnosis.refits import Refits
from walop_jax.diagnosis.remainder import (
    beside_conditions,
    concluded,
    instead_of_a_search,
    rival_conditions,
    wrong_number,
)
from walop_jax.diagnosis.search import State, search, too_many_descriptions
from walop_jax.diagnosis.stated_conditions import Singles, condition_scores
from walop_jax.diagnosis.trust import Diagnosed, examined
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import NEARLY, FitResult, fit, with_empirical_covariance
from walop_jax.fit.verdict import Quality
from walop_jax.io.progress import Stage
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described, Effect, EffectKind, in_a_sentence
from walop_jax.model.effects.in_models import effect_context, known_effects
from walop_jax.model.parameters import values_of
from walop_jax.model.specification import Model


def diagnose(
    calset: CalibrationSet,
    model: Model | None = None,
    *,
    catalogue: Sequence[EffectKind] | None = None,
    seed: int = 0,
    minutes: float | None = None,
    as_written: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what `model` (default: the base model) lacks to explain a calibration set.

    `catalogue` are the effects that may be named (default: those of the model). Of a set with more than
    `limits.DIAGNOSED_ROWS` (exposure, point) pairs, or whose columns would be more than `limits.DIAGNOSED_NUMBERS`,
    only a sample is used: points spread over the field, or cells of whole frames joined to larger ones. Nothing further
    is tried after `thresholds.MOST_FITS` fits of additions (fewer where the model is far from the data), nor after
    `minutes`, if given; what is left then has no name, and `Diagnosis.caution` says so. The fit after the additions
    is examined, and the fit before them unless its χ² contradicts it. With `as_written` no other reading of the data is
    tried: the caller has done that. Raises what `fit` raises, and `DataError` for data that another reading explains
    (`readings`).
    """
    began = time.perf_counter()
    tell = progress or (lambda text: None)
    model = model or base_model(calset)
    catalogue = known_effects(model) if catalogue is None else catalogue
    candidates = hypotheses(catalogue, model.template, calset.exposures, len(calset.points))
    most = most_points(calset, model.template, candidates.amplitudes)
    if calset.fine is None:
        sample = thinned(calset, most, neighbours=1)
        what = "looking at {} of {} field points"
    else:
        sample = joined_cells(calset, most)
        what = "looking at {} field points, joined from {} cells"
    if sample is not calset:
        tell(what.format(len(sample.points), len(calset.points)))
    tell(Stage("fitting the model", "fitting"))
    context = effect_context(model.template, sample.exposures)
    structural = [effect.neutral(context) for effect in candidates.effects if effect.is_structural()]
    # Amplitudes mean nothing where the model is far off: causes without an amplitude are tried first.
    left, causes = (np.nan, ()) if as_written else causes_before_a_fit(sample, model, structural, tell)
    if causes and causes[0].of_data and causes[0].explained < NEARLY:
        raise refusal(left, causes)
    judge = Refits(
        hypotheses=candidates,
        rng=np.random.default_rng(seed),
        tell=tell,
        minutes=np.inf if minutes is None else minutes,
        began=began,
    )
    quiet = dataclasses.replace(judge, tell=lambda text: None)
    held = with_errors_held(Likelihood.of(sample, model), quiet.examined)
    found = _searched(fit(Likelihood.of(sample, held)), judge, causes, structural, as_written=as_written)
    free = with_errors_free(found.state.evidence.result, model)
    if found.state.steps and (better := held_closer(found.state.evidence, free, model)) is not None:
        tell(Stage("errors of the data are better known with what was found: once more", "scoring"))
        found = _searched(
            fit(Likelihood.of(sample, better)), judge, causes, structural, as_written=as_written
        )
        free = with_errors_free(found.state.evidence.result, model)
    before, first, state, remainder, conditions, judge = found
    del found  # it holds the columns of all candidates
    if fits_errors(model) and remainder is None:  # else what is left would be taken for noise
        state = judge.adopt(state, free, state.steps)
        before = before if state.steps else state.evidence.result
    after, evidence, added = state.evidence.result, state.evidence, [step.effect.name for step in state.steps]
    steps = tuple(_finished(step, evidence, added) for step in state.steps)
    verdict: DiagnosisVerdict = "effect_found" if steps else "consistent"
    if remainder is not None:
        verdict = "wrong_number" if remainder.number else "unexplained"
    tell("examining the residuals")
    diagnosis = Diagnosis(
        verdict=verdict,
        steps=steps,
        candidates=first.evidence.summary(),
        limits=tuple(evidence.limits()),
        untestable=first.evidence.untestable(candidates.effects),
        unexplained=remainder,
        p_value=first.evidence.table.p_global,
        remaining_p=evidence.table.p_global,
        noise_scale=after.noise_scale * evidence.table.noise_scale,
        noise_p=evidence.noise_p,
        before=before,
        after=after,
        seconds=time.perf_counter() - began,
        points=len(calset.points),
        # by the gain where it is known, then by the remaining χ²
        choices=tuple(
            sorted(state.choices.values(), key=lambda c: (-np.nan_to_num(c.better_by, nan=-np.inf), c.left))
        ),
        classes=tuple(first.evidence.classes()),
        ended=state.ended or (judge.over(state.fits) if remainder else ""),
        members=_members(first, state, steps),
        rounds=state.rounds,
        not_scored=_not_scored(catalogue, candidates, first.evidence.synonyms),
        descriptions=len(candidates.descriptions) + len(candidates.parts),
    )
    of_fits = (
        Diagnosed(first.evidence.design, first.evidence.table),
        Diagnosed(evidence.design, evidence.table, beyond_remedy=too_many_descriptions(state)),
    )
    rivals = () if after is before else tuple(rival_conditions(first.evidence.design, conditions, after.chi2))
    del first, state, evidence  # the columns of all candidates, gigabytes of a large set
    return _examined(diagnosis, of_fits, rivals, seed)


class _Searched(NamedTuple):
    """A fit, its examination, what was found beside it and what remains.

    `conditions` are the scores of the numbers that the set states, `judge` that of the search.
    """

    before: FitResult
    first: State
    state: State
    remainder: Unexplained | None
    conditions: Singles
    judge: Refits


def _searched(
    before: FitResult,
    judge: Refits,
    causes: tuple[Alternative, ...] | None,
    structural: Sequence[Effect],
    *,
    as_written: bool,
) -> _Searched:
    """What a fit lacks; `causes` are those that were found ahead of it (None: they were not looked for).

    Raises `DataError` for data that another reading explains.
    """
    far_off = before.noise_scale > 1.0
    if causes is None or not (far_off or any(cause.number for cause in causes)):
        causes = () if as_written else causes_of(before, structural, judge.tell, descriptions=True)
    number = causes[0].number if causes else ""
    left = before.chi2 / max(before.dof, 1)
    if causes and causes[0].of_data and (far_off or causes[0].explained < NEARLY):
        raise refusal(left, causes)
    if far_off:
        judge = dataclasses.replace(judge, most=thresholds.MOST_FITS_FAR_OFF)
    judge.tell(Stage("scoring every effect and pattern", "scoring"))
    first = State(judge.examined(before))
    conditions = condition_scores(first.evidence.design) if far_off and not number else Singles()
    if number:
        remainder = wrong_number(first, number)
    else:
        remainder = instead_of_a_search(first, conditions) if not causes else None
    if remainder is None:
        begun = judge.with_causes(first, causes[0].effects if causes else ())
        state, remainder = concluded(first, search(begun, judge), judge)
    else:
        state = first
    explained = state.evidence.result
    # Names left a remainder: a cause that leaves less (another reading, say) is then the answer.
    if remainder and causes and not number and causes[0].explained * explained.dof < explained.chi2:
        raise refusal(left, causes)
    if not conditions.items and (state.steps or remainder):
        conditions = condition_scores(first.evidence.design)
    if remainder is None or not remainder.number:
        state, remainder = beside_conditions(first, state, remainder, conditions)
    return _Searched(before, first, state, remainder, conditions, judge)


def _members(first: State, state: State, steps: Sequence[Step]) -> Questions:
    """Candidates that the data cannot distinguish from the additions, and their effect on stars."""
    alike = dict[str, Collection[str]]()
    # A single group has the rivals of the final model as well; of several groups these are rivals of all together.
    for trial, step in zip(state.steps, steps, strict=True):
        names = tuple(trial.groups) or (step.effect,)
        alone = {*step.equivalent, *step.nameless} - {Described.name}
        alike |= {names[0]: alone} if len(names) == 1 else trial.groups
    effects = first.evidence.result.model.template.effects
    given = [text for e in effects if isinstance(e, Described) for text in e.sentences]
    return ambiguities(state.evidence, alike, given)


def _examined(
    diagnosis: Diagnosis, of_fits: Sequence[Diagnosed], rivals: Sequence[str], seed: int
) -> Diagnosis:
    """A diagnosis with the verdicts on its fits, and the remarks on `rivals` of its names.

    `of_fits` is what was found of the fit before, and of the fit after the additions.
    """
    result = with_empirical_covariance(diagnosis.after)
    after = examined(result, seed, as_written=True, diagnosed=of_fits[1])
    for sentence in only_a_class(diagnosis.members):
        after = after.with_doubt(Quality.CLASS_ONLY, sentence)
    after = with_average(after, diagnosis.members)
    if diagnosis.before is diagnosis.after:
        return dataclasses.replace(diagnosis, before=after, after=after)
    for sentence in rivals:
        after = after.with_remark(sentence)
    before = diagnosis.before
    # If χ² contradicts the given model, its residuals are not examined: the steps name the missing effects.
    explained = before.explains_data or before.nearly_explains_data
    before = (
        examined(before, seed, as_written=True, diagnosed=of_fits[0]) if explained else before.with_verdict()
    )
    return dataclasses.replace(diagnosis, before=before, after=after)


def _not_scored(
    catalogue: Sequence[EffectKind], candidates: Hypotheses, also: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Everything that was not scored by itself, by name, each with the reason; `also` are names of other candidates."""
    probed = {probe.effect for probe in candidates.names}
    scored = {probe.name for probe in candidates.beside(())}
    absent = [kind.name for kind in catalogue if kind not in candidates.effects]
    reasons = dict.fromkeys(absent, "the instrument has nothing that it acts on")
    for effect in candidates.effects:
        if effect.is_structural():
            reasons[effect.name] = (
                f"it has no amplitude and no score: it is tried where χ²/dof is above {thresholds.POOR_FIT:g} and no "
                f"name explains all but 1/{thresholds.PART:g} of what is missing"
            )
        elif effect not in probed:
            reasons[effect.name] = "the exposures have nothing that it acts on"
    name = "it is an effect of the catalogue by another name"
    reasons |= {probe.name: name for probe in candidates.every if probe.name not in scored}
    return reasons | {
        other: f"in these data and in its effect on stars it is {called} by another name"
        for called, others in also.items()
        for other in others
    }


def _finished(trial: Trial, evidence: Examination, added: Sequence[str]) -> Step:
    """An addition with its final parameters, what cannot be separated from it, and where it sits."""
    result, name = evidence.result, trial.effect.name
    change = signature(result, name)
    separation = evidence.separation(name, change)
    close = {rival for rival, s in separation.items() if s < thresholds.SEPARATION} | set(trial.rivals)
    close -= set(added)
    effect = result.model.instrument(result.values).effect(name)
    standard = np.asarray(values_of(effect.standard_form())) if not effect.kind.is_structural() else ()
    parameters = {}
    for i, value in zip(result.model.positions(name), standard, strict=True):
        p = result.model.parameters[i]
        parameters[p.name.removeprefix(f"{name}.")] = float(value), float(result.sigma[i]), p.unit
    return Step(
        effect=name,
        parameters=parameters,
        log_bayes=trial.evidence,
        nameless=trial.nameless,
        also_called=trial.synonyms,
        about=_about(effect, result.model.template.cameras.names),
        probability=trial.probability,
        alternatives=trial.alternatives,
        score=trial.score,
        p_value=trial.p_value,
        **vars(trial.compared),
        descriptions=descriptions_of(result) if name == Described.name else (),
        far=beyond_prior(result, name),
        choices=spoken_choices(effect),
        robust_ratio=evidence.design.robust_ratio(name),
        equivalent=tuple(sorted(close, key=lambda rival: (separation.get(rival, np.inf), rival))),
        separation=separation,
        separated_by=effect.kind.separated_by if close or trial.nameless else "",
        where=describe(evidence.design, change),
    )


def _about(effect: Effect, cameras: Sequence[str]) -> str:
    """An effect in words, with its place: "a dark spot in front of one camera, O2"."""
    chosen = spoken_choices(effect)
    places = [str(cameras[value]) if name == "camera" else str(value) for name, value in chosen.items()]
    return ", ".join((in_a_sentence(effect.kind), *places))

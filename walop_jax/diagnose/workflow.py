"""The workflow: alarm, name, addition, until the data are explained or what is left has no name.

1. Fit the model. 2. Score every effect of the catalogue and every pattern of the free-form basis; global p by Monte
Carlo. 3. Below `ALARM`: refit the leaders, take the one with the highest evidence, provided that it is significant
after correction for all that was tried. 4. It joins the model, everything is fitted again, and data that took no part
in the fit must agree. 5. Repeat. 6. At the end: drop what is not needed, list for each name what the data cannot tell
from it, and give the verdict.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnose import naming, where
from walop_jax.diagnose.columns import Probe, effect_candidates
from walop_jax.diagnose.columns import probes as all_probes
from walop_jax.diagnose.design import Design, HeldOut, held_out
from walop_jax.diagnose.freeform import strata
from walop_jax.diagnose.score import Score, Scorer, ScoreTable
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.problem import Problem, base_model
from walop_jax.model.effects import EFFECTS, Context, Effect
from walop_jax.model.specification import Model, effect_context

ALARM = 0.01
MOST_STEPS = 6
Verdict = Literal["consistent", "effect_found", "unexplained"]
Progress = Callable[[str], None]
Cube = Float[np.ndarray, "p e 4"]


def _no_cube() -> Cube:
    return np.zeros((0, 0, 4))


@dataclasses.dataclass(frozen=True)
class Step:
    """One effect that was found, added and confirmed; `parameters` hold (value, sigma, unit).

    `residual_before`, `residual_after` and `signature` are in standard deviations, (point, exposure, camera): the
    residuals (data − model) without and with the effect at the time it was added, and the change that it makes to
    the residuals of the final model.
    """

    effect: str
    parameters: dict[str, tuple[float, float, str]]
    score: float
    p_value: float
    log_bayes: float
    chi2_before: float
    chi2_after: float
    heldout_before: HeldOut
    heldout_after: HeldOut
    equivalent: tuple[str, ...] = ()
    separation: dict[str, float] = dataclasses.field(default_factory=dict)
    separated_by: str = ""
    where: dict[str, Any] = dataclasses.field(default_factory=dict)
    residual_before: Cube = dataclasses.field(default_factory=_no_cube)
    residual_after: Cube = dataclasses.field(default_factory=_no_cube)
    signature: Cube = dataclasses.field(default_factory=_no_cube)

    @property
    def confirmed(self) -> bool:
        """Whether data that took no part in the fit agree better with the effect than without."""
        return self.heldout_after.mean < self.heldout_before.mean


@dataclasses.dataclass(frozen=True)
class Unexplained:
    """What is left and has no name."""

    p_value: float
    description: str
    patterns: tuple[tuple[str, float], ...]


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """What is missing from a model, according to one calibration set."""

    verdict: Verdict
    steps: tuple[Step, ...]
    candidates: tuple[
        tuple[str, float, float], ...
    ]  # effect, score, corrected p, of the last look at the base
    untestable: tuple[str, ...]
    unexplained: Unexplained | None
    p_value: float
    before: FitResult
    after: FitResult
    problem: Problem
    seconds: float


class _Look:
    """One look at a fit: its design, the scores of everything, and the names in order of evidence."""

    def __init__(
        self, problem: Problem, result: FitResult, wanted: Sequence[Probe], rng: np.random.Generator
    ) -> None:
        self.problem, self.result = problem, result
        active = {effect.name for effect in problem.model.template.effects}
        self.probes = [probe for probe in wanted if probe.effect.name not in active]
        self.design = Design.of(problem, result)
        named = effect_candidates(problem.calset, problem.model, result.values, self.probes)
        free = list(strata(self.design.measured))
        scorer = Scorer(self.design.projector, self.design.padded([*named.values(), *free]), rng)
        self.table: ScoreTable = scorer(self.design.residual)
        self.ranked = naming.rank(self.table, self.probes)
        self.patterns = [self.table[c.name] for c in free]

    @property
    def alarm(self) -> bool:
        """Whether anything is missing at all."""
        return self.table.p_global < ALARM

    def summary(self) -> tuple[tuple[str, float, float], ...]:
        """Effects with score and corrected p, most significant first."""
        rows = [(r.effect.name, r.score.statistic, self.table.corrected(r.score)) for r in self.ranked]
        return tuple(sorted(rows, key=lambda row: row[2]))

    def untestable(self, catalogue: Sequence[type[Effect]]) -> tuple[str, ...]:
        """Effects that these data cannot show at any plausible size."""
        seen = {r.effect.name for r in self.ranked}
        active = {effect.name for effect in self.problem.model.template.effects}
        return tuple(
            effect.name
            for effect in catalogue
            if effect.name not in seen | active and not effect.is_structural()
        )


def diagnose(
    calset: CalibrationSet,
    model: Model | None = None,
    *,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    seed: int = 0,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find what `model` (default: the base model) lacks to explain a calibration set.

    `catalogue` are the effects that may be named. Raises what `fit` raises.
    """
    began = time.perf_counter()
    tell = progress or (lambda text: None)
    rng = np.random.default_rng(seed)
    model = model or base_model(calset)
    context = effect_context(model.template, calset.exposures)
    wanted = list(all_probes(catalogue, context))
    problem = Problem(calset, model)
    tell("fitting the model")
    before = current = fit(problem)
    steps: list[Step] = []
    tell("scoring every effect and pattern")
    look = first = _Look(problem, current, wanted, rng)
    while look.alarm and len(steps) < MOST_STEPS:
        tell(f"p = {look.table.p_global:.2g}: something is missing; trying names")
        trial = _best_trial(look, context, catalogue)
        if trial is None:
            break
        steps.append(_step(look, trial))
        tell(f"added {trial.effect.name}")
        problem, current = trial.problem, trial.fit
        if current.noise_scale > 1.0:  # the errors were scaled to fit at all: perhaps no longer needed
            current = fit(problem, start=current.values)
        look = _Look(problem, current, wanted, rng)
    steps = [_finished(step, calset, current, look.design, context, wanted) for step in steps]
    unexplained = _unexplained(look) if look.alarm or not current.explains_data else None
    verdict: Verdict = "unexplained" if unexplained else "effect_found" if steps else "consistent"
    return Diagnosis(
        verdict=verdict,
        steps=tuple(steps),
        candidates=first.summary(),
        untestable=first.untestable(catalogue),
        unexplained=unexplained,
        p_value=first.table.p_global,
        before=before,
        after=current,
        problem=problem,
        seconds=time.perf_counter() - began,
    )


def _best_trial(look: _Look, context: Context, catalogue: Sequence[type[Effect]]) -> naming.Trial | None:
    """The effect with the highest evidence after a refit; None when no name is significant."""
    trials = []
    calset, base = look.problem.calset, look.result
    significant = [r for r in look.ranked if look.table.corrected(r.score) < ALARM]
    for item in naming.leaders(significant) if significant else ():
        shapes = sum(probe.effect is item.effect for probe in look.probes)
        trials.append(naming.try_effect(calset, base, naming.start_of(item), context, shapes))
    active = {effect.name for effect in look.problem.model.template.effects}
    if base.chi2 > 1.5 * base.dof:
        for effect in catalogue:
            if effect.is_structural() and effect.name not in active:
                trials.append(naming.try_effect(calset, base, effect.neutral(context), context))
    trials = [t for t in trials if t.fit.converged and t.log_bayes > 0]
    return max(trials, key=lambda t: t.log_bayes, default=None)


def _step(look: _Look, trial: naming.Trial) -> Step:
    name = trial.effect.name
    score: Score | None = next((r.score for r in look.ranked if r.effect is trial.effect), None)
    design = Design.of(trial.problem, trial.fit)
    per_exposure = any(np.size(getattr(e, f)) > 1 for e in trial.problem.model.template.effects if e.name == name
                       for f in e.amplitudes())  # fmt: skip
    scheme = "field blocks" if per_exposure else "exposures"
    return Step(
        effect=name,
        parameters={},
        score=score.statistic if score else look.result.chi2 - trial.fit.chi2,
        p_value=look.table.corrected(score) if score else 0.0,
        log_bayes=trial.log_bayes,
        chi2_before=look.result.chi2,
        chi2_after=trial.fit.chi2,
        heldout_before=held_out(look.design, scheme),
        heldout_after=held_out(design, scheme),
        residual_before=look.design.cube(look.design.residual),
        residual_after=design.cube(design.residual),
    )


def _finished(
    step: Step,
    calset: CalibrationSet,
    final: FitResult,
    design: Design,
    context: Context,
    wanted: Sequence[Probe],
) -> Step:
    """The step with final parameters, what cannot be told from it, and where it sits."""
    active = {effect.name for effect in final.model.template.effects}
    rivals = [probe for probe in wanted if probe.effect.name not in active]
    separation, change = naming.equivalents(calset, final, design, step.effect, context, rivals)
    close = sorted(
        (name for name, s in separation.items() if s < naming.SEPARATION), key=lambda n: separation[n]
    )
    effect = next(e for e in final.model.template.effects if e.name == step.effect)
    parameters = {
        p.name.removeprefix(f"{step.effect}."): (float(final.values[i]), float(final.sigma[i]), p.unit)
        for i, p in enumerate(final.model.parameters)
        if p.name.startswith(f"{step.effect}.")
    }
    return dataclasses.replace(
        step,
        parameters=parameters,
        equivalent=tuple(close),
        separation=separation,
        separated_by=effect.separated_by if close else "",
        where=where.describe(design, change),
        signature=design.cube(change),
    )


def _unexplained(look: _Look) -> Unexplained:
    best = sorted((s for s in look.patterns if s.testable), key=lambda s: s.log_p)[:3]
    patterns = tuple((s.name, look.table.corrected(s)) for s in best)
    significant = [f"{name} (p = {p:.1g})" for name, p in patterns if p < ALARM]
    if not look.alarm:
        text = (
            f"residuals scatter more than N_ERR says (χ²/dof = {look.result.chi2 / look.result.dof:.3g}) "
            "without any pattern that was looked for"
        )
    elif significant:
        text = "patterns without a name: " + "; ".join(significant)
    else:
        text = "something is missing, no single pattern is significant by itself"
    place = where.describe(look.design, look.design.residual)
    text += f". Residuals sit in: cameras {place['camera']}; kinds {place['kind']}; field {place['field']}"
    return Unexplained(look.table.p_global, text, patterns)

"""The name: refits of the leading candidates, their evidence, and who cannot be told from whom.

Evidence       Laplace: ln B = ½ (O_base − O_g) − ½ (ln det H_g − ln det H_base) − Σ ln w, with O the objective (χ² of
               data and priors), H half its Hessian and w the prior widths of the added parameters.
Equivalence    The change D of the residuals that the named effect makes, projected off the other parameters, is fitted
               by each rival; the length of what the rival cannot follow is the separation in standard deviations
               (Atkinson & Fedorov 1975, Biometrika 62, 57). Below `SEPARATION` the data cannot tell the two apart, nor
               when the evidence of their refits differs by less than `IMPROBABLE`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.diagnosis.effect_columns import Probe
from walop_jax.diagnosis.score import Score, ScoreTable, log_bayes
from walop_jax.fit.refit import PRIOR_EDGE, FitResult, fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Context, Described, Effect
from walop_jax.model.parameters import leaves, values_of
from walop_jax.model.specification import Model, with_effects

SEPARATION = 3.0
MOST_LEADERS = 5
MOST_TOGETHER = 4  # sentences of a longer group that are tried by themselves
MOST_SHAPES = 4  # of one effect from which it is refitted
REFIT_WITHIN = 8.0  # ln B below the best within which a rival is refitted
LINEAR_BELOW = 150.0  # ln B above which the linear ranking is not trusted
EVEN_ODDS = 3.0  # difference in ln B that is no preference
IMPROBABLE = 6.9  # difference in ln B at which the other has a probability of 10⁻³


@dataclasses.dataclass(frozen=True)
class Ranked:
    """An effect with its best probe: evidence averaged over its alternative shapes; `others` may be as good."""

    effect: type[Effect]
    probe: Probe
    score: Score
    log_bayes: float
    others: tuple[tuple[Probe, Score], ...] = ()


@dataclasses.dataclass(frozen=True)
class Trial:
    """An effect that was added and refitted; `alternatives` are other shapes of it that do as well, in words."""

    effect: type[Effect]
    fit: FitResult
    log_bayes: float
    alternatives: tuple[str, ...] = ()

    @property
    def instance(self) -> Effect:
        """The effect at its fitted values, in standard form."""
        return self.fit.model.instrument(self.fit.values).effect(self.effect.name).standard_form()


def names_first(trial: Trial) -> float:
    """Order of trials: by evidence, but a sentence only where it is clearly more probable than a name."""
    return -trial.log_bayes + (EVEN_ODDS if trial.effect is Described else 0.0)


def rank(table: ScoreTable, probes: Sequence[Probe]) -> list[Ranked]:
    """Effects by evidence, best first; alternative shapes share the prior of their effect."""
    by_effect: dict[type[Effect], list[tuple[Probe, Score]]] = {}
    for probe in probes:
        by_effect.setdefault(probe.effect, []).append((probe, table[probe.name]))
    ranked = []
    for effect, shapes in by_effect.items():
        alive = [(p, s) for p, s in shapes if s.testable and follow_physics(p, s)]
        if not alive:
            continue
        alive.sort(key=lambda item: -item[1].log_bayes)
        (probe, score), best = alive[0], alive[0][1].log_bayes
        bayes = np.array([s.log_bayes for _, s in alive])
        mean = float(np.logaddexp.reduce(bayes) - np.log(len(shapes)))
        others = [
            item for item in alive[1:MOST_SHAPES] if item[1].log_bayes > best - max(REFIT_WITHIN, 0.2 * best)
        ]
        ranked.append(Ranked(effect, probe, score, mean, tuple(others)))
    return sorted(ranked, key=lambda item: -item.log_bayes)


def leaders(ranked: Sequence[Ranked]) -> list[Ranked]:
    """Candidates whose linear evidence is too close to the best to decide without a refit."""
    best = ranked[0].log_bayes
    reach = max(REFIT_WITHIN, 0.6 * best) if best > LINEAR_BELOW else REFIT_WITHIN
    return [item for item in ranked[:MOST_LEADERS] if item.log_bayes > best - reach]


def _log_determinant(result: FitResult) -> float:
    return float(np.linalg.slogdet(result.posterior.matrix)[1])


def log_evidence_ratio(base: FitResult, extended: FitResult) -> float:
    """Laplace evidence of an extended fit against the base (parameters without a prior carry no Occam factor)."""
    known = set(base.model.names)
    widths = [
        p.prior[1] if p.prior is not None else (p.loose or p.scale)
        for p in extended.model.parameters
        if p.name not in known and p.free and p.tie is None
    ]
    gain = 0.5 * (base.posterior.objective - extended.posterior.objective)
    occam = 0.5 * (_log_determinant(extended) - _log_determinant(base))
    return gain - occam - float(np.sum(np.log(widths)))


def try_effect(base: FitResult, instance: Effect, context: Context, prior_shapes: int = 1) -> Trial:
    """Add an effect at the given values to the fitted model and fit everything again."""
    return try_model(
        base, type(instance), with_effects(base.model, [instance], context), base.values, prior_shapes
    )


def try_sentences(base: FitResult, said: Described, context: Context, count: int) -> Trial:
    """Add sentences to the fitted model, beside those that it has, and fit again; they are among `count` of them."""
    model = base.model
    if Described.name in model.effect_names:
        earlier = model.instrument(base.values).effect(Described.name)
        assert isinstance(earlier, Described)
        said, model = earlier.joined(said), model_without(model, Described.name)
    return try_model(base, Described, with_effects(model, [said], context), base.values, count)


def shortest(item: Ranked) -> Described:
    """The sentences of a group that are worth their length, with the amplitudes of a linear step."""
    information = np.linalg.pinv(item.score.covariance, hermitian=True)
    scores, widths = information @ item.score.amplitudes, item.probe.widths
    members = range(len(widths))
    subsets = [
        list(some) for n in members for some in itertools.combinations(members, n + 1) if n < MOST_TOGETHER
    ] + [list(members)]
    worth = [log_bayes(information[np.ix_(some, some)], scores[some], widths[some]) for some in subsets]
    best = subsets[int(np.argmax(worth))]
    amplitudes = np.linalg.lstsq(information[np.ix_(best, best)], scores[best], rcond=None)[0]
    return Described.combine([item.probe.group[i] for i in best], amplitudes)


def try_model(
    base: FitResult, effect: type[Effect], model: Model, values: Float[np.ndarray, " n"], prior_shapes: int
) -> Trial:
    """Fit a model with an effect, from values of the parameters of the base and its own start values of others."""
    start = dict(zip(base.model.names, values, strict=True))
    likelihood = Likelihood.of(base.calset, model)
    result = fit(
        likelihood,
        start=np.array([start.get(p.name, p.start) for p in model.parameters]),
        noise_scale=base.noise_scale,
        worth=base.posterior.objective,
    )
    bayes = log_evidence_ratio(base, result) - (float(np.log(prior_shapes)) if prior_shapes > 1 else 0.0)
    return Trial(effect, result, bayes)


def try_shapes(base: FitResult, item: Ranked, context: Context, shapes: int) -> Trial:
    """Refit an effect from the amplitudes of its linear steps at the shapes that may be best, and keep the best."""
    places = ((item.probe, item.score), *item.others)
    trials = [
        try_effect(base, item.effect.combine(probe.group, score.amplitudes), context, shapes)
        for probe, score in places
    ]
    best = max(trials, key=lambda t: t.log_bayes if t.fit.converged else -np.inf)
    alike = [t for t in trials if t.fit.converged and t.log_bayes > best.log_bayes - EVEN_ODDS]
    told = dict.fromkeys(in_words(t.instance) for t in alike if _differ(t, best))
    return dataclasses.replace(best, alternatives=tuple(told))


def with_rivals(trial: Trial, trials: Sequence[Trial]) -> tuple[Trial, tuple[str, ...]]:
    """A trial with other shapes of its effect that are as probable, and the other effects that are not improbable."""
    apart = [(t, abs(t.log_bayes - trial.log_bayes)) for t in trials if t is not trial]
    same = [in_words(t.instance) for t, far in apart if t.effect is trial.effect and far < EVEN_ODDS]
    rivals = [t.effect.name for t, far in apart if t.effect is not trial.effect and far < IMPROBABLE]
    return dataclasses.replace(trial, alternatives=(*trial.alternatives, *same)), tuple(rivals)


def held_in_part(
    table: ScoreTable, parts: Sequence[tuple[Probe, Collection[type[Effect]]]], item: Ranked
) -> tuple[str, ...]:
    """Effects of which a part, by itself, is not improbable beside an item; parts share the prior of their effect."""
    count = Counter(effect for _, effects in parts for effect in effects)
    least = max(0.0, item.log_bayes - IMPROBABLE)
    return tuple(
        dict.fromkeys(
            effect.name
            for probe, effects in parts
            for effect in effects
            if effect is not item.effect
            and table[probe.name].testable
            and table[probe.name].log_bayes - float(np.log(count[effect])) > least
        )
    )


def _differ(one: Trial, other: Trial) -> bool:
    if one.instance.choices() != other.instance.choices():
        return True
    at = one.fit.model.positions(one.effect.name)
    sigma = np.maximum(one.fit.sigma[at], other.fit.sigma[at])
    away = np.asarray(values_of(one.instance)) - np.asarray(values_of(other.instance))
    return bool(np.any(np.abs(away) > SEPARATION * np.where(sigma > 0, sigma, np.inf)))


def in_words(effect: Effect) -> str:
    """Choices and values of an effect, e.g. "camera = 2, depth = 0.006"."""
    values = {
        leaf.name: f"{v:.4g}" for leaf, v in zip(leaves(effect), np.asarray(values_of(effect)), strict=True)
    }
    return ", ".join(f"{name} = {value}" for name, value in (spoken_choices(effect) | values).items())


def spoken_choices(effect: Effect) -> dict[str, Any]:
    """Discrete choices that mean something to a reader: a camera, a crystal, a star."""
    return {name: value for name, value in effect.choices().items() if isinstance(value, int | str)}


def follow_physics(probe: Probe, score: Score) -> bool:
    """Whether a linear step leaves one-sided amplitudes on their side, within `SEPARATION` standard deviations."""
    sigma = np.sqrt(np.clip(np.diag(score.covariance), 0.0, None))
    return bool(np.all((score.amplitudes >= -SEPARATION * sigma)[probe.one_sided]))


def amplitude_positions(model: Model, name: str) -> list[int]:
    """Positions of the free amplitudes of an active effect that have a prior."""
    effect = model.template.effect(name)
    at = [model.index(f"{name}.{label}") for f in effect.amplitudes() for label in effect.labels(f)]
    return [i for i in at if model.parameters[i].free and model.parameters[i].prior is not None]


def with_refuted_priors_widened(model: Model, values: Float[np.ndarray, " n"], name: str) -> Model:
    """The model in which amplitudes of an effect that lie far outside of their priors lie one width from the mean.

    A prior says how large such an effect usually is. One that the data refute would go on pulling at the value and
    count the square of its distance as a misfit, of data that are explained to within the noise.
    """
    for i in amplitude_positions(model, name):
        mean, width = model.parameters[i].prior  # type: ignore[misc]
        away = abs(float(values[i]) - mean)
        if away > PRIOR_EDGE * width:
            model = model.change(model.names[i], prior=(mean, away))
    return model


def beyond_prior(result: FitResult, name: str) -> dict[str, float]:
    """Amplitudes of an effect that lie beyond the prior of their declaration, widened or not, in its widths."""
    effect = result.model.template.effect(name)
    declared = {f"{name}.{leaf.name}": leaf.declaration.width for leaf in leaves(effect)}
    found = {}
    for i in amplitude_positions(result.model, name):
        p = result.model.parameters[i]
        widths = abs(float(result.values[i]) - p.prior[0]) / (declared[p.name] or np.inf)  # type: ignore[index]
        if widths > PRIOR_EDGE:
            found[p.name.removeprefix(f"{name}.")] = widths
    return found


def evidence_of_presence(result: FitResult, name: str, context: Context) -> float:
    """ln B of a fitted model against the one without an effect: the density that prior and posterior have at neutral.

    The Savage–Dickey ratio of nested models, Gaussian (Dickey 1971, Ann. Math. Stat. 42, 204). Infinite for an
    effect without parameters.
    """
    effect = result.model.template.effect(name)
    at = amplitude_positions(result.model, name)
    if not at:
        return float("inf")
    neutral = dict(
        zip(
            (f"{name}.{leaf.name}" for leaf in leaves(effect)),
            np.asarray(values_of(effect.at_neutral(context))),
            strict=True,
        )
    )
    away = result.values[at] - np.array([neutral[result.model.parameters[i].name] for i in at])
    width = np.array([result.model.parameters[i].prior[1] for i in at])  # type: ignore[index]
    covariance = result.covariance[np.ix_(at, at)] / np.outer(width, width)
    away = away / width
    return float(0.5 * away @ np.linalg.solve(covariance, away) + 0.5 * np.linalg.slogdet(covariance)[1])


def model_without(model: Model, name: str) -> Model:
    """The model with one effect taken out."""
    rest = tuple(effect for effect in model.template.effects if effect.name != name)
    own = model.positions(name)
    parameters = tuple(p for i, p in enumerate(model.parameters) if i not in own)
    template = dataclasses.replace(model.template, effects=rest)
    return dataclasses.replace(model, template=template, parameters=parameters)


def refit_without(result: FitResult, name: str) -> FitResult:
    """Take an effect out of a fitted model and fit again, with errors scaled only if what is left needs it."""
    model = model_without(result.model, name)
    start = dict(zip(result.model.names, result.values, strict=True))
    return fit(Likelihood.of(result.calset, model), start=np.array([start[n] for n in model.names]))


def signature(result: FitResult, name: str, context: Context) -> Float[np.ndarray, " _"]:
    """What an active effect does to the residuals (data rows): theirs without it, minus theirs with it."""
    effect = result.model.template.effect(name)
    if type(effect).is_structural():
        model = model_without(result.model, name)
        kept = [result.model.index(n) for n in model.names]
        bare = Likelihood.of(result.calset, model).residuals(result.values[kept])[1]
    else:
        values = result.values.copy()
        values[result.model.positions(name)] = np.asarray(values_of(effect.at_neutral(context)))
        bare = result.likelihood.residuals(values)[1]
    change = bare - result.likelihood.residuals(result.values)[1]
    return change[result.likelihood.used].reshape(-1) / result.noise_scale

"""Exact fits of the candidates of a diagnosis: trials, additions and removals.

Evidence       Laplace: ln B = ½ (O_base − O_g) − ½ (ln det H_g − ln det H_base) − Σ ln w, with O the objective (χ² of
               data and priors), H half its Hessian and w the prior widths of the added parameters; those of amplitudes
               are averaged over their scale (`score.log_bayes`).

Other descriptions of the instrument are tried where a fit explains nothing:

1. Every change that the instrument has a place for (`model/alternatives.py`) is put into the residuals at two places,
   the fitted values and the start values, since a description that is badly wrong has bent the fit. The part of the
   residuals that the free parameters could absorb is projected out: one Gauss–Newton step with the slopes of the given
   description, priors included. Nothing is fitted; a sample of the field points is enough.
2. The few changes that leave least are fitted together with all parameters. Other curves of dispersion are always
   fitted: plates change their thickness to make up for a wrong curve, which one step cannot show. The evidence of a
   change against the given description is that of its fit (above) less the logarithm of the number of all such changes.
3. A change that gained nothing is not compared again once names have joined the model: the names explain a part of the
   misfit, and leave less for the change to explain.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.findings import Choice, FitComparison
from walop_jax.diagnosis.hypotheses import Ranked, texts_of
from walop_jax.diagnosis.score import SCALES, log_bayes
from walop_jax.fit.refit import PRIOR_EDGE, FitResult, fit
from walop_jax.io.shapes import AnyVector, Vector
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.alternatives import JOINED, alternatives, changed, other_curves
from walop_jax.model.effects import Context, Described, Effect, EffectKind, OtherDescription
from walop_jax.model.effects.in_models import effect_context, model_without, with_descriptions, with_effects
from walop_jax.model.light_path import NoSuchPlaceError
from walop_jax.model.parameters import Parameter, leaves, values_of
from walop_jax.model.specification import Model


@dataclasses.dataclass(frozen=True)
class Trial:
    """A trial addition to a model: its evidence (ln B), the remaining χ², and whether that agrees with noise.

    Example: the effect `ghost`, expected by its linear step to have ln B = 41, fitted with ln B = 40.2, with χ² = 1360
    left of 21000.

    item, expected   its linear step, and the evidence that a fit should find by it (None, NaN: it has none)
    fit              its fit; None until it has been fitted
    alternatives     other shapes of the effect that explain the data as well, in words
    rivals, nameless  effects, and descriptions, that the addition may be instead
    probability      that it has this name and none of `rivals` and `nameless`
    compared         the fits without and with it (`refits.before_and_after`)
    against          KINDs of exposures that contradict it
    refused          the reason for which it was not added; empty while nothing speaks against it
    score, p_value   of the linear test at the time when it was added
    groups           groups of descriptions added one after the other, each with the candidates that were as good then
    synonyms         other names (`synonyms.synonyms`) of the trial, and of its `nameless` rivals
    """

    effect: EffectKind
    evidence: float
    remaining: float
    leaves_noise: bool
    item: Ranked | None = None
    expected: float = float("nan")
    fit: FitResult | None = None
    alternatives: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()
    nameless: tuple[str, ...] = ()
    compared: FitComparison = dataclasses.field(default_factory=FitComparison)
    score: float = float("nan")
    p_value: float = float("nan")
    against: str = ""
    refused: str = ""
    groups: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    synonyms: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    probability: float = float("nan")

    @property
    def name(self) -> str:
        """Its name; without one its descriptions, or the change of the description of the instrument."""
        if self.item is not None:
            return self.item.name
        if self.effect is OtherDescription and self.fit is not None:
            return self.instance.change  # type: ignore[attr-defined]
        return self.effect.name

    @property
    def instance(self) -> Effect:
        """The effect at its fitted values, in standard form."""
        assert self.fit is not None
        return self.fit.model.instrument(self.fit.values).effect(self.effect.name).standard_form()

    @property
    def texts(self) -> tuple[str, ...]:
        """Texts of its descriptions, where it has no name."""
        if self.effect is not Described:
            return ()
        if self.fit is None:
            return () if self.item is None else texts_of(self.item.probe)
        return self.instance.sentences  # type: ignore[attr-defined]


def prior_width(parameter: Parameter) -> float:
    """The width of the prior of a parameter; without a prior that of its weak pull, or its `scale`."""
    return parameter.prior[1] if parameter.prior is not None else (parameter.loose or parameter.scale)


def log_evidence_ratio(
    base: FitResult, extended: FitResult, scales: Float[np.ndarray, " t"] = SCALES
) -> float:
    """Laplace evidence of an extended fit against the base.

    Amplitudes are averaged over all `scales` of their prior widths (`prior_width`).
    """
    base_names, model = set(base.model.names), extended.model
    widths = [
        prior_width(p) for p in model.parameters if p.name not in base_names and p.free and p.tie is None
    ]
    amplitudes = [i for effect in model.effect_names for i in amplitude_positions(model, effect)]
    at = [i for i in amplitudes if model.names[i] not in base_names]
    gain = 0.5 * (base.expansion.objective - extended.expansion.objective)
    first, second = (np.linalg.slogdet(fitted.expansion.matrix)[1] for fitted in (base, extended))
    occam = 0.5 * float(second - first)
    at_all_scales = _of_amplitudes(extended, at, scales) - _of_amplitudes(extended, at, np.ones(1))
    return gain - occam - float(np.sum(np.log(widths))) + at_all_scales


def _of_amplitudes(result: FitResult, at: Sequence[int], scales: Float[np.ndarray, " t"] = SCALES) -> float:
    """ln B of the model with parameters `at` free against the model that holds them at their prior means.

    It is the Savage–Dickey ratio of nested models: density of the prior over density of the posterior, both Gaussian,
    at the prior means (Dickey 1971, Ann. Math. Stat. 42, 204), averaged over prior widths times `scales`. The
    information of the data alone is that of the posterior less that of the prior.
    """
    if not at:
        return 0.0
    mean, width = np.transpose([result.model.parameters[i].prior for i in at])  # type: ignore[arg-type]
    information = np.linalg.inv(result.covariance[np.ix_(at, at)])
    scores = information @ (result.values[at] - mean)
    return log_bayes(information - np.diag(width**-2.0), scores, width, scales)


def try_effect(
    base: FitResult,
    instance: Effect,
    prior_shapes: int = 1,
    *,
    start: Vector | None = None,
    scale: float = 1.0,
) -> Trial:
    """Add an effect at the given values to the fitted model and fit everything again.

    Descriptions join those that the model has. The prior of the name is divided among its `prior_shapes` shapes, and
    the prior widths of new descriptions are multiplied with `scale`. The other parameters start at their fitted values,
    or at `start`, if the misfit of the model has bent the fitted ones.
    """
    if isinstance(instance, Described):
        model = with_descriptions(base.model, instance, base.calset)
        for p in model.parameters if scale != 1.0 else ():
            if p.name not in base.model.names and p.prior is not None:
                model = model.change(p.name, prior=(p.prior[0], scale * p.prior[1]))
    else:
        model = with_effects(base.model, [instance], base.calset)
    values = base.values if start is None else start
    return _try_model(base, instance.kind, model, values, prior_shapes, scale)


def _try_model(
    base: FitResult,
    effect: EffectKind,
    model: Model,
    values: Float[np.ndarray, " n"],
    prior_shapes: int,
    scale: float = 1.0,
) -> Trial:
    """Fit a model with an effect, from values of the parameters of the base and its own start values of others.

    `scale` is the factor that the prior widths of its amplitudes have in the model already.
    """
    start = dict(zip(base.model.names, values, strict=True))
    likelihood = Likelihood.of(base.calset, model)
    result = fit(
        likelihood,
        start=np.array([start.get(p.name, p.start) for p in model.parameters]),
        noise_scale=base.noise_scale,
        target_objective=base.expansion.objective,
    )
    bayes = -np.inf  # of a diverged fit
    if np.isfinite(result.expansion.matrix).all():
        bayes = log_evidence_ratio(base, result, SCALES / scale) - float(np.log(prior_shapes))
    return Trial(effect, bayes, result.chi2, result.explains_data, fit=result)


def try_shapes(base: FitResult, item: Ranked, shapes: int) -> Trial:
    """Refit an effect from the amplitudes of its linear steps at the shapes that may be best, and keep the best."""
    places = ((item.probe, item.score), *item.others)
    steps = (item.effect.combine(probe.group, score.amplitudes) for probe, score in places)
    trials = [try_effect(base, step, shapes) for step in steps]
    converged = [t for t in trials if t.fit is not None and t.fit.converged]
    best = max(converged or trials[:1], key=lambda t: t.evidence)
    alike = [t for t in converged if t.evidence > best.evidence - thresholds.CERTAIN_ODDS]
    alternatives = dict.fromkeys(in_words(t.instance) for t in alike if _differ(t, best))
    return dataclasses.replace(best, alternatives=tuple(alternatives))


def _differ(first: Trial, second: Trial) -> bool:
    assert first.fit is not None
    assert second.fit is not None
    if first.instance.choices() != second.instance.choices():
        return True
    at = first.fit.model.positions(first.effect.name)
    sigma = np.maximum(first.fit.sigma[at], second.fit.sigma[at])
    away = np.asarray(values_of(first.instance)) - np.asarray(values_of(second.instance))
    return bool(np.any(np.abs(away) > thresholds.SEPARATION * np.where(sigma > 0, sigma, np.inf)))


def in_words(effect: Effect) -> str:
    """Choices and values of an effect, e.g. "camera = 2, depth = 0.006"."""
    pairs = zip(leaves(effect), np.asarray(values_of(effect)), strict=True)
    values = {leaf.name: f"{value:.4g}" for leaf, value in pairs}
    return ", ".join(f"{name} = {value}" for name, value in (spoken_choices(effect) | values).items())


def spoken_choices(effect: Effect) -> dict[str, Any]:
    """Discrete choices with a meaning for a reader: a camera, a crystal, a star."""
    return {name: value for name, value in effect.choices().items() if isinstance(value, int | str)}


def amplitude_positions(model: Model, name: str) -> list[int]:
    """Positions of the free amplitudes of an active effect that have a prior."""
    effect = model.template.effect(name)
    at = [model.index(f"{name}.{label}") for f in effect.kind.amplitudes() for label in effect.labels(f)]
    return [i for i in at if model.parameters[i].free and model.parameters[i].prior is not None]


def with_refuted_priors_widened(model: Model, values: Float[np.ndarray, " n"], name: str) -> Model:
    """The model with the priors of strongly deviating amplitudes widened to one width at the fitted value.

    A prior says how large such an effect usually is. A prior that the data refute would go on pulling at the value, and
    its pull would count as a misfit although the data are explained to within the noise.
    """
    for i in amplitude_positions(model, name):
        mean, width = model.parameters[i].prior  # type: ignore[misc]
        away = abs(float(values[i]) - mean)
        if away > PRIOR_EDGE * width:
            model = model.change(model.names[i], prior=(mean, away))
    return model


def beyond_prior(result: FitResult, name: str) -> dict[str, float]:
    """Amplitudes of an effect more than `PRIOR_EDGE` declared prior widths from their prior mean, and how many widths.

    The declared widths count, even where the model has widened a prior.
    """
    effect = result.model.template.effect(name)
    expected, far = effect.prior_widths(context_of(result)), {}
    for i in amplitude_positions(result.model, name):
        p = result.model.parameters[i]
        label = p.name.removeprefix(f"{name}.")
        widths = abs(float(result.values[i]) - p.prior[0]) / expected[label]  # type: ignore[index]
        if widths > PRIOR_EDGE:
            far[label] = widths
    return far


def context_of(result: FitResult) -> Context:
    """Facts about the data of a fit, for effects."""
    return effect_context(result.model.template, result.calset.exposures)


def evidence_of_presence(result: FitResult, name: str) -> float:
    """ln B of a fitted model against the same model without an effect, from prior and posterior density at neutral.

    Infinite for an effect without parameters.
    """
    at = amplitude_positions(result.model, name)
    return _of_amplitudes(result, at) if at else float("inf")


def refit_without(result: FitResult, name: str) -> FitResult:
    """Take an effect out of a fitted model and fit again, with errors scaled only if the residuals require it."""
    likelihood, values = _bare(result, name)
    return fit(likelihood, start=values)


def _bare(result: FitResult, name: str) -> tuple[Likelihood, Vector]:
    """The likelihood of a fitted model without an effect, and the fitted values of its parameters."""
    model = model_without(result.model, name)
    at = [result.model.index(remaining) for remaining in model.names]
    return Likelihood.of(result.calset, model), result.values[at]


def signature(result: FitResult, name: str) -> Float[np.ndarray, " _"]:
    """Change of the residuals (data rows) by an active effect: theirs without it, minus theirs with it."""
    effect = result.model.template.effect(name)
    if effect.kind.is_structural():
        likelihood, values = _bare(result, name)
        bare = likelihood.residuals(values)[1]
    else:
        values = result.values.copy()
        values[result.model.positions(name)] = np.asarray(values_of(effect.at_neutral(context_of(result))))
        bare = result.likelihood.residuals(values)[1]
    change = bare - result.likelihood.residuals(result.values)[1]
    return change[result.likelihood.used].reshape(-1) / result.noise_scale


CHOICE_ROWS = 6000
"""(Exposure, point) pairs on which other descriptions of an instrument are compared before any of them is fitted."""

NO_DIFFERENCE = 1e-6  # smallest change of the residuals, in standard deviations


def described_otherwise(model: Model, sentence: str, calset: CalibrationSet) -> Model:
    """The model with the change of a sentence applied to its instrument, after all earlier changes."""
    name = OtherDescription.name
    if name in model.effect_names:
        before = model.template.effect(name)
        assert isinstance(before, OtherDescription)
        sentence, model = f"{before.change}{JOINED}{sentence}", model_without(model, name)
    return with_effects(model, [OtherDescription(change=sentence)], calset)


def other_descriptions(
    result: FitResult,
    allowed: Callable[[int], bool],
    tell: Callable[[str], None],
    *,
    all_of_them: bool = True,
    earlier: Mapping[str, Choice] | None = None,
) -> tuple[list[Trial], dict[str, Choice]]:
    """Fits of other descriptions of the instrument, and all comparisons (`Choice`) by the text of the change.

    All changes are compared, and the best of them fitted as long as `allowed` is true of the number of fits so far.
    `earlier` are comparisons made before the last names joined the model.
    """
    template, hopeless = dataclasses.replace(result.model.template, effects=()), set[str]()
    if OtherDescription.name in result.model.effect_names:
        template = result.model.template.effect(OtherDescription.name).patch(template)
    else:
        hopeless = {choice.change for choice in (earlier or {}).values() if not choice.gains}
    curves = other_curves(template)
    # An element turned, exchanged or left out changes the light by per cents: it explains no small misfit.
    sentences = tuple(alternatives(template)) if all_of_them else curves
    asked = [sentence for sentence in sentences if sentence not in hopeless]
    if not asked:
        return [], {}
    tell(f"comparing {len(asked)} other descriptions")
    candidates = itertools.takewhile(lambda _: allowed(0), asked)
    screened = sorted(_screened(result, candidates), key=lambda item: item[0].left)
    compared, trials = {choice.change: choice for choice, _, _ in screened}, []
    best = [item for item in screened if item[1] > thresholds.LEAST_GAIN][: thresholds.MOST_FITTED]
    chosen = {choice.change for choice, _, _ in best}
    others = [item for item in screened if item[0].change in curves and item[0].change not in chosen]
    for choice, _, start in (*best, *others):
        if not allowed(len(trials)):
            break
        tell(f"trying another description: {choice.change}")
        model = described_otherwise(result.model, choice.change, result.calset)
        try:
            trial = _try_model(result, OtherDescription, model, start, len(sentences))
        except ValueError:  # a free parameter of a removed element has no prior and is undetermined
            continue
        assert trial.fit is not None
        gain = (result.expansion.objective - trial.fit.expansion.objective) * result.noise_scale**2
        compared[choice.change] = dataclasses.replace(choice, better_by=float(gain))
        trials.append(trial)
    return trials, compared


def _residuals_otherwise(
    likelihood: Likelihood, sentence: str, places: Sequence[Vector]
) -> Iterator[AnyVector]:
    """The residuals of a model with its instrument described otherwise, at values of its parameters, by rows of data.

    Elements are arranged in place where they keep their parameters; else an effect arranges them, for all `places`.
    """
    model, calset, by_effect = likelihood.model, likelihood.calset, None
    for values in places:
        arranged = None
        if OtherDescription.name not in model.effect_names:
            arranged = model.rearranged(values, lambda bare: changed(bare, sentence))
        if arranged is not None:
            residual = Likelihood.of(calset, arranged).residuals(arranged.start)[1]
        else:
            by_effect = by_effect or Likelihood.of(calset, described_otherwise(model, sentence, calset))
            residual = by_effect.residuals(values)[1]
        yield residual[likelihood.used].reshape(-1)


def _screened(result: FitResult, sentences: Iterable[str]) -> Iterator[tuple[Choice, float, Vector]]:
    """Every change that alters the residuals: as a `Choice` with the fraction left, its gain in χ², its start values.

    Of fitted values and start values of the model the better ones are taken.
    """
    point_limit = max(1, CHOICE_ROWS // max(len(result.calset.exposures), 1))
    calset = thinned(result.calset, point_limit, neighbours=1)
    start = result.model.start.copy()  # start values, but fitted ones for effects
    for name in result.model.effect_names:
        start[result.model.positions(name)] = result.values[result.model.positions(name)]
    likelihood = Likelihood.of(calset, result.model)
    values = result.values, start
    places = [Design.of(dataclasses.replace(result, likelihood=likelihood, values=v)) for v in values]
    reference = float(np.sum(places[0].projector(places[0].residual) ** 2))
    for sentence in sentences:
        ratios, otherwise = list[float](), _residuals_otherwise(likelihood, sentence, values)
        try:
            for design, residual in zip(places, otherwise, strict=True):
                rows = design.residual.copy()
                rows[: design.rows] = residual / design.fit.noise_scale
                if np.abs(rows - design.residual).max() < NO_DIFFERENCE:
                    break
                ratios.append(float(np.sum(design.projector(rows) ** 2)) / reference)
        except NoSuchPlaceError:  # it removes an element that an effect of the model acts on
            continue
        if len(ratios) == len(places) and np.isfinite(ratios).any():
            best = int(np.nanargmin(np.where(np.isfinite(ratios), ratios, np.nan)))
            yield Choice(sentence, ratios[best]), (1.0 - ratios[best]) * reference, values[best]

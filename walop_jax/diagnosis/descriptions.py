"""Other descriptions of the instrument, tried where a fit explains nothing.

1. Every change that the instrument has a place for (`model/alternatives.py`) is put into the residuals at two places,
   the fitted values and the start values: a description that is badly wrong has bent the fit. What the free parameters
   could absorb of them, at the slopes of the description given, is projected out, priors included (one Gauss–Newton
   step). Nothing is fitted; a sample of the field points is enough.
2. The few that leave least are fitted, all parameters with them, and other curves of dispersion in any case: plates
   grow to make up for those, by more than one step can tell. Their evidence against the description given is half
   the gain in χ² less the logarithm of the number of changes that were looked at.
3. A change that gained nothing is not compared again once names have joined the model: these explain a part of the
   misfit, and leave less for it to explain.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.exact import Trial, try_model
from walop_jax.diagnosis.findings import Choice
from walop_jax.fit.refit import FitResult, Vector
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.alternatives import JOINED, alternatives, other_curves
from walop_jax.model.effects import Context, OtherDescription
from walop_jax.model.light_path import NoSuchPlaceError
from walop_jax.model.specification import Model, model_without, with_effects

CHOICE_ROWS = 6000
"""(Exposure, point) pairs on which other descriptions of an instrument are compared before any of them is fitted."""

NO_DIFFERENCE = 1e-6  # smallest change of the residuals, in standard deviations


def described_otherwise(model: Model, sentence: str, context: Context) -> Model:
    """The model with the change of a sentence applied to its instrument, after all earlier changes."""
    name = OtherDescription.name
    if name in model.effect_names:
        before = model.template.effect(name)
        assert isinstance(before, OtherDescription)
        sentence, model = f"{before.change}{JOINED}{sentence}", model_without(model, name)
    return with_effects(model, [OtherDescription(change=sentence)], context)


def other_descriptions(
    result: FitResult,
    context: Context,
    fits: Callable[[], bool],
    tell: Callable[[str], None],
    *,
    all_of_them: bool = True,
    earlier: Mapping[str, Choice] | None = None,
) -> tuple[list[Trial], dict[str, Choice]]:
    """Changes of the description of a fit, by name: all are compared, the best of them fitted while `fits` allows.

    `earlier` are those that were compared before the last names joined the model.
    """
    template, hopeless = dataclasses.replace(result.model.template, effects=()), set[str]()
    if OtherDescription.name in result.model.effect_names:
        template = result.model.template.effect(OtherDescription.name).patch(template)
    else:
        hopeless = {choice.change for choice in (earlier or {}).values() if not choice.gains}
    curves = other_curves(template)
    # What is turned, exchanged or left out changes the light by per cents: nothing of that kind is a small misfit.
    sentences = tuple(alternatives(template)) if all_of_them else curves
    asked = [sentence for sentence in sentences if sentence not in hopeless]
    if not asked:
        return [], {}
    tell(f"comparing {len(asked)} other descriptions")
    candidates = itertools.takewhile(lambda _: fits(), asked)
    screened = sorted(_screened(result, candidates, context), key=lambda item: item[0].left)
    compared, trials = {choice.change: choice for choice, _, _ in screened}, []
    best = [item for item in screened if item[1] > thresholds.LEAST_GAIN][: thresholds.MOST_FITTED]
    chosen = {choice.change for choice, _, _ in best}
    others = [item for item in screened if item[0].change in curves and item[0].change not in chosen]
    for choice, _, start in (*best, *others):
        if not fits():
            break
        tell(f"trying another description: {choice.change}")
        model = described_otherwise(result.model, choice.change, context)
        try:
            trial = try_model(result, OtherDescription, model, start, len(sentences))
        except ValueError:  # a free parameter of a removed element has no prior and is undetermined
            continue
        assert trial.fit is not None
        gain = (result.expansion.objective - trial.fit.expansion.objective) * result.noise_scale**2
        compared[choice.change] = dataclasses.replace(choice, better_by=float(gain))
        trials.append(trial)
    return trials, compared


def _screened(
    result: FitResult, sentences: Iterable[str], context: Context
) -> Iterator[tuple[Choice, float, Vector]]:
    """Every effective change with its residual fraction, gain in χ² and starting values: the better of two."""
    point_limit = max(1, CHOICE_ROWS // max(len(result.calset.exposures), 1))
    calset = thinned(result.calset, point_limit, neighbours=1)
    start = result.model.start.copy()  # but effects as they have been fitted
    for name in result.model.effect_names:
        start[result.model.positions(name)] = result.values[result.model.positions(name)]
    likelihood = Likelihood.of(calset, result.model)
    places = [
        Design.of(dataclasses.replace(result, likelihood=likelihood, values=values))
        for values in (result.values, start)
    ]
    reference = float(np.sum(places[0].projector(places[0].residual) ** 2))
    for sentence in sentences:
        try:
            model = described_otherwise(result.model, sentence, context)
        except NoSuchPlaceError:  # it removes an element that an effect of the model acts on
            continue
        changed, ratios = Likelihood.of(calset, model), []
        for design in places:
            rows = design.residual.copy()
            residual = changed.residuals(design.fit.values)[1][design.measured.used].reshape(-1)
            rows[: design.rows] = residual / design.fit.noise_scale
            if np.abs(rows - design.residual).max() < NO_DIFFERENCE:
                break
            ratios.append(float(np.sum(design.projector(rows) ** 2)) / reference)
        if len(ratios) == len(places) and np.isfinite(ratios).any():
            best = int(np.nanargmin(np.where(np.isfinite(ratios), ratios, np.nan)))
            yield Choice(sentence, ratios[best]), (1.0 - ratios[best]) * reference, places[best].fit.values

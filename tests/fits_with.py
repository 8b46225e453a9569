"""Small sets that hide what sentences say, fits of models with effects, and the questions asked of their residuals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from small_run import SMALL

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar
from walop_jax.diagnosis.examination import Examination, examine
from walop_jax.diagnosis.hypotheses import Hypotheses
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described, Effect
from walop_jax.model.effects.in_models import with_effects
from walop_jax.simulation.simulate import simulate


def set_with(seed: int, sizes: dict[str, float]) -> CalibrationSet:
    """A small run in which there is what sentences say, of these amplitudes."""
    return simulate(SMALL, seed=seed, effects=[Described.saying(list(sizes), list(sizes.values()))]).calset


def fit_with(calset: CalibrationSet, *effects: str | Effect) -> FitResult:
    """The fit of the base model and of effects, which start at their values; those that are sentences at zero."""
    added = [effect for effect in effects if isinstance(effect, Effect)]
    if texts := [effect for effect in effects if isinstance(effect, str)]:
        added.append(Described.saying(texts, [0.0] * len(texts)))
    return fit(Likelihood.of(calset, with_effects(base_model(calset), added, calset)))


def examined_with(result: FitResult, chosen: Callable[[str], bool] | None = None) -> Examination:
    """The residuals of a fit, asked for those sentences of its grammar whose names are chosen, or for none."""
    calset = result.calset
    every = (
        grammar.descriptions(result.model.template, calset.exposures, len(calset.points)) if chosen else []
    )
    some = [probe for probe in every if chosen and chosen(probe.name)]
    return examine(result, Hypotheses(descriptions=some), np.random.default_rng(0))

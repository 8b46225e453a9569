"""A camera that is brighter on the Moon, or everywhere else: the fit, its class, and a diagnosis that has found it."""

from __future__ import annotations

import functools
from typing import Any

from fits_with import examined_with, fit_with, set_with

from walop_jax.diagnosis.class_product import only_a_class, with_average
from walop_jax.diagnosis.discrepancy import ambiguities
from walop_jax.diagnosis.examination import Examination
from walop_jax.diagnosis.findings import Diagnosis, Step
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import Quality
from walop_jax.model.effects import Described

TOLD = "gain of O1 * kind moon"


@functools.cache
def examined() -> Examination:
    """A camera is brighter on the Moon by 0.3 %: the fit of that description, its gains asked."""
    result = fit_with(set_with(3, {TOLD: 3e-3}), TOLD)
    return examined_with(result, lambda name: name.startswith("gain of"))


@functools.cache
def told() -> tuple[FitResult, Any]:
    """That fit, and the class of the description."""
    result = examined().result
    return result, ambiguities(examined(), {TOLD: ()})


@functools.cache
def diagnosed() -> Diagnosis:
    """The diagnosis that has found that class, nothing searched for."""
    result, classes = told()
    after = result.with_verdict()
    for sentence in only_a_class(classes):
        after = after.with_doubt(Quality.CLASS_ONLY, sentence)
    residual = result.likelihood.residuals(result.values)[1]
    step = Step(
        effect=Described.name, parameters={}, score=0.0, p_value=0.0, log_bayes=0.0,
        chi2_before=2.0, chi2_after=1.0, dof_after=1,
        heldout_scheme="exposures", heldout_before=2.0, heldout_after=1.0,
        equivalent=("crosstalk",), residual_before=residual, residual_after=residual,
    )  # fmt: skip
    return Diagnosis(
        verdict="effect_found",
        steps=(step,),
        candidates=(),
        limits=(),
        untestable=(),
        unexplained=None,
        p_value=0.0,
        remaining_p=1.0,
        before=result.with_verdict(),
        after=with_average(after, classes),
        seconds=0.0,
        points=len(result.calset.points),
        members=classes,
    )

"""What would repair a fit that does not explain its data: every remedy is fitted, the one that repairs most is first.

Remedies    errors N_ERR that are too small, by a scale s or a fraction f of the counts (scintillation, a flat field):
                s² N_ERR²   or   N_ERR² + f² N²,   s or f fitted together with the model (`model.noise`)
            single rows left out (`fit.outliers`); a number that the set states changed (`stated_conditions`)
            A remedy is one if what it leaves is noise: χ², and of errors no pattern, component or odd group.
Order       −2 ln L = χ² + Σ ln (σ²/N_ERR²), the smallest first; a row left out counts as a number fitted to each
            independent datum of it, ln n for each of n data (Schwarz 1978, Ann. Stat. 6, 461)
Limits      one remedy at a time. Where none is one, an effect may be missing, and a diagnosis is the advice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.remainder import number_alone
from walop_jax.diagnosis.stated_conditions import condition_scores
from walop_jax.fit.outliers import BEYOND, MOST, clipped, outlying
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.errors import DataError
from walop_jax.io.text import with_error
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.noise import with_noise

_LARGEST_FRACTION = 0.3
"""Of the counts: what would have to be added beyond it is no error of an intensity."""


class Remedy(NamedTuple):
    """What to do, in a sentence, and −2 ln L of the data with it, less that of noise of the stated size."""

    sentence: str
    worth: float


IsNoise = Callable[[FitResult], bool]
"""True of a fit whose residuals hold no pattern, no component and no group that scatters otherwise."""


def remedies(result: FitResult, is_noise: IsNoise) -> tuple[str, ...]:
    """The sentences of what turns the residuals of a poor fit into noise, the best remedy first, improbable ones not.

    `result` is of field points, few enough to be examined.
    """
    found = [*_of_errors(result, is_noise), *_of_rows(result), *_of_numbers(result)]
    found.sort(key=lambda remedy: remedy.worth)
    probable = (r for r in found if r.worth < found[0].worth + thresholds.CHI2_IMPROBABLE)
    return tuple(remedy.sentence for remedy in probable)


def _of_errors(result: FitResult, is_noise: IsNoise) -> Iterator[Remedy]:
    """The errors of the data as a part of the model (`model.noise`): a scale of N_ERR, or a fraction of the counts."""
    sentences = {"scale": too_small(result), "fraction": ""}
    for term in sentences:
        model = with_noise(result.model, **{term: "all"})
        start = np.append(result.values, model.start[len(result.values) :])
        fitted = fit(Likelihood.of(result.calset, model), start=start, noise_scale=1.0)
        value, error = fitted.value(model.names[-1])
        if not fitted.converged or (term == "fraction" and not 0.0 < abs(value) < _LARGEST_FRACTION):
            continue
        if fitted.explains_data and is_noise(fitted):
            worth = fitted.expansion.data + fitted.expansion.log_variance - fitted.dof
            yield Remedy(sentences[term] or _of_counts(abs(value), error), worth)


def too_small(result: FitResult) -> str:
    """The sentence of errors that are too small by the factor √(χ²/dof), which scatters by 1/√(2 dof) of itself."""
    dof = max(result.dof, 1)
    factor = float(np.sqrt(result.chi2 / dof))
    return (
        f"N_ERR is {with_error(factor, factor / np.sqrt(2.0 * dof))} times too small: with errors as large the "
        "residuals hold nothing but noise; check the gain and the unit of N_ERR, or have the factor fitted "
        '([noise] scale = "all" in a model file)'
    )


def _of_counts(fraction: float, error: float) -> str:
    """The sentence of errors that lack a fraction of the counts."""
    per_cent = with_error(100 * fraction, 100 * error)
    return (
        f"N_ERR lacks {per_cent} % of N: with √(N_ERR² + ({fraction:.2g} N)²) the residuals hold nothing but noise; "
        "that is scintillation, or a flat field that is left, and belongs into N_ERR, or have it fitted "
        '([noise] fraction = "all" in a model file)'
    )


def _of_rows(result: FitResult) -> Iterator[Remedy]:
    likelihood = result.likelihood
    if not isinstance(result.calset.intensities, TableIntensities):
        return
    share = outlying(likelihood, likelihood.residuals(result.values)[1]).sum() / max(likelihood.used.sum(), 1)
    if not 0.0 < share <= 2.0 * MOST:  # outliers bend a fit, and good rows then lie off as well
        return
    try:
        found = clipped(result.calset, result.model)
    except DataError:  # too many to be single ones
        return
    left_out = found.clipped
    if left_out is None or not (found.explains_data or found.nearly_explains_data) or found.noise_scale > 1.0:
        return
    fitted = len(left_out) * float(np.mean(likelihood.data_per_row)) * np.log(max(result.n_data, 2))
    share = f"{100 * len(left_out) / left_out.used:.2g} % of the rows lie more than {BEYOND:g} standard errors off"
    yield Remedy(
        f"{share}, and the others are explained (χ²/dof = {found.chi2 / max(found.dof, 1):.3g}): if these are cosmic "
        f"rays or stars, walop-jax refit --clip {BEYOND:g} leaves them out",
        found.chi2 - found.dof + fitted,
    )


def _of_numbers(result: FitResult) -> Iterator[Remedy]:
    """A number that the set states, if it alone leaves nothing but noise: `worth` 0, the mean of χ² − dof of noise."""
    if text := number_alone(result, condition_scores(Design.of(result))):
        yield Remedy(f"the residuals ask for {text}", 0.0)

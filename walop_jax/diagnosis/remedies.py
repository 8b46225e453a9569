"""What would repair a fit that does not explain its data: every remedy is fitted, the one that repairs most is first.

Remedies    errors N_ERR that are too small, by a factor s or by a share f of the counts (scintillation, a flat field):
                s² N_ERR²   or   N_ERR² + f² N²,   with s or f so that χ² is its expectation
            single rows left out (`fit.outliers`); a number that the set states changed (`stated_conditions`)
            A remedy is one if what it leaves is noise: χ², and of errors no pattern, component or odd group.
Order       −2 ln L = χ² + Σ ln (σ²/N_ERR²), the smallest first; a row left out counts as a number fitted to each
            independent datum of it, ln n for each of n data (Schwarz 1978, Ann. Stat. 6, 461)
Limits      one remedy at a time. Where none is one, an effect may be missing, and a diagnosis is the advice.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy import optimize

from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.remainder import number_alone
from walop_jax.diagnosis.stated_conditions import condition_scores
from walop_jax.fit.outliers import BEYOND, MOST, clipped, outlying
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood

_ROUNDS = 3  # fits in which a share of the counts is determined
_LARGEST_SHARE = 0.3


class Remedy(NamedTuple):
    """What to do, in a sentence, and −2 ln L of the data with it, less that of noise of the stated size."""

    sentence: str
    worth: float


Judge = Callable[[FitResult], bool]
"""True of a fit whose residuals hold no pattern, no component and no group that scatters otherwise."""


def remedies(result: FitResult, is_noise: Judge) -> tuple[str, ...]:
    """The sentences of what turns the residuals of a poor fit into noise, the best remedy first, improbable ones not.

    `result` is of field points, few enough to be examined.
    """
    found = [*_of_errors(result, is_noise), *_of_rows(result), *_of_numbers(result)]
    found.sort(key=lambda remedy: remedy.worth)
    probable = (r for r in found if r.worth < found[0].worth + 2.0 * thresholds.IMPROBABLE)
    return tuple(remedy.sentence for remedy in probable)


def _of_errors(result: FitResult, is_noise: Judge) -> Iterator[Remedy]:
    factor = float(np.sqrt(result.chi2 / max(result.dof, 1)))
    scaled = fit(result.likelihood, start=result.values, noise_scale=factor)
    if is_noise(scaled):
        yield Remedy(
            _too_small(factor), scaled.chi2 / factor**2 + 2.0 * result.dof * np.log(factor) - result.dof
        )
    table = result.calset.intensities
    if not isinstance(table, TableIntensities):
        return
    share, other = 0.0, result
    calset = result.calset
    for _ in range(_ROUNDS):
        share = _share(other, result.calset, share)
        if not 0.0 < share < _LARGEST_SHARE:
            return
        calset = _with_share(result.calset, share)
        other = fit(Likelihood.of(calset, result.model), start=other.values, noise_scale=1.0)
    if other.explains_data and is_noise(other):
        block = result.calset.intensities.block(0, len(result.calset.points))
        counts, sigma = (c[block.used] for c in (block.counts, block.sigma))
        # Of a row with a flux of its own one datum in K is not independent.
        weight = result.dof / max(result.n_data, 1)
        wider = weight * float(np.sum(np.log1p((share * counts / sigma) ** 2)))
        yield Remedy(
            f"N_ERR lacks {100 * share:.2g} % of N: with √(N_ERR² + ({share:.2g} N)²) the residuals hold nothing but "
            "noise; that is scintillation, or a flat field that is left, and belongs into N_ERR",
            other.chi2 + wider - result.dof,
        )


def _too_small(factor: float) -> str:
    """The sentence of errors that are too small by a factor."""
    return (
        f"N_ERR is {factor:.3g} times too small: with errors as large the residuals hold nothing but noise; check "
        "the gain and the unit of N_ERR"
    )


def _share(at: FitResult, stated: CalibrationSet, before: float) -> float:
    """The share of the counts that, beside the errors stated, makes χ² of the residuals what noise would give."""
    residual = at.likelihood.residuals(at.values)[1]
    block = stated.intensities.block(0, len(stated.points))
    used = block.used
    sigma, counts = block.sigma[used], block.counts[used]
    off = residual[used] * np.sqrt(sigma**2 + (before * counts) ** 2)

    def excess(share: float) -> float:
        return float(np.sum(off**2 / (sigma**2 + (share * counts) ** 2))) - at.dof

    if not excess(0.0) > 0.0 > excess(1.0):
        return 0.0
    return float(optimize.root_scalar(excess, bracket=(0.0, 1.0)).root)


def _with_share(calset: CalibrationSet, share: float) -> CalibrationSet:
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    sigma = np.sqrt(table.sigma**2 + (share * table.counts) ** 2)
    return dataclasses.replace(calset, intensities=dataclasses.replace(table, sigma=sigma))


def _of_rows(result: FitResult) -> Iterator[Remedy]:
    likelihood = result.likelihood
    if not isinstance(result.calset.intensities, TableIntensities):
        return
    share = outlying(likelihood, likelihood.residuals(result.values)[1]).sum() / max(likelihood.used.sum(), 1)
    if not 0.0 < share <= 2.0 * MOST:  # outliers bend a fit, and good rows then lie off as well
        return
    try:
        found = clipped(result.calset, result.model)
    except DataError:  # too many to be single ones, or rows that stand for pixels
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
    """A number that the set states: no more than the data themselves are changed by it."""
    if text := number_alone(result, condition_scores(Design.of(result))):
        yield Remedy(f"the residuals ask for {text}", 0.0)

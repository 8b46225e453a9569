"""Single intensities that neither model nor noise explain: cosmic rays, stars in a patch of sky.

Equation    |r| > c s v,  s = max(1, 1.4826 median |r / v|),  v² = independent data of a row / K
Symbols     r normalised residual of a camera, K cameras, v its standard deviation with the flux eliminated
            (v² = 1 − 1/K for one flux, 1 where it is known), c the number of standard errors, s how much more the
            residuals of this fit scatter than stated, by their median absolute deviation: it does not see the outliers
Source      clipping: Yahil & Vidal 1977, ApJ 214, 347
Limits      noise alone, c = 5: one row of 440 000 of four cameras. More than `MOST` of the rows are no outliers but
            effects that the model lacks
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.clipped import Clipped
from walop_jax.data.records import CalibrationSet, DataFlag
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.fit.search import FAR_OFF
from walop_jax.io.errors import fail
from walop_jax.io.names import IN_MEMORY
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.specification import Model

BEYOND = 5.0  # standard errors
LEAST = 3.0  # standard errors: with less, noise would be clipped and the errors of the rest with it
MOST = 0.05  # fraction of the rows
_GAUSSIAN = 1.4826  # standard deviation over median absolute deviation


def outlying(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> Bool[np.ndarray, "p e"]:
    """True (p, e) for used rows of which a camera lies more than `BEYOND` standard errors off, given normalised
    residuals.
    """
    return _distance(likelihood, residual) > BEYOND


def clipped(calset: CalibrationSet, model: Model | None = None, beyond: float = BEYOND) -> FitResult:
    """Fit a set without the rows that lie more than `beyond` standard errors from the fit of all others.

    The fit's `clipped` lists these rows, and its `calset` has them flagged (BAD_PIXEL). The farthest go first, down to
    half of their distance: large outliers bend a fit, and good rows then lie off as well. As long as the fit is bent,
    errors are taken as large as the residuals. Where all rows lie off alike none goes: that is for
    `FitResult.warnings` to say.

    Raises ValueError for `beyond` below `LEAST`, `DataError` for intensities that are no table, and where more
    than `MOST` of the rows lie off: then the model lacks something. Raises what `fit` raises.
    """
    if not beyond >= LEAST:
        raise ValueError(
            f"clip: {beyond:g} standard errors: noise itself lies so far off; at least {LEAST:g}"
        )
    where = calset.inputs[0].path if calset.inputs else IN_MEMORY
    if not isinstance(calset.intensities, TableIntensities):
        advice = "only tables of intensities can"
        raise fail("cannot be clipped", file=where, advice=advice)
    model, whole = model or base_model(calset), calset
    table, values = calset.intensities, model.start
    used = int(table.used.sum())
    while True:
        calset = dataclasses.replace(calset, intensities=table)
        likelihood = Likelihood.of(calset, model)
        square = _mean_square(likelihood, likelihood.residuals(values)[1])
        bent = square > FAR_OFF
        result = fit(likelihood, noise_scale=float(np.sqrt(square)) if bent else None)
        values = result.values
        residual = likelihood.residuals(values)[1]
        if used - int(table.used.sum()) > MOST * used:
            what = f"more than {100 * MOST:g} % of the rows lie more than {beyond:g} standard errors off"
            advice = (
                "too many to be single outliers: the model lacks something; walop-jax diagnose looks for it"
            )
            raise fail(what, file=where, advice=f"{advice}, walop-jax refit without --clip fits all rows")
        off = _distance(likelihood, residual)[table.point, table.exposure]
        if off.max(initial=0.0) > beyond:
            table = table.flagged(table.used & (off > max(beyond, 0.5 * off.max())), DataFlag.BAD_PIXEL)
        elif not bent or _mean_square(likelihood, residual) > FAR_OFF:
            return dataclasses.replace(result, clipped=_listed(whole, result, beyond))


def _listed(whole: CalibrationSet, result: FitResult, beyond: float) -> Clipped:
    """The used rows of the `whole` set that a fit has left out, and how far they lie from it."""
    likelihood = Likelihood.of(whole, result.model)
    before, after = whole.intensities, result.calset.intensities
    assert isinstance(before, TableIntensities)
    assert isinstance(after, TableIntensities)
    rows = np.flatnonzero(before.used & ~after.used)
    point, exposure = before.point[rows], before.exposure[rows]
    distance = _distances(likelihood, likelihood.residuals(result.values)[1])[point, exposure]
    return Clipped(
        beyond,
        int(before.used.sum()),
        whole.exposures.exposure[exposure],
        whole.points.point[point],
        distance.argmax(axis=-1),
        distance.max(axis=-1, initial=0.0),
    )


def _mean_square(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> float:
    return float(np.mean(residual[likelihood.used] ** 2))


def _distance(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> Float[np.ndarray, "p e"]:
    """Distance of the worst camera of every row, in standard errors; 0 where unused."""
    return _distances(likelihood, residual).max(axis=-1)


def _distances(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> Float[np.ndarray, "p e k"]:
    """Distance of every intensity from the fit, in standard errors; 0 where unused."""
    used = likelihood.used
    residual = np.abs(residual) / np.sqrt(likelihood.data_per_row / likelihood.cameras)[:, None]
    scatter = _GAUSSIAN * float(np.median(residual[used])) if used.any() else 1.0
    return np.where(used[..., None], residual / max(1.0, scatter), 0.0)

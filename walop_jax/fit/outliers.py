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

from walop_jax.data.records import CalibrationSet, DataFlag
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.fit.search import FAR_OFF
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.specification import Model

BEYOND = 5.0  # standard errors
LEAST = 3.0  # standard errors: with less, noise would be clipped and the errors of the rest with it
MOST = 0.05  # share of the rows
_GAUSSIAN = 1.4826  # standard deviation over median absolute deviation


@dataclasses.dataclass(frozen=True)
class Clipped:
    """A calibration set whose outlying rows are flagged, and the fit of the remaining rows.

    `rows` is how many (exposure, point) pairs were flagged, of `used` that took part before.
    """

    calset: CalibrationSet
    result: FitResult
    rows: int
    used: int

    @property
    def share(self) -> float:
        """Flagged fraction of the used rows."""
        return self.rows / max(self.used, 1)

    @property
    def too_many(self) -> bool:
        """True if so many rows lie off that it is the model that lacks something."""
        return self.share > MOST


def outlying(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> Bool[np.ndarray, "p e"]:
    """Used rows of which a camera lies more than `BEYOND` standard errors off, of the normalised residuals."""
    return _distance(likelihood, residual) > BEYOND


def clipped(calset: CalibrationSet, model: Model | None = None, beyond: float = BEYOND) -> Clipped:
    """Flag (BAD_PIXEL) rows more than `beyond` standard errors off, fit the others, and repeat until none is.

    The farthest go first, down to half of their distance: large outliers bend a fit, and good rows then lie off
    as well. As long as it does, errors are taken as large as the residuals. Stops where more than `MOST` of the rows
    are flagged, and where all of them lie off alike: that is for `FitResult.warnings` to say. Raises ValueError for
    `beyond` below `LEAST`, and what `fit` raises.
    """
    if not beyond >= LEAST:
        raise ValueError(f"{beyond:g} standard errors: noise itself lies so far off; at least {LEAST:g}")
    model = model or base_model(calset)
    table = TableIntensities.of(calset.intensities, calset.points)
    used, values = int(table.used.sum()), model.start
    while True:
        calset = dataclasses.replace(calset, intensities=table)
        likelihood = Likelihood.of(calset, model)
        square = _mean_square(likelihood, likelihood.residuals(values)[1])
        bent = square > FAR_OFF
        result = fit(likelihood, noise_scale=float(np.sqrt(square)) if bent else None)
        values = result.values
        residual = likelihood.residuals(values)[1]
        clipping = Clipped(calset, result, used - int(table.used.sum()), used)
        off = _distance(likelihood, residual)[table.point, table.exposure]
        if clipping.too_many:
            return clipping
        if off.max(initial=0.0) > beyond:
            table = table.flagged(table.used & (off > max(beyond, 0.5 * off.max())), DataFlag.BAD_PIXEL)
        elif not bent or _mean_square(likelihood, residual) > FAR_OFF:
            return clipping


def _mean_square(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> float:
    return float(np.mean(residual[likelihood.used] ** 2))


def _distance(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> Float[np.ndarray, "p e"]:
    """Distance of the worst camera of every row, in standard errors; 0 where unused."""
    used = likelihood.used
    residual = np.abs(residual) / np.sqrt(likelihood.data_per_row / likelihood.cameras)[:, None]
    scatter = _GAUSSIAN * float(np.median(residual[used])) if used.any() else 1.0
    return np.where(used, residual.max(axis=-1) / max(1.0, scatter), 0.0)

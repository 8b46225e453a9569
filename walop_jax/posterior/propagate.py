"""The instrument matrix by draws of the posterior instead of the linear propagation of a covariance."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import sky_vectors
from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.model import light
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.specification import Model
from walop_jax.posterior.checkpoint import digest_of_fit
from walop_jax.posterior.output import read_draws

DRAWS = 200


def matrix_draws(
    model: Model,
    draws: Float[np.ndarray, "d n"],
    settings: Settings,
    filters: Mapping[str, FilterCurve],
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
) -> Float[np.ndarray, "d p m"]:
    """Elements of the instrument matrix at field positions (deg) for every draw of all parameters."""
    pairs = model.template.cameras.pairs
    result = np.empty((len(draws), len(x), 3 * len(pairs)))
    for setting, rows in settings.distinct():
        plan = plan_for_settings(model.template, setting, filters)
        for i, values in enumerate(draws):
            instrument = model.instrument(values)
            vectors = sky_vectors(instrument, plan, x[rows], y[rows])[:, 0]
            matrix = light.instrument_matrix(jnp.asarray(vectors), pairs)
            result[i, rows] = np.asarray(matrix).reshape(len(rows), -1)
    return result


@dataclasses.dataclass(frozen=True, repr=False)
class DrawnCalibration(Calibration):
    """A calibration whose matrices, and their covariance, are means over draws of the posterior."""

    draws: Float[np.ndarray, "d n"] = dataclasses.field(default_factory=lambda: np.empty((0, 0)))

    def _elements(
        self, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"], settings: Settings
    ) -> tuple[Float[np.ndarray, "p m"], Float[np.ndarray, "p m m"]]:
        filters = {str(name): self.filter_curve(str(name)) for name in np.unique(settings.filter)}
        m = matrix_draws(self.model, self.draws, settings, filters, x, y)
        mean = m.mean(axis=0)
        away = m - mean
        return mean, np.einsum("dpi,dpj->pij", away, away) / (len(m) - 1)


def with_draws(
    calibration: Calibration, path: str | os.PathLike[str], count: int = DRAWS, seed: int = 0
) -> DrawnCalibration:
    """The calibration with draws from a `posterior.nc`.

    `DataError` for a file of another model or another fit, or not trusted.
    """
    draws = _draws_of(calibration, path)
    chosen = np.random.default_rng(seed).permutation(len(draws))[:count]
    known = {f.name: getattr(calibration, f.name) for f in dataclasses.fields(Calibration)}
    return DrawnCalibration(**known, draws=draws[chosen])


def with_moments(calibration: Calibration, path: str | os.PathLike[str]) -> Calibration:
    """The calibration with mean and covariance of all draws of a `posterior.nc` in place of the fit's.

    For what is propagated linearly anyway, star by star. `DataError` as in `with_draws`.
    """
    draws = _draws_of(calibration, path)
    return dataclasses.replace(calibration, values=draws.mean(axis=0), covariance=np.cov(draws, rowvar=False))


def _draws_of(calibration: Calibration, path: str | os.PathLike[str]) -> Float[np.ndarray, "d n"]:
    names = calibration.model.names
    return read_draws(path, names, digest_of_fit(calibration.inputs, names, calibration.values))

"""The posterior that is sampled, exactly as the fit minimises it, and which coefficients are sampled.

    −2 ln p(x) = χ²(data) / noise_scale² + priors + loose pulls          fluxes eliminated as in `engine`

Sampled are the physics coefficients. The throughput series and the catalogue values of the standards are
near-linear: they are marginalised in closed form (`surrogate`) and drawn afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.fit.refit import FitResult
from walop_jax.likelihood import engine
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import unknown_name, with_values

Vector = Float[np.ndarray, " f"]
LARGEST_SAMPLED = 20
NEAR_LINEAR = ("throughput", "standard")


@jax.jit  # a vector unravelled step by step costs more than the optics of a small set
def _instrument(template: Instrument, values: Float[Array, " n"]) -> Instrument:
    return with_values(template)(values)


class Target:
    """−2 ln posterior of a fitted model in its free parameters x, around the fit at `centre`."""

    def __init__(self, result: FitResult) -> None:
        self.likelihood, self._near = result.likelihood, result.posterior
        self.model = result.model
        self.free = result.model.free
        self.centre: Vector = np.asarray(result.values)[self.free]
        self.covariance: Float[np.ndarray, "f f"] = np.asarray(result.covariance)[
            np.ix_(self.free, self.free)
        ]
        self.noise_scale = result.noise_scale
        self._base, self._select = np.asarray(result.values), result.model.selection()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(self.model.names[i] for i in self.free)

    @property
    def scale(self) -> Vector:
        """The unit of each free parameter (its prior width, or the step a solver thinks in)."""
        return np.array([self.model.parameters[i].scale for i in self.free])

    @property
    def measured(self) -> int:
        """Independent data: three per used row of four intensities, four where the flux is known."""
        per_row = np.where(self.likelihood.flux_known, 4, 3)
        return int(self.likelihood.used.sum(axis=0) @ per_row)

    def values(self, x: Vector) -> Float[np.ndarray, " n"]:
        """All parameters, frozen and tied ones included."""
        return self._base + self._select @ (x - self.centre)

    def residuals(self, x: Vector, chunk: engine.PointData) -> Float[np.ndarray, " d"]:
        """Normalised residuals of one chunk of the data, errors times `noise_scale`."""
        instrument = _instrument(self.model.template, jnp.asarray(self.values(x)))
        _, r = engine.residuals(instrument, self.likelihood.plan, chunk)
        return np.asarray(r).ravel() / self.noise_scale

    def prior_rows(self, x: Vector) -> Float[np.ndarray, " k"]:
        """Normalised residuals of priors and loose pulls: linear in x."""
        return self.likelihood.priors.residuals(self.values(x))

    def half_gradient(self, x: Vector) -> Vector:
        """Half the gradient of the objective."""
        return self.likelihood.expand(self.values(x), self.noise_scale, self._near).gradient

    def data(self, x: Vector) -> float:
        """χ² of the data, errors times `noise_scale`."""
        return sum(float(np.sum(self.residuals(x, chunk) ** 2)) for chunk in self.likelihood.points)

    def objective(self, x: Vector) -> float:
        """−2 ln posterior, up to a constant."""
        return self.data(x) + float(np.sum(self.prior_rows(x) ** 2))


def near_linear(target: Target) -> Int[np.ndarray, " s"]:
    """Positions, among the free parameters, of throughput coefficients and catalogue values."""
    chosen = np.concatenate([target.model.positions(component) for component in NEAR_LINEAR])
    return np.flatnonzero(np.isin(target.free, chosen))


def bending(target: Target, k: int) -> float:
    """How far the residuals are from linear along parameter k: norm of the second order at one σ.

    The other parameters follow as the covariance of the fit says.
    """
    step = target.covariance[:, k] / np.sqrt(target.covariance[k, k])
    total = 0.0
    for chunk in target.likelihood.points:
        here, up, down = (
            target.residuals(x, chunk) for x in (target.centre, target.centre + step, target.centre - step)
        )
        total += float(np.sum((0.5 * (up + down) - here) ** 2))
    return total**0.5


def choose_sampled(
    target: Target, names: Sequence[str] | None = None, limit: int = LARGEST_SAMPLED
) -> Int[np.ndarray, " k"]:
    """Positions of the parameters to sample: `names`, or everything that is not near-linear, at most `limit`.

    Where there are more, the straightest are marginalised with the rest. Raises ValueError for unknown names.
    """
    if names is not None:
        for name in names:
            if name not in target.names:
                raise unknown_name("free parameter", name, target.names)
        chosen = np.array([target.names.index(name) for name in names], int)
    else:
        chosen = np.setdiff1d(np.arange(len(target.free)), near_linear(target))
    if len(chosen) > limit:
        bent = np.array([bending(target, int(k)) for k in chosen])
        chosen = np.sort(chosen[np.argsort(-bent)[:limit]])
    if len(chosen) == 0:
        raise ValueError("no free physics coefficient to sample: free at least one in the model file")
    return chosen

"""The posterior that is sampled, exactly as the fit minimises it, and which coefficients are sampled.

    −2 ln p(x) = χ²(data) / noise_scale² + priors + weak pulls          fluxes eliminated as in `engine`

Where errors of the data have parameters, the other terms of `likelihood/noise.py` are part of it.

A sampler is given either this, in all free parameters (`ExactPosterior`), or the surrogate in the physics coefficients
alone: throughput series and catalogue values of the standards are near-linear, so that they can be marginalised in
closed form (`surrogate`) and drawn afterwards.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.fit.refit import FitResult
from walop_jax.likelihood import engine
from walop_jax.likelihood.forward import Forward
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import check_names, with_values
from walop_jax.posterior.samplers import Density

FreeValues = Float[np.ndarray, " f"]
Draws = Float[np.ndarray, "n k"]
LARGEST_SAMPLED = 20
NEAR_LINEAR = ("throughput", "standard")


@jax.jit  # a vector unravelled step by step costs more than the optics of a small set
def _instrument(template: Instrument, values: Float[Array, " n"]) -> Instrument:
    return with_values(template)(values)


def ln_scale_unit(measured: int) -> float:
    """Change of ln s, s a common scale of the errors, per unit of its coordinate: about its standard error."""
    return 1.0 / np.sqrt(2.0 * max(measured, 1))


class Target:
    """−2 ln posterior of a fitted model as a function of its free parameters x (f), around the fit at `centre`."""

    def __init__(self, result: FitResult) -> None:
        self.likelihood, self._near = result.likelihood, result.expansion
        self.model = result.model
        self.free = result.model.free
        self.centre: FreeValues = result.values[self.free]
        self.covariance: Float[np.ndarray, "f f"] = result.covariance[np.ix_(self.free, self.free)]
        self.noise_scale, self._fitted = result.noise_scale, result.values

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(self.model.names[i] for i in self.free)

    @property
    def scale(self) -> FreeValues:
        """A typical step (f) of each free parameter: the natural step of the solver."""
        return np.array([self.model.parameters[i].scale for i in self.free])

    @property
    def measured(self) -> int:
        """Independent data of all used rows: an intensity for each camera, less the fraction of the unknown fluxes of
        the row.
        """
        return round(float(self.likelihood.used.sum(axis=0) @ self.likelihood.data_per_row))

    @property
    def root(self) -> Float[np.ndarray, "f f"]:
        """Lower triangular L with L Lᵀ the covariance of the fit: x = x̂ + L w has unit covariance in w."""
        scale = self.scale
        return scale[:, None] * np.linalg.cholesky(self.covariance / np.outer(scale, scale))

    def values(self, x: FreeValues) -> Float[np.ndarray, " n"]:
        """All parameters, fixed and tied ones included."""
        return self.model.full(x, self._fitted)

    def residuals(self, x: FreeValues, batch: engine.PointData) -> Float[np.ndarray, " d"]:
        """Normalised residuals of one batch of the data, errors times `noise_scale`."""
        instrument = _instrument(self.model.template, jnp.asarray(self.values(x)))
        _, r = engine.residuals(instrument, self.likelihood.plan, batch)
        return np.asarray(r).ravel() / self.noise_scale

    def prior_rows(self, x: FreeValues) -> Float[np.ndarray, " k"]:
        """Normalised residuals of priors and weak pulls: linear in x."""
        return self.likelihood.priors.residuals(self.values(x))

    def prior_slopes(self, steps: Float[np.ndarray, "f m"]) -> Float[np.ndarray, "k m"]:
        """Changes of `prior_rows` along the columns of `steps`."""
        first = self.prior_rows(self.centre)
        changes = [self.prior_rows(self.centre + step) - first for step in steps.T]
        return np.array(changes).reshape(-1, len(first)).T

    def bending(self, steps: Float[np.ndarray, "f m"]) -> Float[np.ndarray, " m"]:
        """Departure of the residuals from linear at each column of `steps`: squared norm of their second order."""
        total = np.zeros(steps.shape[1])
        for batch in self.likelihood.points:
            at_centre = self.residuals(self.centre, batch)
            for m, step in enumerate(steps.T):
                up, down = (self.residuals(self.centre + sign * step, batch) for sign in (1, -1))
                total[m] += np.sum((0.5 * (up + down) - at_centre) ** 2)
        return total

    def half_gradient(self, x: FreeValues) -> FreeValues:
        """Half the gradient of the objective."""
        return self.likelihood.expand(self.values(x), self.noise_scale, self._near).gradient

    def data(self, x: FreeValues) -> float:
        """χ² of the data, errors times `noise_scale`."""
        return sum(float(np.sum(self.residuals(x, batch) ** 2)) for batch in self.likelihood.points)

    def objective(self, x: FreeValues) -> float:
        """−2 ln posterior, up to a constant."""
        return self.data(x) + float(np.sum(self.prior_rows(x) ** 2))


@dataclasses.dataclass(frozen=True)
class ExactPosterior:
    """The posterior of all free parameters in w, where x = x̂ + L w and L Lᵀ is the covariance of the fit.

    Nothing is marginalised but the fluxes. `sampled` are the positions of the coefficients that figures show; all are
    sampled, those of the errors of the data among them.
    """

    target: Target
    sampled: Int[np.ndarray, " k"]

    def density(self) -> Density:
        """Its density; χ² is that of the forward model: the memory of a gradient is that of one batch of points."""
        target = self.target
        forward = Forward.of(target.likelihood.calset, target.model)
        first, along = target.values(target.centre), target.model.selection() @ target.root
        linear = (first, along, target.prior_rows(target.centre), target.prior_slopes(target.root))

        def log_density(
            w: Array, forward: Forward, first: Array, along: Array, offset: Array, slope: Array
        ) -> Array:
            data = forward.log_likelihood(first + along @ w) / target.noise_scale**2
            return data - 0.5 * jnp.sum((offset + slope @ w) ** 2)

        return Density(len(target.free), log_density, (forward, *map(jnp.asarray, linear)))

    @property
    def _order(self) -> Int[np.ndarray, " f"]:
        marginalised = np.setdiff1d(np.arange(len(self.target.free)), self.sampled)
        return np.concatenate([self.sampled, marginalised])

    @property
    def monitored_names(self) -> tuple[str, ...]:
        """Names of all free parameters: those that figures show, then the others."""
        return tuple(self.target.names[i] for i in self._order)

    def monitored(self, z: Float[np.ndarray, "... k"]) -> Float[np.ndarray, "... q"]:
        """The free parameters, in the order of their names."""
        return (self.target.centre + z @ self.target.root.T)[..., self._order]

    def draw(self, z: Draws, rng: np.random.Generator) -> Float[np.ndarray, "n f"]:
        """Free parameters at sampled coordinates; nothing is left to be drawn."""
        return self.target.centre + z @ self.target.root.T

    def moments(self, z: Draws) -> tuple[FreeValues, Float[np.ndarray, "f f"]]:
        """Mean and covariance of all free parameters over draws."""
        x = self.draw(z, np.random.default_rng(0))
        return x.mean(axis=0), np.cov(x, rowvar=False).reshape(2 * (x.shape[1],))


def near_linear(target: Target) -> Int[np.ndarray, " s"]:
    """Positions, among the free parameters, of throughput coefficients and catalogue values."""
    chosen = np.concatenate([target.model.positions(component) for component in NEAR_LINEAR])
    return np.flatnonzero(np.isin(target.free, chosen))


def choose_sampled(
    target: Target, names: Sequence[str] | None = None, limit: int = LARGEST_SAMPLED
) -> Int[np.ndarray, " k"]:
    """Positions of the parameters to sample: `names`, or everything that is not near-linear, at most `limit`.

    Where there are more, the straightest are marginalised with the rest. Raises ValueError for unknown names.
    """
    if names is not None:
        check_names("free parameter", names, target.names)
        chosen = np.array([target.names.index(name) for name in names], int)
    else:
        chosen = np.setdiff1d(np.arange(len(target.free)), near_linear(target))
    if len(chosen) > limit:
        # One σ of each; the other parameters follow as the covariance of the fit says.
        steps = target.covariance[:, chosen] / np.sqrt(np.diag(target.covariance)[chosen])
        chosen = np.sort(chosen[np.argsort(-target.bending(steps))[:limit]])
    if len(chosen) == 0:
        raise ValueError("no free physics coefficient to sample: free at least one in the model file")
    return chosen

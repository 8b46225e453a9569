"""The exact posterior of all free parameters, in place of the surrogate: for samplers that want it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from walop_jax.posterior.density import Density
from walop_jax.posterior.target import INFLATION, Target, exact_density


@dataclasses.dataclass(frozen=True)
class ExactPosterior:
    """Coordinates w with x = x̂ + L w, as in `exact_density`; nothing is marginalised but the fluxes.

    `sampled` are the positions of the coefficients that figures show; all of them are sampled.
    """

    target: Target
    sampled: Int[np.ndarray, " k"]
    inflate: bool = False

    def density(self) -> Density:
        """The density of the coordinates."""
        return exact_density(self.target, self.inflate)

    @property
    def ln_f_unit(self) -> float:
        """What ln f changes by per unit of its coordinate."""
        return self.target.ln_f_unit

    @property
    def _order(self) -> Int[np.ndarray, " f"]:
        rest = np.setdiff1d(np.arange(len(self.target.free)), self.sampled)
        return np.concatenate([self.sampled, rest])

    @property
    def quoted_names(self) -> tuple[str, ...]:
        """Names of all free parameters: those that figures show, ln f, the others."""
        names = [self.target.names[i] for i in self._order]
        k = len(self.sampled)
        return (*names[:k], *((INFLATION,) if self.inflate else ()), *names[k:])

    def quoted(self, z: Float[np.ndarray, "... k"]) -> Float[np.ndarray, "... q"]:
        """The free parameters (and ln f), in the order of their names."""
        free, k = len(self.target.free), len(self.sampled)
        x = self.target.centre + z[..., :free] @ self.target.root.T
        x = x[..., self._order]
        return np.concatenate([x[..., :k], z[..., free:] * self.ln_f_unit, x[..., k:]], axis=-1)

    def draw(self, z: Float[np.ndarray, "n k"], rng: np.random.Generator) -> Float[np.ndarray, "n f"]:
        """Free parameters at sampled coordinates; nothing is left to be drawn."""
        return self.target.centre + z[:, : len(self.target.free)] @ self.target.root.T

    def moments(
        self, z: Float[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f f"]]:
        """Mean and covariance of all free parameters over draws."""
        x = self.draw(z, np.random.default_rng(0))
        return x.mean(axis=0), np.cov(x, rowvar=False).reshape(2 * (x.shape[1],))

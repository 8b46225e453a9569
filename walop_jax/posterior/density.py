"""A probability density as samplers see it: ln p of coordinates in which the fit's covariance is the unit matrix."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model.compiled import compiled

Positions = Float[np.ndarray, "n k"]
Batch = Callable[[Positions], Float[np.ndarray, " n"]]


@dataclasses.dataclass(frozen=True)
class Density:
    """ln p, up to a constant, of `dimension` coordinates; near the fit they are independent with width 1.

    `function` gives ln p of one position as a JAX scalar; it takes `arrays` after the position, which keeps data out of
    compiled code. `gradient`, with the same arguments, gives value and gradient; None stands for
    `jax.value_and_grad(function)`. `batch`, where there is one, is a faster `log_density`.
    """

    dimension: int
    function: Callable[..., Array]
    arrays: tuple[Any, ...] = ()
    gradient: Callable[..., tuple[Array, Array]] | None = None
    batch: Batch | None = None

    @cached_property
    def with_gradient(self) -> Callable[..., tuple[Array, Array]]:
        """Value and gradient of one position, to be traced by JAX; takes `arrays` after the position."""
        return self.gradient or jax.value_and_grad(self.function)

    @cached_property
    def _one(self) -> Callable[..., Array]:
        return compiled(self.function)

    @cached_property
    def _one_with_gradient(self) -> Callable[..., tuple[Array, Array]]:
        return compiled(self.with_gradient)

    def log_density(self, positions: Positions) -> Float[np.ndarray, " n"]:
        """Return ln p of every position; −inf where it is not finite."""
        if self.batch is not None:
            return self.batch(positions)
        value = np.array([float(self._one(jnp.asarray(p), *self.arrays)) for p in positions])
        return np.where(np.isfinite(value), value, -np.inf)

    def value_and_gradient(self, position: Float[np.ndarray, " k"]) -> tuple[float, Float[np.ndarray, " k"]]:
        """Return ln p of one position and its gradient."""
        value, gradient = self._one_with_gradient(jnp.asarray(position), *self.arrays)
        return float(value), np.asarray(gradient)

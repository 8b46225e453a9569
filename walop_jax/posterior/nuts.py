"""The exact posterior of all coefficients by NUTS, the cross-check of everything else in this room.

In coordinates whitened by the covariance of the fit, x = x̂ + L w with L Lᵀ = C; no surrogate, nothing
marginalised but the fluxes. Needs blackjax (`pip install walop-jax[nuts]`).
Trajectories are cut after 2³ − 1 leapfrogs: in whitened coordinates all directions oscillate with one period,
and half a period, x → −x, which NUTS would like, moves means at once and widths not at all.

Source   Hoffman & Gelman 2014, JMLR 15, 1593; blackjax (Cabezas et al. 2024, arXiv 2402.10797).
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.likelihood import engine
from walop_jax.model.compiled import compiled
from walop_jax.model.parameters import with_values
from walop_jax.posterior.target import Target

TARGET_ACCEPTANCE = 0.8
DOUBLINGS = 3


@dataclasses.dataclass(frozen=True)
class NutsSample:
    """Draws of the free parameters, one chain.

    `seconds` without warm-up and compilation, which `preparation` took.
    """

    names: tuple[str, ...]
    draws: Float[np.ndarray, "n f"]
    divergences: int
    gradients: int
    step_size: float
    seconds: float
    preparation: float


def _kernel() -> Any:
    try:
        return importlib.import_module("blackjax")
    except ImportError:
        raise ImportError("NUTS needs blackjax: pip install 'walop-jax[nuts]'") from None


def whitened(target: Target) -> tuple[Callable[..., Float[Array, ""]], tuple[Any, ...]]:
    """ln p of whitened coordinates, and the arrays that it takes after them: none is compiled in."""
    likelihood = target.likelihood
    if len(likelihood.points) != 1:
        raise ValueError(
            "NUTS is a cross-check for sets that fit into one chunk: choose larger points_per_chunk"
        )
    template, scale = target.model.template, target.scale
    root = scale[:, None] * np.linalg.cholesky(target.covariance / np.outer(scale, scale))
    first, select = target.values(target.centre), target.model.selection()
    offset = target.prior_rows(target.centre)
    slope = np.stack([target.prior_rows(target.centre + column) - offset for column in root.T], axis=1)
    arrays = (
        template,
        likelihood.plan,
        likelihood.points.chunk(0),
        *(jnp.asarray(a) for a in (first, select @ root, offset, slope)),
    )

    residuals = inspect.unwrap(engine.residuals)  # to be compiled with the sampler, not on its own

    def log_density(w: Array, template: Any, plan: Any, data: Any, *linear: Array) -> Float[Array, ""]:
        first, along, offset, slope = linear
        _, r = residuals(with_values(template)(first + along @ w), plan, data)
        return -0.5 * (jnp.sum(r**2) / target.noise_scale**2 + jnp.sum((offset + slope @ w) ** 2))

    return log_density, arrays


class _StepSize:
    """Dual averaging of the step size (Hoffman & Gelman 2014, section 3.2.1, their constants)."""

    def __init__(self, first: float = 0.4) -> None:
        self._centre = np.log(10 * first)
        self._log, self._mean, self._error, self._count = np.log(first), np.log(first), 0.0, 0

    def learn(self, acceptance: float) -> None:
        self._count += 1
        m = self._count
        self._error += (TARGET_ACCEPTANCE - acceptance - self._error) / (m + 10)
        self._log = self._centre - np.sqrt(m) / 0.05 * self._error
        self._mean += m**-0.75 * (self._log - self._mean)

    @property
    def trial(self) -> float:
        return float(np.exp(self._log))

    @property
    def settled(self) -> float:
        return float(np.exp(self._mean))


def sample_nuts(
    target: Target,
    draws: int = 1000,
    warm_up: int = 200,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> NutsSample:
    """One chain from the fit.

    Raises ImportError without blackjax, ValueError for data in more than one chunk.
    """
    blackjax = _kernel()
    log_density, arrays = whitened(target)
    began = time.perf_counter()
    one = jnp.ones(len(target.centre))

    def start(position: Array, *arrays: Any) -> Any:
        return blackjax.nuts.init(position, lambda w: log_density(w, *arrays))

    def step(key: Array, state: Any, size: Array, *arrays: Any) -> tuple[Any, Any]:
        return blackjax.nuts(lambda w: log_density(w, *arrays), size, one, max_num_doublings=DOUBLINGS).step(
            key, state
        )

    key, go, tuning = jax.random.key(seed), compiled(step), _StepSize()
    state = compiled(start)(jnp.zeros(len(one)), *arrays)
    for i in range(warm_up):
        state, info = go(jax.random.fold_in(key, i), state, jnp.asarray(tuning.trial), *arrays)
        tuning.learn(float(info.acceptance_rate))
    size = jnp.asarray(tuning.settled)
    positions, divergences, gradients = np.empty((draws, len(one))), 0, 0
    ready = time.perf_counter()
    for i in range(draws):
        state, info = go(jax.random.fold_in(key, warm_up + i), state, size, *arrays)
        positions[i] = np.asarray(state.position)
        divergences += int(info.is_divergent)
        gradients += int(info.num_integration_steps)
        if progress is not None:
            progress(i + 1, draws)
    along = np.asarray(arrays[4])[np.asarray(target.free)]
    return NutsSample(
        names=target.names,
        draws=target.centre + positions @ along.T,
        divergences=divergences,
        gradients=gradients,
        step_size=float(size),
        seconds=time.perf_counter() - ready,
        preparation=ready - began,
    )

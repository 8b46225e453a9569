"""The sampler `nuts`: the exact posterior of all coefficients by the no-U-turn sampler of blackjax.

No surrogate, nothing marginalised but the fluxes: the cross-check of everything else in this room, and the way out
where the surrogate is not exact enough. Needs blackjax (`pip install 'walop-jax[nuts]'`).
Trajectories are cut after 2³ − 1 leapfrogs: in whitened coordinates all directions oscillate with one period,
and half a period, x → −x, which NUTS would like, moves means at once and widths not at all.

Source   Hoffman & Gelman 2014, JMLR 15, 1593; blackjax (Cabezas et al. 2024, arXiv 2402.10797).
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from walop_jax.io.errors import fail
from walop_jax.model.compiled import compiled
from walop_jax.posterior.samplers import Density, EnsembleState, Sampler, Stretch

TARGET_ACCEPTANCE = 0.8
DOUBLINGS = 3
FIRST_STEP = 0.4


@dataclasses.dataclass(frozen=True)
class Nuts(Sampler):
    """The no-U-turn sampler; `warm_up` is the number of steps that settle the step size, which are not part of the
    chain.
    """

    warm_up: int = 200

    name: ClassVar[str] = "nuts"
    exact: ClassVar[bool] = True
    software: ClassVar[tuple[str, ...]] = ("blackjax",)

    def __post_init__(self) -> None:
        if importlib.util.find_spec("blackjax") is None:
            raise fail("nuts needs blackjax", advice="pip install 'walop-jax[nuts]'")

    def start(self, density: Density, seed: Sequence[int]) -> EnsembleState:
        """One walker from a draw of the Laplace approximation, after the warm-up."""
        first = np.random.default_rng(seed).standard_normal(density.dimension)
        key = np.random.SeedSequence(seed).generate_state(1)
        adaptation = importlib.import_module("blackjax.adaptation.step_size")
        begin, learn, settled = adaptation.dual_averaging_adaptation(TARGET_ACCEPTANCE)
        tuning = [begin(FIRST_STEP)]
        for chain, info in _chain(
            density, first, key, range(self.warm_up), lambda: np.exp(tuning[0].log_step_size)
        ):
            tuning[0] = learn(tuning[0], info.acceptance_rate)
            first = np.asarray(chain.position)
        size = np.array(settled(tuning[0]) if self.warm_up else FIRST_STEP)
        return {"position": first, "key": key, "step_size": size, "steps": np.array(self.warm_up)}

    def advance(self, density: Density, state: EnsembleState, steps: int) -> tuple[EnsembleState, Stretch]:
        """Go on for that many trajectories."""
        positions, values = np.empty((steps, 1, density.dimension)), np.empty((steps, 1))
        acceptance, divergences, gradients = np.empty((steps, 1)), 0, 0
        size, first = float(state["step_size"]), int(state["steps"])
        numbers = range(first, first + steps)
        run = _chain(density, state["position"], state["key"], numbers, lambda: size)
        for i, (chain, info) in enumerate(run):
            positions[i, 0], values[i, 0] = np.asarray(chain.position), float(chain.logdensity)
            acceptance[i, 0] = float(info.acceptance_rate)
            divergences += int(info.is_divergent)
            gradients += int(info.num_integration_steps)
        after = {**state, "position": positions[-1, 0].copy(), "steps": np.array(first + steps)}
        counts = {"divergences": divergences, "gradients": gradients}
        return after, Stretch(positions, values, acceptance, counts)


def _chain(
    density: Density, position: np.ndarray, key: np.ndarray, numbers: range, size: Callable[[], float]
) -> Iterator[tuple[Any, Any]]:
    """State and information after every step; the step with a given number has random numbers of its own."""
    begin, step = _kernels(density.function)
    state, random = begin(jnp.asarray(position), density.arrays), jax.random.key(int(key[0]))
    scale = jnp.ones(density.dimension)
    for number in numbers:
        seed = jax.random.fold_in(random, number)
        state, info = step(seed, state, jnp.asarray(size()), scale, density.arrays)
        yield state, info


@functools.lru_cache(maxsize=1)
def _kernels(log_density: Callable[..., Array]) -> tuple[Callable[..., Any], ...]:
    """Compiled functions that begin a chain and take a step, for one density."""
    blackjax = importlib.import_module("blackjax")  # optional

    def begin(position: Array, arrays: tuple[Any, ...]) -> Any:
        return blackjax.nuts.init(position, lambda z: log_density(z, *arrays))

    def step(key: Array, state: Any, size: Array, mass: Array, arrays: tuple[Any, ...]) -> tuple[Any, Any]:
        kernel = blackjax.nuts(lambda z: log_density(z, *arrays), size, mass, max_num_doublings=DOUBLINGS)
        return kernel.step(key, state)

    return compiled(begin), compiled(step)

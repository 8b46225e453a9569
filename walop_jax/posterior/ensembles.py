"""Independent ensembles of one sampler on one density, taken further block by block until they have converged."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.io.errors import fail
from walop_jax.posterior.checkpoint import Checkpoints
from walop_jax.posterior.convergence import Chains, Convergence, assess
from walop_jax.posterior.density import Density
from walop_jax.posterior.result import BURN_IN, Options, Progress, Report
from walop_jax.posterior.samplers import Sampler, State, Stretch

Quoted = Callable[[Chains], Chains]


class Ensembles:
    """The ensembles of a run and what they have stored so far: every `thin`-th step of blocks of `interval` steps."""

    def __init__(
        self, sampler: Sampler, density: Density, options: Options, checkpoints: Checkpoints | None = None
    ) -> None:
        """Takes up what is in `checkpoints`, or starts."""
        self.sampler, self.density = sampler, density
        self.options, self.checkpoints = options, checkpoints
        self.thin = options.thin or sampler.thin
        self.blocks: list[list[Stretch]] = []
        self.seconds = 0.0
        for number in range(1, 1 + (0 if checkpoints is None else checkpoints.count())):
            assert checkpoints is not None
            self.states, blocks, seconds = checkpoints.load_block(number)
            self.blocks.append(blocks)
            self.seconds += seconds
        if not self.blocks:
            began = time.perf_counter()
            seeds = [(options.seed, number) for number in range(options.ensembles)]
            self.states: list[State] = [_arrays(sampler.start(density, seed)) for seed in seeds]
            self.seconds = time.perf_counter() - began

    @property
    def steps(self) -> int:
        """Number of steps done, burn-in included."""
        return len(self.blocks) * self.options.interval

    @property
    def acceptance(self) -> float:
        """Share of proposals accepted in the steps that are stored."""
        return float(np.mean([stretch.acceptance for block in self.blocks for stretch in block]))

    @property
    def counts(self) -> dict[str, int]:
        """What the sampler counted, all ensembles together."""
        total: Counter[str] = Counter()
        for block in self.blocks:
            for stretch in block:
                total.update(stretch.counts)
        return dict(total)

    def go_on(self) -> None:
        """One more block."""
        began, options = time.perf_counter(), self.options
        states, stretches = [], []
        for state in self.states:
            state, stretch = self.sampler.advance(self.density, state, options.interval)
            states.append(_arrays(state))
            stretches.append(self._stored(stretch))
        seconds = time.perf_counter() - began
        self.states, self.seconds = states, self.seconds + seconds
        self.blocks.append(stretches)
        if self.checkpoints is not None:
            self.checkpoints.save_block(len(self.blocks), states, stretches, seconds)

    def _stored(self, stretch: Stretch) -> Stretch:
        n, k = self.options.interval, self.density.dimension
        shape = np.shape(stretch.positions)
        rest = (np.shape(stretch.log_density), np.shape(stretch.acceptance))
        if len(shape) != 3 or (shape[0], shape[2]) != (n, k) or rest != (shape[:2], shape[:2]):
            raise fail(
                f"the sampler {self.sampler.name!r} gave positions of shape {shape} and numbers of shapes {rest}",
                advice=f"for {n} steps of {k} coordinates it must be (steps, walkers, coordinates) = ({n}, …, {k}), "
                "and (steps, walkers)",
            )
        stored = (np.array(part[self.thin - 1 :: self.thin], float) for part in stretch[:3])
        return Stretch(*stored, counts=stretch.counts)

    def kept(self) -> tuple[Chains, Float[np.ndarray, "e t w"]]:
        """Stored positions and ln p after burn-in."""
        z = np.concatenate([np.stack([s.positions for s in block]) for block in self.blocks], axis=1)
        lnp = np.concatenate([np.stack([s.log_density for s in block]) for block in self.blocks], axis=1)
        first = int(BURN_IN * z.shape[1])
        return z[:, first:], lnp[:, first:]

    def until_converged(
        self, names: Sequence[str], quoted: Quoted = np.asarray, report: Report | None = None
    ) -> Convergence:
        """Go on until the rules of convergence hold or another block would exceed `maximum_steps`; returns the verdict.

        Judged are the quantities that `quoted` makes of positions, under their `names`.
        """
        while True:
            verdict = None
            if self.blocks:
                verdict = assess(quoted(self.kept()[0]), tuple(names), self.thin)
                if verdict.converged or self.steps + self.options.interval > self.options.maximum_steps:
                    return verdict
            if report is not None:
                goal = self.options.maximum_steps if verdict is None else self.steps + verdict.needed
                done = min(self.steps / max(goal, 1), 1.0)
                report(Progress("sampling", done, *numbers_of(verdict)))
            self.go_on()


def _arrays(state: Mapping[str, Any]) -> State:
    """A state as it comes back from a checkpoint."""
    return {name: np.asarray(value) for name, value in state.items()}


def numbers_of(verdict: Convergence | None) -> tuple[float, float]:
    """Worst τ and fewest effective samples, for a progress bar; NaN before the first verdict."""
    if verdict is None:
        return float("nan"), float("nan")
    return verdict.history[2], float(np.min(verdict.ess))

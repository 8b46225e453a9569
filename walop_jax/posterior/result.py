"""What is asked of a sampler and what it answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.posterior.convergence import Chains, Convergence
from walop_jax.posterior.ensemble import MOVES
from walop_jax.posterior.surrogate_accuracy import Accuracy
from walop_jax.posterior.target import LARGEST_SAMPLED

Vector = Float[np.ndarray, " n"]

BURN_IN = 0.2  # share of the steps that is not used
INFLATION = "noise.ln_f"


@dataclasses.dataclass(frozen=True)
class Options:
    """How to sample. `interval` is the length of a block, hence of what a kill can lose, in steps.

    `walkers` 0 stands for twice the number of sampled coefficients, at least 64. `parameters` names what is
    sampled (None: the physics coefficients). `checks` is the number of draws compared with the exact
    posterior.
    """

    seed: int = 0
    walkers: int = 0
    interval: int = 500
    maximum_steps: int = 100_000
    thin: int = 2
    moves: str = MOVES[0]
    order: int = 3
    inflate: bool = False
    draws: int = 4000
    checks: int = 256
    ensembles: int = 2
    parameters: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.moves not in MOVES:
            raise ValueError(f"unknown moves {self.moves!r}: choose one of {', '.join(MOVES)}")
        if self.ensembles < 2:
            raise ValueError("at least two independent ensembles are needed to judge convergence")
        if min(self.interval, self.thin, self.draws, self.checks, self.maximum_steps) < 1:
            raise ValueError("interval, thin, draws, checks and maximum_steps must be 1 or more")
        if self.interval % self.thin:
            raise ValueError(f"interval {self.interval} must be a multiple of thin {self.thin}")
        if self.parameters is not None and len(self.parameters) > LARGEST_SAMPLED:
            raise ValueError(f"{len(self.parameters)} parameters to sample: at most {LARGEST_SAMPLED}")


class Progress(NamedTuple):
    """What a progress bar shows: what is being done, how much of it is done (0 … 1), τ in steps, ESS."""

    stage: str
    share: float
    tau: float = float("nan")
    ess: float = float("nan")


Report = Callable[[Progress], None]


@dataclasses.dataclass(frozen=True)
class PosteriorSample:
    """The posterior of all coefficients.

    `draws` holds (ensemble, draw, parameter) of all parameters in tree order, tied and frozen ones
    included; `mean` and `covariance` use every kept step. `trusted` needs convergence and a surrogate that
    is exact enough.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    draws: Float[np.ndarray, "e d n"]
    log_posterior: Float[np.ndarray, "e d"]
    ln_f: Float[np.ndarray, "e d"] | None
    mean: Vector
    covariance: Float[np.ndarray, "n n"]
    chains: Chains
    sampled: tuple[str, ...]
    thin: int
    convergence: Convergence
    accuracy: Accuracy
    acceptance: float
    seconds: float
    fingerprint: dict[str, str]

    @property
    def trusted(self) -> bool:
        """Whether the posterior may be believed."""
        return self.convergence.converged and self.accuracy.exact_enough

    @property
    def warnings(self) -> tuple[str, ...]:
        """What does not hold, in words."""
        found = [] if self.convergence.converged else [self.convergence.message(self.seconds_per_step)]
        if not self.accuracy.exact_enough:
            a = self.accuracy
            found.append(
                f"the surrogate differs from the exact posterior: {a.shift[0]} by {a.shift[1]:+.2f} ± "
                f"{a.shift[2]:.2f} σ, width of {a.width[0]} by a factor {a.width[1]:.2f} ± {a.width[2]:.2f}, "
                f"weights {a.efficiency:.2f} effective; sample fewer or better determined coefficients, or "
                "use NUTS"
            )
        return tuple(found)

    @property
    def seconds_per_step(self) -> float:
        """Time per step of all ensembles."""
        return self.seconds / max(self.convergence.steps / (1.0 - BURN_IN), 1.0)

    def value(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation of a coefficient."""
        i = self.names.index(name)
        return float(self.mean[i]), float(np.sqrt(self.covariance[i, i]))

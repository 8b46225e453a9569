"""The sampler `emcee`: ensembles of walkers that can be taken up again bit for bit.

Moves, in coordinates in which the Laplace approximation is the unit normal:

laplace   half of the steps propose a draw of N(0, 1.1² 1), whatever the position (accepted with the ratio of
          importance weights), half are `de`. Where Laplace holds, neighbouring steps are all but independent;
          where it does not, differential evolution carries the ensemble.
de        differential evolution (ter Braak 2006, Stat. Comput. 16, 239), one step in ten with γ = 1.
stretch   emcee's default (Goodman & Weare 2010).

emcee's DESnookerMove is not offered: in emcee 3.1.6 its proposals carry half the logarithm of the Jacobian that they
need (dfm/emcee pull request 531), and widths come out 8 % too small at 16 dimensions with 20 % of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from walop_jax.posterior.samplers import Density, EnsembleState, Sampler, Stretch

MOVES = ("laplace", "de", "stretch")
JUMPS = 0.1  # fraction of γ = 1 among differential evolution
WIDER = 1.1  # than the Laplace approximation: its draws as proposals
LEAST_WALKERS = 64  # unless a number is asked for


@dataclasses.dataclass(frozen=True)
class Emcee(Sampler):
    """`walkers` 0 stands for twice the number of coordinates, at least 64."""

    walkers: int = 0
    moves: str = MOVES[0]

    name: ClassVar[str] = "emcee"
    software: ClassVar[tuple[str, ...]] = ("emcee",)
    thin: ClassVar[int] = 2
    resumes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        mixture(self.moves)

    def start(self, density: Density, seed: Sequence[int]) -> EnsembleState:
        """Walkers drawn from the Laplace approximation, which is the unit normal in the sampled coordinates."""
        d = density.dimension
        count = self.walkers or max(LEAST_WALKERS, 2 * d)
        if count < 2 * d or count % 2:
            what = f"{count} walkers for {d} sampled coefficients"
            raise ValueError(f"{what}: an even number of at least {2 * d}")
        random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed)))
        positions = random.standard_normal((count, d))
        value = density.log_density(positions)
        if not np.all(np.isfinite(value)):
            raise ValueError("the posterior is not finite around the fit")
        return {"positions": positions, "log_density": value, "random": random.get_state(legacy=True)}

    def advance(self, density: Density, state: EnsembleState, steps: int) -> tuple[EnsembleState, Stretch]:
        """Go on for that many steps of all walkers."""
        import emcee

        count, dimension = state["positions"].shape
        how = {"vectorize": True, "moves": mixture(self.moves)}
        sampler = emcee.EnsembleSampler(count, dimension, density.log_density, **how)
        current = emcee.State(state["positions"], log_prob=state["log_density"], random_state=state["random"])
        positions, value = np.empty((steps, count, dimension)), np.empty((steps, count))
        accepted = np.zeros((steps + 1, count))
        run = sampler.sample(current, iterations=steps, store=True, skip_initial_state_check=True)
        for i, current in enumerate(run):
            positions[i], value[i] = current.coords, current.log_prob
            accepted[i + 1] = sampler.backend.accepted
        last = {"positions": positions[-1].copy(), "log_density": value[-1].copy()}
        return last | {"random": sampler.random_state}, Stretch(positions, value, np.diff(accepted, axis=0))


def _laplace_draws(
    coordinates: Float[np.ndarray, "w k"], random: np.random.RandomState
) -> tuple[Float[np.ndarray, "w k"], Float[np.ndarray, " w"]]:
    proposal = WIDER * random.standard_normal(coordinates.shape)
    return proposal, 0.5 * np.sum(proposal**2 - coordinates**2, axis=1) / WIDER**2


def mixture(moves: str) -> list[tuple[Any, float]]:
    """Return emcee's moves with their fractions; ValueError for an unknown name."""
    from emcee import moves as made

    if moves not in MOVES:
        raise ValueError(f"there are no moves {moves!r}: choose one of {', '.join(MOVES)}")
    if moves == "stretch":
        return [(made.StretchMove(), 1.0)]
    evolution = [(made.DEMove(), 1.0 - JUMPS), (made.DEMove(gamma0=1.0), JUMPS)]
    if moves == "de":
        return evolution
    return [(made.MHMove(_laplace_draws), 0.5), *((move, 0.5 * share) for move, share in evolution)]

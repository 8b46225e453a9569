"""emcee ensembles that advance block by block and can be taken up again bit for bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import emcee
import numpy as np
from jaxtyping import Float

LogPosterior = Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, " n"]]

MOVES = ("de", "stretch")
SNOOKER_SHARE = 0.2


class Block(NamedTuple):
    """What a stretch of steps gave: stored positions and ln p, and how many proposals were accepted."""

    coordinates: Float[np.ndarray, "n w k"]
    log_posterior: Float[np.ndarray, "n w"]
    accepted: float


@dataclasses.dataclass(frozen=True)
class Walkers:
    """All there is to an ensemble between two steps; `random` is the state of a Mersenne twister."""

    coordinates: Float[np.ndarray, "w k"]
    log_posterior: Float[np.ndarray, " w"]
    random: tuple[str, np.ndarray, int, int, float]


def moves(name: str) -> list[tuple[Any, float]]:
    """Differential evolution with 20 % snooker (ter Braak & Vrugt 2008), or emcee's stretch move.

    Raises ValueError for another name.
    """
    if name == "stretch":
        return [(emcee.moves.StretchMove(), 1.0)]
    if name == "de":
        return [(emcee.moves.DEMove(), 1.0 - SNOOKER_SHARE), (emcee.moves.DESnookerMove(), SNOOKER_SHARE)]
    raise ValueError(f"unknown moves {name!r}: choose one of {', '.join(MOVES)}")


def start(log_posterior: LogPosterior, count: int, dimension: int, seed: int, number: int) -> Walkers:
    """Walkers drawn from the Laplace approximation, which is the unit normal in the sampled coordinates."""
    sequence = np.random.SeedSequence([seed, number])
    random = np.random.RandomState(np.random.MT19937(sequence))
    coordinates = random.standard_normal((count, dimension))
    value = log_posterior(coordinates)
    if not np.all(np.isfinite(value)):
        raise ValueError("the posterior is not finite around the fit")
    return Walkers(coordinates, value, random.get_state(legacy=True))  # pyright: ignore[reportArgumentType]


def start_inflated(walkers: Walkers, log_posterior: LogPosterior, measured: int) -> Walkers:
    """The walkers with their last coordinate, ln f, on the scale √(1/2n) that n data leave it."""
    coordinates = walkers.coordinates.copy()
    coordinates[:, -1] /= np.sqrt(2.0 * max(measured, 1))
    return dataclasses.replace(walkers, coordinates=coordinates, log_posterior=log_posterior(coordinates))


def advance(
    log_posterior: LogPosterior, walkers: Walkers, stored: int, thin: int, move: str
) -> tuple[Walkers, Block]:
    """Go on for stored × thin steps."""
    count, dimension = walkers.coordinates.shape
    sampler = emcee.EnsembleSampler(count, dimension, log_posterior, vectorize=True, moves=moves(move))
    state = emcee.State(walkers.coordinates, log_prob=walkers.log_posterior, random_state=walkers.random)
    coordinates, values = np.empty((stored, count, dimension)), np.empty((stored, count))
    run = sampler.sample(state, iterations=stored, thin_by=thin, store=True, skip_initial_state_check=True)
    for i, state in enumerate(run):
        coordinates[i], values[i] = state.coords, state.log_prob
    accepted = float(np.mean(sampler.backend.accepted)) / (stored * thin)
    last = Walkers(coordinates[-1].copy(), values[-1].copy(), sampler.random_state)
    return last, Block(coordinates, values, accepted)

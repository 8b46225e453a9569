"""One small world, its fit and its surrogate, shared by the tests of this room."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from walop_jax.fit.refit import FitResult, fit
from walop_jax.posterior.surrogate import Surrogate, build_surrogate
from walop_jax.posterior.target import Target

from .worlds import World, Worlds


class Scene(NamedTuple):
    world: World
    result: FitResult
    target: Target
    surrogate: Surrogate


@pytest.fixture(scope="session")
def worlds() -> Worlds:
    return Worlds()


@pytest.fixture(scope="session")
def scene(worlds: Worlds) -> Scene:
    world = worlds.draw(np.random.default_rng(11))
    result = fit(world.likelihood, start=world.truth).with_verdict()
    assert result.converged
    target = Target(result)
    return Scene(world, result, target, build_surrogate(target))


@pytest.fixture(scope="session")
def gaussian() -> Surrogate:
    """A surrogate of a Gaussian posterior without any model behind it: 4 sampled, 3 marginalised coefficients."""
    rng = np.random.default_rng(0)
    k, s = 4, 3
    pairs = np.array([(i, j) for i in range(k) for j in range(i, k)])
    features = 1 + k + len(pairs) + s
    data, prior = np.zeros((features, features)), np.zeros((features, features))
    linear = [*range(1, 1 + k), *range(features - s, features)]
    root = rng.standard_normal((k + s, k + s)) * 0.2
    data[np.ix_(linear, linear)] = 0.9 * np.eye(k + s) + root @ root.T
    prior[np.ix_(linear, linear)] = 0.1 * np.eye(k + s)
    own, other = data[-s:, -s:], prior[-s:, -s:]
    half = np.linalg.inv(np.linalg.cholesky(own + other)).T
    share, vector = np.linalg.eigh(half.T @ own @ half)
    names = tuple(f"c{i}" for i in range(k + s))
    return Surrogate(
        names=names, sampled=np.arange(k), centre=np.zeros(k + s), along=np.eye(k + s)[:, :k],
        across=np.eye(k + s)[:, k:], pairs=pairs, triples=np.zeros((0, 3), int), data=data, prior=prior,
        linear=half @ vector, share=share, slope=np.zeros(k), skew=np.zeros(s), measured=1000,
    )  # fmt: skip

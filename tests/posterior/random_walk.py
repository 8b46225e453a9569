"""A sampler as a user writes one: random-walk Metropolis, not part of the package."""

import numpy as np

from walop_jax.posterior.samplers import Sampler, Stretch


class Metropolis(Sampler):
    """Proposals are normal, as wide as is best for a normal density (Roberts et al. 1997, Ann. Appl. Prob. 7, 110)."""

    name = "metropolis"

    def start(self, density, seed):
        position = np.random.default_rng(seed).standard_normal(density.dimension)
        return {"position": position, "seed": np.array([*seed, 0])}

    def advance(self, density, state, steps):
        random, z = np.random.default_rng(state["seed"]), state["position"]
        value, d = density.log_density(z[None])[0], density.dimension
        positions, values, accepted = np.empty((steps, 1, d)), np.empty((steps, 1)), np.empty((steps, 1))
        for i in range(steps):
            proposal = z + 2.38 / np.sqrt(d) * random.standard_normal(d)
            there = density.log_density(proposal[None])[0]
            accepted[i] = np.log(random.random()) < there - value
            if accepted[i]:
                z, value = proposal, there
            positions[i], values[i] = z, value
        state = {"position": z, "seed": state["seed"] + [0, 0, 1]}
        return state, Stretch(positions, values, accepted)

"""Posteriors around a fit: emcee on a checked surrogate of the exact posterior, NUTS on the posterior itself.

This room samples and says how far to believe it. It draws no figures, and knows no FITS.
"""

from walop_jax.posterior.convergence import Convergence
from walop_jax.posterior.density import Density
from walop_jax.posterior.result import Options, PosteriorSample, Progress
from walop_jax.posterior.samplers import SAMPLERS, Sampler, State, Stretch
from walop_jax.posterior.sampling import sample
from walop_jax.posterior.surrogate import Surrogate
from walop_jax.posterior.surrogate_accuracy import Accuracy
from walop_jax.posterior.surrogate_builder import build_surrogate

__all__ = [
    "SAMPLERS",
    "Accuracy",
    "Convergence",
    "Density",
    "Options",
    "PosteriorSample",
    "Progress",
    "Sampler",
    "State",
    "Stretch",
    "Surrogate",
    "build_surrogate",
    "sample",
]

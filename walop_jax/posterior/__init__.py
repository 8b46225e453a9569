"""Posteriors around a fit: emcee on a checked surrogate of the exact posterior, NUTS on the posterior itself.

This room samples and says how far to believe it. It draws no figures, and knows no FITS.
"""

from walop_jax.posterior.emcee import MOVES, Emcee
from walop_jax.posterior.files import (
    Checkpoints,
    Run,
    digest_of_fit,
    read_draws,
    read_inference_data,
    with_draws,
    with_moments,
    write_posterior,
)
from walop_jax.posterior.nuts import Nuts
from walop_jax.posterior.result import Convergence, Options, PosteriorSample, Progress, Report, assess, r_hat
from walop_jax.posterior.samplers import SAMPLERS, Density, Sampler, State, Stretch, make_sampler
from walop_jax.posterior.sampling import Ensembles, sample, sandwich_adjusted
from walop_jax.posterior.surrogate import Accuracy, Surrogate, build_surrogate, compare_with_exact
from walop_jax.posterior.target import Target, choose_sampled, exact_density, near_linear

__all__ = [
    "MOVES",
    "SAMPLERS",
    "Accuracy",
    "Checkpoints",
    "Convergence",
    "Density",
    "Emcee",
    "Ensembles",
    "Nuts",
    "Options",
    "PosteriorSample",
    "Progress",
    "Report",
    "Run",
    "Sampler",
    "State",
    "Stretch",
    "Surrogate",
    "Target",
    "assess",
    "build_surrogate",
    "choose_sampled",
    "compare_with_exact",
    "digest_of_fit",
    "exact_density",
    "make_sampler",
    "near_linear",
    "r_hat",
    "read_draws",
    "read_inference_data",
    "sample",
    "sandwich_adjusted",
    "with_draws",
    "with_moments",
    "write_posterior",
]

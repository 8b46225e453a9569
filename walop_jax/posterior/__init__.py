"""Posteriors around a fit: emcee on a checked surrogate of the exact posterior, NUTS on the posterior itself.

This room samples and says how far to believe it. It draws no figures, and knows no FITS.
"""

from walop_jax.posterior.emcee import MOVES, Emcee
from walop_jax.posterior.files import (
    Chain,
    Run,
    digest_of_fit,
    read_draws,
    with_draws,
    with_moments,
    write_posterior,
)
from walop_jax.posterior.nuts import Nuts
from walop_jax.posterior.result import Convergence, Options, PosteriorSample, Progress, assess, r_hat
from walop_jax.posterior.samplers import SAMPLERS, Density, Sampler, Stretch, make_sampler
from walop_jax.posterior.sampling import Ensembles, sample, sandwich_adjusted
from walop_jax.posterior.surrogate import Surrogate, build_surrogate, compare_with_exact
from walop_jax.posterior.target import Target, choose_sampled, exact_density, near_linear

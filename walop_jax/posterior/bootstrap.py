"""The sampler `bootstrap`: the whole analysis repeated on sets simulated from the fit, instead of a chain.

Draws       For each one, every used intensity becomes N* = F u + σ ε, and the mean of every prior μ* = θ̂ + w ε, with
            F u the model at the fit θ̂, σ the error of the intensity, w the width of the prior, and ε normal. The draw
            θ* is the fit to these (`fit.many.refit_many`).
Meaning     Where the model is linear within the errors, they are draws of the posterior. Where it is not, they are
            draws of the estimator, and their mean is off from θ̂ by its bias. They are independent: nothing converges.
Source      parametric bootstrap: Efron & Tibshirani 1993, An Introduction to the Bootstrap, ch. 6
Limits      Data scatter as their errors say. A set that is fitted by itself (`ManyFits.alone`) costs what a fit costs.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import ClassVar, NoReturn

import numpy as np

from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.many import fitted_together
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import fail
from walop_jax.model.specification import Model
from walop_jax.posterior.result import Convergence, Options, PosteriorSample
from walop_jax.posterior.samplers import Density, EnsembleState, Sampler, Stretch
from walop_jax.posterior.target import Target, choose_sampled

ENSEMBLES = 2  # the draws are shared out between, since files have chains
FEWEST = 0.99
"""Fraction of the fits that have to converge."""
DRAWS_PER_PARAMETER = 5
"""Draws for each free parameter from which on the covariance of the draws replaces the covariance of the fit; with
fewer than one draw it would be singular."""


@dataclasses.dataclass(frozen=True)
class Bootstrap(Sampler):
    """`refits` is the number of sets that are simulated and fitted; it has no chains."""

    refits: int = 1000

    name: ClassVar[str] = "bootstrap"
    repeats_the_fit: ClassVar[bool] = True

    def start(self, density: Density, seed: Sequence[int]) -> EnsembleState:
        """Raise TypeError: this sampler draws from no density."""
        self._without_chains()

    def advance(self, density: Density, state: EnsembleState, steps: int) -> tuple[EnsembleState, Stretch]:
        """Raise TypeError: this sampler has no chains."""
        self._without_chains()

    def _without_chains(self) -> NoReturn:
        raise TypeError("a bootstrap has no chains: give it to walop.sample, which repeats the fit")


def simulated_like(result: FitResult, rng: np.random.Generator) -> CalibrationSet:
    """A set like that of a fit, whose counts scatter about the model as their errors say.

    Raises `DataError` for intensities that are no table.
    """
    calset, table = result.calset, result.calset.intensities
    if not isinstance(table, TableIntensities):
        raise fail("the intensities are no table", advice="fit a table, such as the cells of frames")
    used, (_, residual) = table.used, result.likelihood.residuals(result.values)
    weight = result.likelihood.points.gathered("weight")
    at = table.point[used], table.exposure[used]
    error = 1.0 / weight[at]
    counts = table.counts.copy()
    counts[used] += error * (rng.standard_normal(error.shape) - residual[at])
    return dataclasses.replace(calset, intensities=dataclasses.replace(table, counts=counts))


def with_priors_drawn(model: Model, values: np.ndarray, rng: np.random.Generator) -> Model:
    """The model with the means of its priors drawn about full values, each by the width of its prior."""
    away = rng.standard_normal(len(values))
    drawn = tuple(
        p
        if p.prior is None or not p.free or p.tie is not None
        else dataclasses.replace(p, prior=(float(value + p.prior[1] * e), p.prior[1]))
        for p, value, e in zip(model.parameters, values, away, strict=True)
    )
    return dataclasses.replace(model, parameters=drawn)


def bootstrapped(
    result: FitResult, options: Options, sampler: Bootstrap, tell: Callable[[float], None] = lambda _: None
) -> PosteriorSample:
    """The posterior by fits to simulated sets; `tell` hears the fraction that is done.

    Raises `DataError` as `refit_many` does, and for fewer than four sets.
    """
    began, count = time.perf_counter(), min(sampler.refits, options.maximum_steps)
    if count < 2 * ENSEMBLES:
        raise fail(f"{count} refits are too few to tell a spread", advice="1000 are usual")
    rng = np.random.default_rng([options.seed, 30])
    sets = [simulated_like(result, rng) for _ in range(count)]
    models = [with_priors_drawn(result.model, result.values, rng) for _ in range(count)]
    fits = fitted_together(sets, models, lambda done, of: tell(done / of))
    values = fits.values[fits.converged]
    kept = values[: len(values) // ENSEMBLES * ENSEMBLES].reshape(ENSEMBLES, -1, values.shape[1])
    target = Target(result)
    shown = target.free[choose_sampled(target, options.parameters)]
    names = tuple(result.model.names[i] for i in shown)
    unity, off = np.ones(len(names)), 1.0 - len(values) / count
    reasons = [f"{100 * off:.1f} % of the fits did not converge"] if off > 1.0 - FEWEST else []
    if len(values) < (enough := DRAWS_PER_PARAMETER * len(target.free)):
        reasons.append(f"the covariance of {len(target.free)} parameters needs {enough} or more")
    return PosteriorSample(
        sampler=sampler.name,
        names=result.model.names,
        units=tuple(p.unit for p in result.model.parameters),
        draws=kept,
        log_posterior=np.full(kept.shape[:2], np.nan),
        mean=values.mean(axis=0),
        covariance=np.cov(values, rowvar=False),
        chains=kept[:, :, None][..., shown],
        sampled=names,
        thin=1,
        convergence=Convergence(
            names=names,
            steps=kept.shape[1],
            tau=unity,
            history=(1.0, 1.0, 1.0),
            ess=len(values) * unity,
            rhat=unity,
            needed=0,
            reasons=tuple(reasons),
            independent=True,
        ),
        accuracy=None,
        acceptance=1.0,
        counts={"refits": count, "converged": len(values), "fitted alone": len(fits.alone)},
        seconds=time.perf_counter() - began,
        fingerprint={},
        likelihood=result.likelihood,
        noise_scale=result.noise_scale,
    )

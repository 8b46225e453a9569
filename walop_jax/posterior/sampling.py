"""`sample`: from a fit to a posterior, by independent ensembles of one sampler, with a verdict."""

from __future__ import annotations

import dataclasses
import inspect
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from walop_jax.fit.refit import FitResult, covariance
from walop_jax.fit.verdict import STATED
from walop_jax.io.code import versions_of
from walop_jax.io.errors import fail
from walop_jax.model.noise import COMMON, NOISE
from walop_jax.model.specification import Model
from walop_jax.posterior import result as results
from walop_jax.posterior.draws import A_MEAN, digest, digest_of_fit
from walop_jax.posterior.files import Chain
from walop_jax.posterior.result import Chains, Convergence, Options, PosteriorSample, Progress, Report
from walop_jax.posterior.samplers import Density, EnsembleState, Sampler, Stretch
from walop_jax.posterior.surrogate import Surrogate, build_surrogate, compare_with_exact
from walop_jax.posterior.target import ExactPosterior, Target, choose_sampled

Monitored = Callable[[Chains], Chains]
Covariance = Float[np.ndarray, "n n"]

SOFTWARE = ("walop-jax", "jax", "jaxlib", "numpy")
OF_LENGTH, OF_SAMPLER = ("maximum_steps", "draws", "checks"), ("sampler", "walkers", "moves")
"""Options that do not change a chain, its length and summary, and those that have an entry of their own."""


class Ensembles:
    """The ensembles of a run and their stored steps: every `thin`-th step of blocks of `interval` steps."""

    def __init__(self, sampler: Sampler, density: Density, options: Options, chain: Chain | None = None):
        """Resumes from `chain` where it exists, or starts."""
        self.sampler, self.density, self.options, self.chain = sampler, density, options, chain
        self.thin = options.thin or sampler.thin
        self.blocks: list[list[Stretch]] = []
        if chain is not None and chain.path.exists():
            self.states, stretches, self.seconds = chain.load()
            self.blocks.append(stretches)
        else:
            began = time.perf_counter()
            seeds = [(options.seed, number) for number in range(options.ensembles)]
            self.states: list[EnsembleState] = [dict(sampler.start(density, seed)) for seed in seeds]
            self.seconds = time.perf_counter() - began

    @property
    def steps(self) -> int:
        """Number of steps done, burn-in included."""
        return self.thin * sum(len(block[0].positions) for block in self.blocks)

    @property
    def acceptance(self) -> float:
        """Fraction of proposals accepted in the steps that are stored."""
        return float(np.mean([stretch.acceptance for stretch in self.stretches]))

    @property
    def stretches(self) -> list[Stretch]:
        """All stored steps, of every ensemble."""
        joined = []
        for ensemble in zip(*self.blocks, strict=True):
            positions, values, shares = (np.concatenate([s[column] for s in ensemble]) for column in range(3))
            joined.append(Stretch(positions, values, shares))
        return joined

    @property
    def counts(self) -> dict[str, int]:
        """Counts of the sampler, summed over all ensembles."""
        total: Counter[str] = Counter()
        for block in self.blocks:
            for stretch in block:
                total.update(stretch.counts)
        return dict(total)

    def go_on(self) -> None:
        """Compute one more block of steps."""
        began, interval = time.perf_counter(), self.options.interval
        advanced = [self.sampler.advance(self.density, state, interval) for state in self.states]
        stretches = [self._stored(stretch) for _, stretch in advanced]
        self.states = [dict(state) for state, _ in advanced]
        self.seconds += time.perf_counter() - began
        self.blocks.append(stretches)
        if self.chain is not None:
            self.chain.save(self.states, self.stretches, self.seconds)

    def _stored(self, stretch: Stretch) -> Stretch:
        n, k = self.options.interval, self.density.dimension
        shape = np.shape(stretch.positions)
        shapes = (np.shape(stretch.log_density), np.shape(stretch.acceptance))
        if len(shape) != 3 or (shape[0], shape[2]) != (n, k) or shapes != (shape[:2], shape[:2]):
            name, wanted = self.sampler.name, f"(steps, walkers, coordinates) = ({n}, …, {k})"
            what = f"the sampler {name!r} gave positions of shape {shape} and numbers of shapes {shapes}"
            advice = f"for {n} steps of {k} coordinates it must be {wanted}, and (steps, walkers)"
            raise fail(what, advice=advice)
        stored = (np.array(series[self.thin - 1 :: self.thin], float) for series in stretch[:3])
        return Stretch(*stored, counts=stretch.counts)

    def kept(self) -> tuple[Chains, Float[np.ndarray, "e t w"]]:
        """Stored positions and ln p after burn-in."""
        z, lnp, _ = (np.stack(series) for series in zip(*(s[:3] for s in self.stretches), strict=True))
        first = int(results.BURN_IN * z.shape[1])
        return z[:, first:], lnp[:, first:]

    def until_converged(
        self, names: Sequence[str], monitored: Monitored = np.asarray, report: Report | None = None
    ) -> Convergence:
        """Go on until the rules of convergence hold or another block would exceed `maximum_steps`; returns the verdict.

        Judged are the quantities that `monitored` makes of positions, under their `names`.
        """
        most = self.options.maximum_steps
        while True:
            verdict = None
            if self.blocks:
                verdict = results.assess(monitored(self.kept()[0]), tuple(names), self.thin)
                if verdict.converged or self.steps + self.options.interval > most:
                    return verdict
            if report is not None:
                goal = most if verdict is None else self.steps + verdict.needed
                report(Progress("sampling", min(self.steps / max(goal, 1), 1.0), *numbers_of(verdict)))
            self.go_on()


def numbers_of(verdict: Convergence | None) -> tuple[float, float]:
    """Worst τ and fewest effective samples, for a progress bar; NaN before the first verdict."""
    return (np.nan, np.nan) if verdict is None else (verdict.history[2], float(np.min(verdict.ess)))


def fingerprint(target: Target, options: Options) -> dict[str, str]:
    """Hashes of everything that decides the chain."""
    model, laid_out = target.model, target.likelihood.plan
    data = [np.asarray(array) for batch in target.likelihood.points for array in batch if array is not None]
    plan = [np.asarray(array) for array in (laid_out.wavelength, laid_out.node_weight, laid_out.teff)]
    exposures = [np.asarray(array) for array in jax.tree.leaves(laid_out.exposures)]
    parameters = [(p.name, p.start, p.free, p.tie, p.scale) for p in model.parameters]
    priors = [(p.name, p.prior, p.loose) for p in model.parameters]
    names = (f.name for f in dataclasses.fields(options) if f.name not in (*OF_LENGTH, *OF_SAMPLER))
    chain = {name: getattr(options, name) for name in names}
    sampler = options.make_sampler()
    versions = versions_of((*SOFTWARE, *sampler.software))
    effects = [effect.name for effect in model.template.effects]
    return {
        "data": digest(*data, *plan, *exposures, laid_out.settings),
        "model": digest(model.name, parameters, effects, model.template.plates),
        "priors": digest(priors),
        "fit": digest(np.round(target.centre, 12), target.noise_scale),
        "sampler": _description(sampler),
        "settings": digest(sorted(chain.items(), key=lambda item: item[0])),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


def _description(sampler: Sampler) -> str:
    """Name of a sampler, with a hash of its settings and, if it is not of this package, of the file that it is in."""
    settings = dataclasses.asdict(sampler) if dataclasses.is_dataclass(sampler) else {}
    code = b""
    if type(sampler).__module__.split(".")[0] != __name__.split(".")[0]:
        file = inspect.getsourcefile(type(sampler))
        code = b"" if file is None or not Path(file).exists() else Path(file).read_bytes()
    return f"{sampler.name} {digest(sorted(settings.items()), code)}"


def sample(
    result: FitResult,
    options: Options | None = None,
    *,
    folder: str | os.PathLike[str] | None = None,
    resume: bool = False,
    report: Report | None = None,
) -> PosteriorSample:
    """Sample the posterior around a fit until it has converged or `maximum_steps` are done.

    With `folder`, the chain of emcee is kept there; `resume` goes on from it as if there had been no interruption
    (other samplers start anew). Raises `DataError` for a folder that holds a run already while `resume` is False, or
    one of other data, model, priors, sampler, settings or versions; ValueError where there is nothing to sample;
    RuntimeError for a fit that was not examined.

    Around a fit whose errors come from its residuals (`errors_from`), chains are those of the stated errors, and draws
    and covariance are `sandwich_adjusted`.
    """
    if result.alternatives is not None and result.alternatives.several:
        raise fail(A_MEAN, file="the fit", advice="fit one, refit(calset, result.model), and sample that")
    options, trusted = options or Options(), result.trusted
    report = report or (lambda progress: None)
    if result.errors_from != STATED:
        inverse = covariance(result.model, result.expansion)
        stated = dataclasses.replace(result, covariance=inverse, errors_from=STATED)
        as_stated = sample(stated, options, folder=folder, resume=resume, report=report)
        return sandwich_adjusted(as_stated, result.model, inverse, result.covariance, result.errors_from)
    sampler = options.make_sampler()
    if sampler.repeats_the_fit:
        return _by_refits(result, options, sampler, report)
    scale = None if sampler.exact else _common_scale(result)
    target = Target(result if scale is None else _with_scale_held(result))
    marks = {} if folder is None else fingerprint(target, options)
    chain = Chain(folder, marks) if folder is not None and sampler.resumes else None
    if chain is not None and chain.path.exists():
        if not resume:
            raise fail("holds a chain already", file=folder, advice="go on with --resume, or --overwrite it")
        chain.load()  # a chain of another fit is refused before the work
    began, sampled = time.perf_counter(), choose_sampled(target, options.parameters)
    if sampler.exact:
        posterior = ExactPosterior(target, sampled)
    else:
        posterior = build_surrogate(
            target,
            sampled=sampled,
            order=options.order,
            scale=scale,
            seed=options.seed,
            progress=lambda done, total: report(Progress("tabulating the model", done / total)),
        )
    seconds = time.perf_counter() - began
    report(Progress("starting", 0.0))
    ensembles = Ensembles(sampler, posterior.density(), options, chain)
    verdict = ensembles.until_converged(posterior.monitored_names, posterior.monitored, report)
    report(Progress("comparing with the exact posterior", 1.0, *numbers_of(verdict)))
    finished = _finish(target, posterior, ensembles, verdict, seconds)
    fit = digest_of_fit(result.calset.inputs, result.model.names, result.values)
    return dataclasses.replace(finished, of_trusted_fit=trusted, fit=fit, fingerprint=marks)


def _by_refits(
    result: FitResult, options: Options, sampler: Any, report: Callable[[Progress], None]
) -> PosteriorSample:
    """The posterior by fits to simulated sets (`posterior.bootstrap`)."""
    from walop_jax.posterior.bootstrap import bootstrapped

    def tell(share: float) -> None:
        report(Progress("fitting simulated sets", share))

    found = bootstrapped(result, options, sampler, tell)
    fit = digest_of_fit(result.calset.inputs, result.model.names, result.values)
    return dataclasses.replace(found, of_trusted_fit=result.trusted, fit=fit)


def _common_scale(result: FitResult) -> float | None:
    """The fitted scale of all errors, None where no parameter of the errors is free.

    Raises `DataError` for other parameters of the errors: the surrogate has only the errors of all data together.
    """
    model = result.model
    free = [model.names[i] for i in model.free if model.parameters[i].part == NOISE]
    if not free:
        return None
    if free != [COMMON] or model[COMMON].prior is not None:
        odd = ", ".join(free)
        what = f"errors of the data have parameters ({odd}) that the surrogate of emcee cannot have"
        advice = "sample the exact posterior (--sampler nuts), or fix them in the model file (free = false)"
        raise fail(f"{what}; it has one scale of all errors, without a prior", advice=advice)
    return result.value(COMMON)[0]


def _with_scale_held(result: FitResult) -> FitResult:
    """The fit with the scale of the errors fixed where it was found."""
    model = result.model.change(COMMON, free=False, start=result.value(COMMON)[0])
    return dataclasses.replace(result, likelihood=dataclasses.replace(result.likelihood, model=model))


def _evenly(count: int, wanted: int) -> Int[np.ndarray, " m"]:
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).astype(int))


def _finish(
    target: Target,
    posterior: Surrogate | ExactPosterior,
    ensembles: Ensembles,
    verdict: Convergence,
    seconds: float,
) -> PosteriorSample:
    z, lnp = ensembles.kept()
    e, n, w, d = z.shape
    options, rng = ensembles.options, np.random.default_rng([ensembles.options.seed, 99])
    steps = _evenly(n, -(-options.draws // (e * w)))
    flat = z[:, steps].reshape(e, -1, d)
    x = posterior.draw(flat.reshape(-1, d), rng)
    values = np.array([target.values(point) for point in x]).reshape(e, flat.shape[1], -1)
    mean, spread = posterior.moments(z.reshape(-1, d)[:: max(1, e * n * w // 50_000)])
    select = target.model.selection()
    mean, spread = target.values(mean), select @ spread @ select.T
    if isinstance(posterior, Surrogate) and posterior.scale is not None:
        # It is no coordinate of the surrogate's parameters, but one of the draws.
        i, drawn = target.model.index(COMMON), posterior.scales(z)
        values[..., i] = posterior.scales(flat)
        mean[i], spread[i, i] = drawn.mean(), drawn.var()
    accuracy = None
    if isinstance(posterior, Surrogate):
        checked = z.reshape(-1, d)[_evenly(e * n * w, options.checks)]
        accuracy = compare_with_exact(target, posterior, checked, rng)
    shown = len(posterior.sampled)
    if isinstance(posterior, Surrogate):
        shown = len(posterior.monitored_names)
    return PosteriorSample(
        sampler=ensembles.sampler.name,
        names=target.model.names,
        units=tuple(p.unit for p in target.model.parameters),
        draws=values,
        log_posterior=lnp[:, steps].reshape(e, -1),
        mean=mean,
        covariance=spread,
        chains=posterior.monitored(z)[..., :shown],
        sampled=posterior.monitored_names[:shown],
        thin=ensembles.thin,
        convergence=verdict,
        accuracy=accuracy,
        acceptance=ensembles.acceptance,
        counts=ensembles.counts,
        seconds=seconds + ensembles.seconds,
        fingerprint={},
        likelihood=target.likelihood,
        noise_scale=target.noise_scale,
    )


def sandwich_adjusted(
    sample: PosteriorSample, model: Model, stated: Covariance, robust: Covariance, errors_from: str
) -> PosteriorSample:
    """A sample with its draws spread as the robust covariance of a fit, for data that scatter more than they state.

    Equation    θ' = m + Ω (θ − m),  Ω = L_C L_H⁻¹,  L_C L_Cᵀ = C,  L_H L_Hᵀ = H⁻¹
    Symbols     θ draws under the stated errors, m their mean; H⁻¹ (`stated`) covariance of the fit under the stated
                errors; C (`robust`) that from residuals (`fit.robust`), both of all parameters of the model
    Source      open-faced sandwich: Shaby 2014, Journal of Computational and Graphical Statistics 23, 853
    Limits      C = H⁻¹: nothing changes. Ω is not the symmetric root of that paper but lower triangular; both give
                draws of covariance C where those of the sampler have H⁻¹, and their skewness stays. Chains
                stay as they were sampled.

    `errors_from` names the origin of C in the result.
    """
    free, ties = model.free, model.selection()
    at = np.ix_(free, free)
    unit = np.sqrt(np.diag(stated)[free])
    lower, upper = (np.linalg.cholesky(matrix[at] / np.outer(unit, unit)) for matrix in (stated, robust))
    omega = unit[:, None] * np.linalg.solve(lower.T, upper.T).T / unit
    away = (sample.draws - sample.mean)[..., free] @ omega.T
    draws = sample.mean + away @ ties.T
    covariance = ties @ omega @ sample.covariance[at] @ omega.T @ ties.T
    return dataclasses.replace(sample, draws=draws, covariance=covariance, errors_from=errors_from)

"""`sample`: from a fit to a posterior, block by block, with checkpoints and a verdict."""

from __future__ import annotations

import dataclasses
import inspect
import os
import time
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Int

from walop_jax.fit.refit import FitResult, covariance
from walop_jax.io.errors import fail
from walop_jax.io.software import versions_of
from walop_jax.likelihood.expansion import STATED
from walop_jax.posterior.adjusted import with_errors_of
from walop_jax.posterior.checkpoint import Checkpoints, digest, digest_of_fit
from walop_jax.posterior.convergence import Convergence
from walop_jax.posterior.ensembles import Ensembles, numbers_of
from walop_jax.posterior.exact import ExactPosterior
from walop_jax.posterior.result import Options, PosteriorSample, Progress, Report
from walop_jax.posterior.samplers import Sampler
from walop_jax.posterior.surrogate import Surrogate
from walop_jax.posterior.surrogate_accuracy import check
from walop_jax.posterior.surrogate_builder import build_surrogate
from walop_jax.posterior.target import Target, choose_sampled

Vector = Float[np.ndarray, " n"]

SOFTWARE = ("walop-jax", "jax", "jaxlib", "numpy")


def fingerprint(target: Target, options: Options) -> dict[str, str]:
    """Hashes of everything that decides the chain."""
    model, laid_out = target.model, target.likelihood.plan
    data = [np.asarray(part) for chunk in target.likelihood.points for part in chunk if part is not None]
    plan = [np.asarray(part) for part in (laid_out.wavelength, laid_out.node_weight, laid_out.teff)]
    exposures = [np.asarray(part) for part in jax.tree.leaves(laid_out.exposures)]
    parameters = [(p.name, p.start, p.free, p.tie, p.scale) for p in model.parameters]
    priors = [(p.name, p.prior, p.loose) for p in model.parameters]
    chain = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    for name in ("maximum_steps", "draws", "checks"):  # how long, and what is made of it: free to change
        del chain[name]
    for name in ("sampler", "walkers", "moves"):  # have an entry of their own
        del chain[name]
    sampler = options.make_sampler()
    versions = versions_of((*SOFTWARE, *sampler.software))
    effects = [type(effect).__name__ for effect in model.template.effects]
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

    With `folder`, checkpoints are kept there; `resume` goes on from them, bit for bit as if there had been no
    interruption. Raises `DataError` for a folder that holds a run already while `resume` is False, or one of
    other data, model, priors, sampler, settings or versions; ValueError where there is nothing to sample.

    Around a fit whose errors come from what it leaves (`errors_from`), chains are those of the stated errors, and draws
    and covariance are spread as the errors of the fit are (`adjusted`).
    """
    options = options or Options()
    report = report or (lambda progress: None)
    if result.errors_from != STATED:
        stated = dataclasses.replace(
            result, covariance=covariance(result.model, result.posterior), errors_from=STATED
        )
        found = sample(stated, options, folder=folder, resume=resume, report=report)
        return with_errors_of(found, result.model, stated.covariance, result.covariance, result.errors_from)
    sampler, target = options.make_sampler(), Target(result)
    checkpoints = None
    if folder is not None:
        checkpoints = Checkpoints(folder, fingerprint(target, options))
        if checkpoints.exists() and not resume:
            raise fail("holds a chain already", file=folder, advice="go on with --resume, or --overwrite it")
        if checkpoints.exists():
            checkpoints.check()
    if sampler.exact:
        posterior = ExactPosterior(target, choose_sampled(target, options.parameters), options.inflate)
        seconds = 0.0
    else:
        posterior, seconds = _surrogate(target, options, checkpoints, report)
    report(Progress("starting", 0.0))
    ensembles = Ensembles(sampler, posterior.density(), options, checkpoints)
    verdict = ensembles.until_converged(posterior.quoted_names, posterior.quoted, report)
    report(Progress("comparing with the exact posterior", 1.0, *numbers_of(verdict)))
    finished = _finish(target, posterior, ensembles, verdict, seconds)
    fit = digest_of_fit(result.calset.inputs, result.model.names, result.values)
    return dataclasses.replace(finished, of_trusted_fit=result.trusted, fit=fit)


def _surrogate(
    target: Target, options: Options, checkpoints: Checkpoints | None, report: Report
) -> tuple[Surrogate, float]:
    if checkpoints is not None and checkpoints.exists():
        surrogate, extra = checkpoints.load_surrogate()
        return surrogate, float(extra["seconds"])
    began = time.perf_counter()
    surrogate = build_surrogate(
        target,
        sampled=choose_sampled(target, options.parameters),
        order=options.order,
        inflate=options.inflate,
        seed=options.seed,
        progress=lambda done, total: report(Progress("tabulating the model", done / total)),
    )
    seconds = time.perf_counter() - began
    if checkpoints is not None:
        checkpoints.save_surrogate(surrogate, {"seconds": seconds})
    return surrogate, seconds


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
    values = np.array([target.values(one) for one in x]).reshape(e, flat.shape[1], -1)
    accuracy = None
    if isinstance(posterior, Surrogate):
        checked = z.reshape(-1, d)[_evenly(e * n * w, options.checks)]
        accuracy = check(target, posterior, checked, rng)
    mean, spread = posterior.moments(z.reshape(-1, d)[:: max(1, e * n * w // 50_000)])
    select = target.model.selection()
    shown = len(posterior.sampled) + int(posterior.inflate)
    checkpoints = ensembles.checkpoints
    return PosteriorSample(
        sampler=ensembles.sampler.name,
        names=target.model.names,
        units=tuple(p.unit for p in target.model.parameters),
        draws=values,
        log_posterior=lnp[:, steps].reshape(e, -1),
        ln_f=flat[:, :, -1] * posterior.ln_f_unit if posterior.inflate else None,
        mean=target.values(mean),
        covariance=select @ spread @ select.T,
        chains=posterior.quoted(z)[..., :shown],
        sampled=posterior.quoted_names[:shown],
        thin=ensembles.thin,
        convergence=verdict,
        accuracy=accuracy,
        acceptance=ensembles.acceptance,
        counts=ensembles.counts,
        seconds=seconds + ensembles.seconds,
        fingerprint={} if checkpoints is None else dict(checkpoints.fingerprint),
    )

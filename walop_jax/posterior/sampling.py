"""`sample`: from a fit to a posterior, block by block, with checkpoints and a verdict."""

from __future__ import annotations

import dataclasses
import os
import time

import jax
import numpy as np
from jaxtyping import Float, Int

from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import fail
from walop_jax.io.software import versions_of
from walop_jax.posterior.checkpoint import Checkpoints, digest
from walop_jax.posterior.convergence import Chains, Convergence, assess
from walop_jax.posterior.ensemble import Block, Walkers, advance, start
from walop_jax.posterior.result import BURN_IN, INFLATION, Options, PosteriorSample, Progress, Report
from walop_jax.posterior.surrogate import Surrogate
from walop_jax.posterior.surrogate_accuracy import check
from walop_jax.posterior.surrogate_builder import build_surrogate
from walop_jax.posterior.target import Target, choose_sampled

Vector = Float[np.ndarray, " n"]

SOFTWARE = ("walop-jax", "jax", "jaxlib", "numpy", "emcee")


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
    versions = versions_of(SOFTWARE)
    return {
        "data": digest(*data, *plan, *exposures, laid_out.settings), "model": digest(model.name,
        parameters, [type(e).__name__ for e in model.template.effects], model.template.plates), "priors":
        digest(priors), "fit": digest(np.round(target.centre, 12), target.noise_scale), "settings":
        digest(sorted(chain.items(), key=lambda item: item[0])), "versions": ", ".join(f"{name} {version}"
        for name, version in versions.items()),
    }  # fmt: skip


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
    other data, model, priors, settings or versions; ValueError where there is nothing to sample.
    """
    options = options or Options()
    report = report or (lambda progress: None)
    target = Target(result)
    checkpoints = None
    if folder is not None:
        checkpoints = Checkpoints(folder, fingerprint(target, options))
        if checkpoints.exists() and not resume:
            raise fail("holds a chain already", file=folder, advice="go on with --resume, or --overwrite it")
    surrogate, build_seconds = _surrogate(target, options, checkpoints, report)
    run = _Run(surrogate, options, checkpoints)
    run.restore()
    while True:
        verdict = run.assess()
        if verdict is not None and (verdict.converged or run.steps >= options.maximum_steps):
            break
        goal = options.maximum_steps if verdict is None else run.steps + verdict.needed
        numbers = (np.nan, np.nan) if verdict is None else (verdict.history[2], float(np.min(verdict.ess)))
        report(Progress("sampling", min(run.steps / max(goal, 1), 1.0), *numbers))
        run.go_on()
    report(
        Progress("comparing with the exact posterior", 1.0, verdict.history[2], float(np.min(verdict.ess)))
    )
    return _finish(target, run, verdict, options, build_seconds)


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


class _Run:
    """The ensembles of a run and what they have stored so far."""

    def __init__(self, surrogate: Surrogate, options: Options, checkpoints: Checkpoints | None) -> None:
        self.surrogate, self.options, self.checkpoints = surrogate, options, checkpoints
        self.log_posterior = surrogate.log_posterior()
        d = surrogate.dimension
        count = options.walkers or max(64, 2 * d)
        if count < 2 * d or count % 2:
            raise ValueError(
                f"{count} walkers for {d} sampled coefficients: an even number of at least {2 * d}"
            )
        self.walkers: list[Walkers] = []
        for number in range(options.ensembles):
            self.walkers.append(start(self.log_posterior, count, d, options.seed, number))
        self.blocks: list[list[Block]] = []
        self.seconds = 0.0

    @property
    def steps(self) -> int:
        return len(self.blocks) * self.options.interval

    def restore(self) -> None:
        for number in range(1, 1 + (0 if self.checkpoints is None else self.checkpoints.count())):
            assert self.checkpoints is not None
            self.walkers, blocks, seconds = self.checkpoints.load_block(number)
            self.blocks.append(blocks)
            self.seconds += seconds

    def go_on(self) -> None:
        began, thin = time.perf_counter(), self.options.thin
        blocks = []
        for i, walkers in enumerate(self.walkers):
            stored = self.options.interval // thin
            self.walkers[i], block = advance(self.log_posterior, walkers, stored, thin, self.options.moves)
            blocks.append(block)
        seconds = time.perf_counter() - began
        self.seconds += seconds
        self.blocks.append(blocks)
        if self.checkpoints is not None:
            self.checkpoints.save_block(len(self.blocks), self.walkers, blocks, seconds)

    def kept(self) -> tuple[Chains, Float[np.ndarray, "e t w"]]:
        """Stored positions and ln p after burn-in."""
        z = np.concatenate([np.stack([b.coordinates for b in blocks]) for blocks in self.blocks], axis=1)
        lnp = np.concatenate([np.stack([b.log_posterior for b in blocks]) for blocks in self.blocks], axis=1)
        first = int(BURN_IN * z.shape[1])
        return z[:, first:], lnp[:, first:]

    def quoted(self, z: Chains) -> Chains:
        """The sampled coefficients themselves, as people quote them (and ln f)."""
        s = self.surrogate
        k = s.along.shape[1]
        physical = s.centre[s.sampled] + z[..., :k] @ s.along[s.sampled].T
        return np.concatenate([physical, z[..., k:] * s.ln_f_unit], axis=-1)

    def names(self) -> tuple[str, ...]:
        s = self.surrogate
        return (*(s.names[i] for i in s.sampled), *((INFLATION,) if s.inflate else ()))

    def assess(self) -> Convergence | None:
        """The verdict on what there is; None before the first block."""
        if not self.blocks:
            return None
        return assess(self.quoted(self.kept()[0]), self.names(), self.options.thin)


def _evenly(count: int, wanted: int) -> Int[np.ndarray, " m"]:
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).astype(int))


def _finish(
    target: Target, run: _Run, verdict: Convergence, options: Options, build_seconds: float
) -> PosteriorSample:
    z, lnp = run.kept()
    e, n, w, d = z.shape
    surrogate, rng = run.surrogate, np.random.default_rng([options.seed, 99])
    steps = _evenly(n, -(-options.draws // (e * w)))
    flat = z[:, steps].reshape(e, -1, d)
    x = surrogate.draw(flat.reshape(-1, d), rng)
    values = np.array([target.values(one) for one in x]).reshape(e, flat.shape[1], -1)
    checked = z.reshape(-1, d)[_evenly(e * n * w, options.checks)]
    accuracy = check(target, surrogate, checked, rng)
    mean, covariance = surrogate.moments(z.reshape(-1, d)[:: max(1, e * n * w // 50_000)])
    select = target.model.selection()
    return PosteriorSample(
        names=target.model.names,
        units=tuple(p.unit for p in target.model.parameters),
        draws=values,
        log_posterior=lnp[:, steps].reshape(e, -1),
        ln_f=flat[:, :, -1] * surrogate.ln_f_unit if surrogate.inflate else None,
        mean=target.values(mean),
        covariance=select @ covariance @ select.T,
        chains=run.quoted(z),
        sampled=run.names(),
        thin=options.thin,
        convergence=verdict,
        accuracy=accuracy,
        acceptance=float(np.mean([[b.accepted for b in blocks] for blocks in run.blocks])),
        seconds=build_seconds + run.seconds,
        fingerprint={} if run.checkpoints is None else dict(run.checkpoints.fingerprint),
    )

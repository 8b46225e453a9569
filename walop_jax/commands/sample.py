"""`walop-jax sample`: the posterior around a fit; chains kept on the way, then draws, intervals and figures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Option, Outcome, PathLike, command, typed
from walop_jax.commands.inputs import ModelLike
from walop_jax.commands.products import Effects, FitLike, catalogue_of, fit_of, folder_of
from walop_jax.io.errors import fail
from walop_jax.io.folder import output_folder
from walop_jax.io.names import PRODUCT, SAMPLE
from walop_jax.io.text import json_text, read_text

if TYPE_CHECKING:
    from walop_jax import Options, Run
    from walop_jax.posterior.result import PosteriorSample, Progress

CHAINS = "sampling"  # folder, in that of the run, of the chain that is kept
NOT_CONVERGED = "the posterior has not converged, or has too few draws; calibration.fits keeps its covariance"
OUTPUTS = (
    "posterior.nc", "posterior.fits", "posterior.ecsv", "posterior_corner.png", "posterior_trace.png", "sample.json",
)  # fmt: skip


OPTIONS = {
    "fit": Option("Folder of a `walop-jax refit`.", metavar="RUN", kind=Path, placed=True),
    "resume": Option("Go on from the chain in RUN/sampling (emcee)."),
    "data": Option(
        "Calibration set of the fit, if it has moved; again for each.", metavar="CALSET", kind=list[Path]
    ),
    "sampler": Option("emcee, nuts, bootstrap, or your own as FILE.py:CLASS.", metavar="NAME", kind=str),
    "maximum_steps": Option("Stop there at the latest, converged or not; a multiple of --interval.", least=1),
    "walkers": Option("Walkers of an emcee ensemble; 0: at least 64.", least=0),
    "interval": Option("Steps after which convergence is judged and the chain kept.", least=1),
    "moves": Option("Moves of emcee: laplace, de or stretch."),
}


@command(writes=(), random=True, options=OPTIONS)
def sample(
    job: Job,
    fit: FitLike,
    *,
    resume: bool = False,
    model: ModelLike = None,
    data: Sequence[PathLike] | None = None,
    effects: Effects = None,
    sampler: Any = "emcee",
    maximum_steps: int = 100_000,
    walkers: int = 0,
    interval: int = 500,
    moves: str = "laplace",
    parameters: Sequence[str] | None = None,
    options: Options | None = None,
) -> Outcome[PosteriorSample]:
    """Sample the posterior: RUN/posterior.nc, intervals and figures; the covariance goes into calibration.fits.

    The chain of emcee is kept in RUN/sampling: an interrupted run goes on with --resume, and refuses if data, model,
    priors, sampler, settings or versions have changed. Other samplers start anew. A chain that has not converged is
    written and marked so, with exit code 1; the covariance of the fit then stays in calibration.fits.

    The sampler bootstrap has no chain: it repeats the fit on 1000 sets that are simulated from it, on fewer with
    --maximum-steps.

    In Python: a `PosteriorSample`, of a fit in memory or of a run, which is then written. `parameters` names the
    sampled ones (None: the physics coefficients); `options` (`walop.Options`) are all settings at once, with those that
    the command line does not have, in place of the others and of `seed`. Raises `DataError` if the run is no folder of
    a fit, holds a posterior already, or does not fit its data any more.

    >>> walop.sample(result, seed=1).to_arviz()  # doctest: +SKIP
    """
    from walop_jax import FitResult, Options, Run
    from walop_jax.posterior.sampling import sample as sample_fit

    shown = None if parameters is None else tuple(parameters)
    options = options or Options(
        sampler, job.seed, walkers, interval, maximum_steps, moves=moves, parameters=shown
    )

    def tell(progress: Progress) -> None:
        numbers = "" if math.isnan(progress.tau) else f", τ {progress.tau:.1f}, ESS {progress.ess:.0f}"
        job.tell(f"{progress.stage}: {100 * progress.share:.0f} %{numbers}")

    name = options.make_sampler().name
    anew = () if not resume or options.make_sampler().resumes else (
        f"the chain of {name} is not kept: it started anew, resume was of no use",
    )  # fmt: skip
    fit = fit_of(fit)
    if isinstance(fit, FitResult):
        if resume or model is not None:
            raise ValueError("a fit in memory has its model and keeps no chain: leave model and resume out")
        posterior = sample_fit(fit, options, report=tell)
        where = "the fit"
    else:
        where = folder_of(fit)  # pyright: ignore[reportArgumentType]
        run = Run(where, catalogue_of(effects), tuple(data or ()))
        posterior = _sampled_run(job, run, options, tell, model, resume)
    return Outcome(
        posterior,
        warnings=(*anew, *posterior.warnings),
        failure="" if posterior.sampled_well else f"{where}: {NOT_CONVERGED}",
        trusted=posterior.trusted,
        next=(typed("report", where),),
    )


def _sampled_run(
    job: Job, run: Run, options: Any, tell: Any, model: ModelLike, resume: bool
) -> PosteriorSample:
    """The posterior around the fit in a folder, written there, with the covariance in its product if it can be."""
    from walop_jax import Model
    from walop_jax.calibration.product import read_calibration, write_calibration
    from walop_jax.io.plain_tables import write_table
    from walop_jax.posterior.draws import digest_of
    from walop_jax.posterior.files import Chain, write_posterior
    from walop_jax.posterior.sampling import sample as sample_fit
    from walop_jax.reports.named import draw
    from walop_jax.reports.posterior_figures import save_figure
    from walop_jax.reports.run import FigureSource

    folder = run.folder
    if not folder.is_dir():
        raise fail("is not a folder", file=folder, advice="give the RUN of walop-jax refit")
    if isinstance(model, Model):
        raise ValueError("with a run, give the model as a file, so that the run can be made again")
    text = None if model is None else read_text(model)
    existing = [name for name in OUTPUTS if (folder / name).exists()]
    if existing and not (job.overwrite or resume):
        advice = "go on with --resume, or --overwrite it"
        raise fail(f"holds {existing[0]} already", file=folder, advice=advice)
    with output_folder(folder, OUTPUTS, overwrite=True) as out:
        product = read_calibration(folder / PRODUCT, run.catalogue)
        result = run.fit(text)
        if job.overwrite and not resume:
            Chain(folder / CHAINS, {}).path.unlink(missing_ok=True)
        posterior = sample_fit(result, options, folder=folder / CHAINS, resume=resume, report=tell)
        posterior = dataclasses.replace(
            posterior, of_trusted_fit=product.verdict.trusted, fit=digest_of(product)
        )
        document = posterior.document() | {"shown": posterior.display().document()}
        intervals, figures = posterior.to_table(), FigureSource.of(posterior)
        with out.filled(((PRODUCT,) if posterior.trusted else ()) + OUTPUTS) as temporary:
            write_posterior(temporary / "posterior.nc", posterior)
            for end in (".fits", ".ecsv"):
                write_table(temporary / f"posterior{end}", intervals)
            for name in ("corner", "trace"):
                save_figure(temporary / f"posterior_{name}.png", draw(name, figures))
            (temporary / SAMPLE).write_text(json_text(document), encoding="utf-8")
            if posterior.trusted:
                better = product.with_covariance(posterior.covariance, posterior.errors_from)
                write_calibration(temporary / PRODUCT, better)
    return posterior

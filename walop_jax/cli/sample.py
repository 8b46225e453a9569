"""`walop-jax sample`: the posterior around the fit of a run."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from walop_jax.cli.common import (
    CommandError,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    json_text,
    print_json,
    read_text,
    switch_on_jax,
    warn,
)

if TYPE_CHECKING:
    from walop_jax.calibration.product import CalibrationProduct
    from walop_jax.posterior import PosteriorSample, Progress

CHAINS = "sampling"
OUTPUTS = (
    "posterior.nc",
    "posterior.fits",
    "posterior.ecsv",
    "posterior_corner.png",
    "posterior_trace.png",
    "sample.json",
)

RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a `walop-jax refit`.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on from the checkpoints in RUN/sampling.")]
SamplerOption = Annotated[
    str, typer.Option("--sampler", metavar="NAME", help="emcee, nuts, or your own as FILE.py:CLASS.")
]
MaximumOption = Annotated[int, typer.Option("--maximum-steps", min=1, help="Stop there, converged or not.")]
WalkersOption = Annotated[int, typer.Option("--walkers", min=0, help="Of an emcee ensemble; 0: at least 64.")]
IntervalOption = Annotated[int, typer.Option("--interval", min=1, help="Steps between checkpoints.")]
MovesOption = Annotated[str, typer.Option("--moves", help="Of emcee: laplace, de or stretch.")]
InflateOption = Annotated[bool, typer.Option("--inflate", help="Sample a factor on the errors of the data.")]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of random numbers.")]


def sample(
    run: RunArgument,
    resume: ResumeOption = False,
    model: ModelOption = None,
    sampler: SamplerOption = "emcee",
    inflate: InflateOption = False,
    maximum_steps: MaximumOption = 100_000,
    walkers: WalkersOption = 0,
    interval: IntervalOption = 500,
    moves: MovesOption = "laplace",
    overwrite: OverwriteOption = False,
    seed: SeedOption = 0,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Sample the posterior: RUN/posterior.nc, a intervals, figures; covariance into calibration.fits.

    Checkpoints lie in RUN/sampling: an interrupted run goes on with --resume, bit for bit, and refuses if
    data, model, priors, sampler, settings or versions have changed. A chain that has not converged is written and
    marked so, with exit code 1; the covariance of the fit then stays in calibration.fits.
    """
    from walop_jax.calibration.product import read_product
    from walop_jax.io.errors import fail

    if not run.is_dir():
        raise CommandError(f"{run}: is not a folder; give the RUN of walop-jax refit")
    product = read_product(run / "calibration.fits")
    text = None if model is None else read_text(model)
    found = [name for name in OUTPUTS if (run / name).exists()]
    if found and not (overwrite or resume):
        raise fail(f"holds {found[0]} already", file=run, advice="go on with --resume, or --overwrite it")
    switch_on_jax()
    from walop_jax.posterior import Options
    from walop_jax.posterior import sample as sample_posterior
    from walop_jax.posterior.checkpoint import Checkpoints
    from walop_jax.posterior.from_run import problem_of_run

    options = Options(
        sampler=sampler,
        seed=seed,
        walkers=walkers,
        interval=interval,
        maximum_steps=maximum_steps,
        moves=moves,
        inflate=inflate,
    )
    with _bar(quiet or json) as tell:
        problem, result = problem_of_run(product, run, text)
        if overwrite and not resume:
            Checkpoints(run / CHAINS, {}).clear()
        found = sample_posterior(problem, result, options, folder=run / CHAINS, resume=resume, report=tell)
    summary = _write(run, product, found)
    if json:
        print_json(summary)
    for sentence in found.warnings:
        warn(sentence)
    if not (json or quiet):
        _show(found)
    if not found.trusted:
        raise CommandError(
            f"{run}: the posterior is not to be believed yet; calibration.fits keeps its covariance"
        )


def _write(run: Path, product: CalibrationProduct, found: PosteriorSample) -> dict[str, Any]:
    import numpy as np

    from walop_jax.calibration.calibration import Calibration
    from walop_jax.calibration.product import write_product
    from walop_jax.io.folder import atomic_folder
    from walop_jax.io.plain_tables import write_columns
    from walop_jax.posterior.output import intervals, report, write_posterior
    from walop_jax.reports.posterior_figures import corner_figure, save_figure, trace_figure

    summary = report(found)
    units = [dict(zip(found.names, found.units, strict=True)).get(name, "") for name in found.sampled]
    k = [found.names.index(name) for name in found.sampled if name in found.names]
    flat = found.draws.reshape(-1, len(found.names))[:, k]
    if found.ln_f is not None:
        flat = np.concatenate([flat, found.ln_f.reshape(-1, 1)], axis=1)
    notes = {"TRUSTED": found.trusted, "STEPS": found.convergence.steps}
    names = OUTPUTS + (("calibration.fits",) if found.trusted else ())
    with atomic_folder(run, names, overwrite=True) as folder:
        write_posterior(folder / OUTPUTS[0], found)
        for name in OUTPUTS[1:3]:
            write_columns(folder / name, intervals(found), notes)
        save_figure(folder / OUTPUTS[3], corner_figure(flat, found.sampled, units))
        trace = trace_figure(found.chains, found.sampled, units, found.thin, found.convergence.tau)
        save_figure(folder / OUTPUTS[4], trace)
        (folder / OUTPUTS[5]).write_text(json_text(summary), encoding="utf-8")
        if found.trusted:
            calibration = Calibration.from_product(product)
            verdict = dataclasses.replace(calibration.verdict, covariance_from="posterior")
            sampled = dataclasses.replace(calibration, covariance=found.covariance, verdict=verdict)
            write_product(folder / "calibration.fits", sampled.to_product())
    return summary


@contextlib.contextmanager
def _bar(quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """A progress bar with τ and ESS: on a terminal only, on stderr, gone at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield lambda progress: None
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[numbers]}"),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("preparing the fit", total=None, numbers="")

        def tell(progress: Progress) -> None:
            numbers = "" if progress.tau != progress.tau else f"τ {progress.tau:.1f}, ESS {progress.ess:.0f}"
            bar.update(task, description=progress.stage, completed=progress.share, total=1.0, numbers=numbers)

        yield tell


def _show(found: PosteriorSample) -> None:
    from rich.console import Console
    from rich.table import Table

    from walop_jax.posterior.output import intervals

    columns = {name: values for name, (values, _, _) in intervals(found).items()}
    table = Table("coefficient", "median", "68 %", "95 %", "unit", "ESS")
    for i, name in enumerate(columns["NAME"]):
        if name not in found.sampled:
            continue
        spans = [
            f"{columns['LOW' + level][i]:.7g} … {columns['HIGH' + level][i]:.7g}" for level in ("68", "95")
        ]
        table.add_row(
            name, f"{columns['MEDIAN'][i]:.7g}", *spans, columns["UNIT"][i], f"{columns['ESS'][i]:.0f}"
        )
    console = Console(highlight=False)
    console.print(table)
    console.print(found.convergence.message(), soft_wrap=True)
    console.print(f"{found.comparison}; {found.seconds:.0f} s", soft_wrap=True)

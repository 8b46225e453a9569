"""`walop-jax sample`: the posterior around the fit of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import (
    UNTRUSTED,
    CommandError,
    EffectsOption,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    print_json,
    switch_on_jax,
    warn,
)

if TYPE_CHECKING:
    from walop_jax.posterior import PosteriorSample, Progress

RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a `walop-jax refit`.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on from the checkpoints in RUN/sampling.")]
SamplerOption = Annotated[
    str, typer.Option("--sampler", metavar="NAME", help="emcee, nuts, or your own as FILE.py:CLASS.")
]
MaximumOption = Annotated[
    int,
    typer.Option(
        "--maximum-steps", min=1, help="Stop there at the latest, converged or not; a multiple of --interval."
    ),
]
WalkersOption = Annotated[
    int, typer.Option("--walkers", min=0, help="Walkers of an emcee ensemble; 0: at least 64.")
]
IntervalOption = Annotated[int, typer.Option("--interval", min=1, help="Steps between checkpoints.")]
MovesOption = Annotated[str, typer.Option("--moves", help="Moves of emcee: laplace, de or stretch.")]
InflateOption = Annotated[bool, typer.Option("--inflate", help="Sample a factor on the errors of the data.")]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of random numbers.")]


def sample(
    run: RunArgument,
    resume: ResumeOption = False,
    model: ModelOption = None,
    effects: EffectsOption = None,
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
    """Sample the posterior: RUN/posterior.nc, intervals and figures; the covariance goes into calibration.fits.

    Checkpoints lie in RUN/sampling: an interrupted run goes on with --resume, bit for bit, and refuses if
    data, model, priors, sampler, settings or versions have changed. A chain that has not converged is written and
    marked so, with exit code 1; the covariance of the fit then stays in calibration.fits.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.posterior import Options
    from walop_jax.runs.sample import sample_run

    options = Options(
        sampler=sampler,
        seed=seed,
        walkers=walkers,
        interval=interval,
        maximum_steps=maximum_steps,
        moves=moves,
        inflate=inflate,
    )
    with _bar(quiet or json) as progress:
        found = sample_run(
            run,
            options,
            model=model,
            resume=resume,
            overwrite=overwrite,
            progress=progress,
            catalogue=catalogue_with(effects),
        )
    if json:
        print_json(found.summary)
    for sentence in found.posterior.warnings:
        warn(sentence)
    if not (json or quiet):
        _show(found.posterior)
    if not found.posterior.sampled_well:
        raise CommandError(f"{run}: the posterior has not converged; calibration.fits keeps its covariance")
    if not found.posterior.trusted:
        raise typer.Exit(UNTRUSTED)


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
    typer.echo(found.display().text())
    typer.echo(f"{found.seconds:.0f} s")

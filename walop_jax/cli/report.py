"""`walop-jax report`: one self-contained page about a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    EffectsOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
)

RunArgument = Annotated[
    Path, typer.Argument(metavar="RUN", help="Folder of refit, diagnose, compare, epoch or limits.")
]
OutputOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FILE", help="Page to write (default: RUN/report.html)."),
]
STAGES = ("reading", "drawing")


def report(
    run: RunArgument,
    output: OutputOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write one HTML page about a run, figures inside: it needs no network and no other file, and can be mailed or
    printed.

    The verdict, the accuracy of p over the field, what the data were, what was found, residuals before and after, maps
    of the matrix and of its errors, pulls from the priors, all parameters, warnings, inputs and versions, as far as RUN
    holds them; the page says what is missing. What sample and limits have put into RUN is there as
    well; compare, epoch and limits have pages of their own. A page that exists is made anew; another file of that
    name is left alone unless --overwrite is given.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.report import write_report

    with progress(quiet or json, STAGES) as tell:
        page = write_report(
            run, output, overwrite=overwrite, catalogue=catalogue_with(effects), progress=tell
        )
    if json:
        print_json(page.document())
    elif not quiet:
        typer.echo(f"{page.path}: {page.length / 1e6:.1f} MB")
        for sentence in page.missing:
            typer.echo(f"  {sentence}")

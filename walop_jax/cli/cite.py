"""`walop-jax cite`: where the physics of a model comes from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    EffectsOption,
    JsonOption,
    QuietOption,
    print_json,
    switch_on_jax,
)

Run = Annotated[
    Path | None,
    typer.Argument(metavar="[RUN]", help="Run, or its calibration.fits; default: the base model."),
]


BibtexOption = Annotated[bool, typer.Option("--bibtex", help="As BibTeX entries.")]


def cite(
    run: Run = None,
    bibtex: BibtexOption = False,
    effects: EffectsOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """List the sources of the physics in a fitted model, effects included."""
    del quiet  # the list is all there is
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.cite import cite_run

    found = cite_run(run, catalogue_with(effects))
    if json:
        print_json([{"what": entry.what, "source": entry.source} for entry in found])
        return
    if bibtex:
        from walop_jax import __version__
        from walop_jax.model.bibtex import bibtex as entries

        typer.echo(entries(found, __version__), nl=False)
        return
    for entry in found:
        typer.echo(f"{entry.what}: {entry.source}")

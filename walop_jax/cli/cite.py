"""`walop-jax cite`: where the physics of a model comes from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    EffectsOption,
    JsonOption,
    QuietOption,
    SeedOption,
    print_json,
    switch_on_jax,
)

Run = Annotated[
    Path | None,
    typer.Argument(metavar="[RUN]", help="Run, or its calibration.fits; default: the base model."),
]


def cite(
    run: Run = None,
    effects: EffectsOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
    seed: SeedOption = None,
) -> None:
    """List the sources of the physics in a fitted model, effects included."""
    del quiet, seed  # the list is all there is, and nothing is random
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.cite import cite_run

    found = cite_run(run, catalogue_with(effects))
    if json:
        print_json([{"what": entry.what, "source": entry.source} for entry in found])
        return
    for entry in found:
        typer.echo(f"{entry.what}: {entry.source}")

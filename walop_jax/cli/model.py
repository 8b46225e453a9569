"""`walop-jax model`: the model as a file to look at and to change."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    EffectsOption,
    InstrumentOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    print_json,
    switch_on_jax,
)

Sets = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[CALSET...]", help="Calibration sets that the model is for: standards, gauges."),
]
OutputOption = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="MODEL.toml", help="File to write; default: stdout.")
]
EffectOption = Annotated[
    list[str] | None, typer.Option("--effect", metavar="NAME", help="Add an effect; may be repeated.")
]


def model(
    calsets: Sets = None,
    output: OutputOption = None,
    instrument: InstrumentOption = None,
    effect: EffectOption = None,
    own: EffectsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the base model as a file: every parameter with unit, start, prior, free or not.

    With calibration sets, the model that `refit` would fit to them. Change the file and give it to
    `refit --model`.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.model import write_model

    made = write_model(
        output,
        calsets or (),
        instrument=instrument,
        effects=effect or (),
        overwrite=overwrite,
        catalogue=catalogue_with(own),
    )
    if json:
        print_json(made.document())
    elif output is None:
        typer.echo(made.text, nl=False)
    elif not quiet:
        typer.echo(f"{output}: {len(made.model.parameters)} parameters, {len(made.model.free)} of them free")

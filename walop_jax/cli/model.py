"""`walop-jax model`: the model as a file to look at and to change."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    JsonOption,
    OverwriteOption,
    QuietOption,
    SeedOption,
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
InstrumentOption = Annotated[
    str | None, typer.Option("--instrument", help="WALOP-SOUTH (default), WALOP-NORTH or WALOP-LAB.")
]
EffectOption = Annotated[
    list[str] | None, typer.Option("--effect", metavar="NAME", help="Add an effect; may be repeated.")
]


def model(
    calsets: Sets = None,
    output: OutputOption = None,
    instrument: InstrumentOption = None,
    effect: EffectOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the base model as a file: every parameter with unit, start, prior, free or not.

    With calibration sets, the model that `refit` would fit to them. Change the file and give it to
    `refit --model`.
    """
    del seed  # nothing is random here
    if calsets and instrument:
        raise typer.BadParameter("the calibration sets say which instrument it is", param_hint="--instrument")
    from walop_jax.io.atomic import atomic_path, check_output

    if output is not None:
        check_output(output, overwrite=overwrite)
    switch_on_jax()
    from walop_jax.fit.model_builder import effects_text, model_for, model_without_data
    from walop_jax.fit.model_file import render

    text = effects_text(effect or [])
    if calsets:
        from walop_jax.data import read_calibration_set

        made = model_for(read_calibration_set(*calsets), text)
    else:
        made = model_without_data(instrument or "WALOP-SOUTH", text)
    rendered = render(made)
    if output is not None:
        with atomic_path(output, overwrite=overwrite) as temporary:
            temporary.write_text(rendered, encoding="utf-8")
    if json:
        print_json(
            {
                "instrument": made.name,
                "effects": list(made.effect_names),
                "output": None if output is None else str(output),
                "parameters": {
                    p.name: {
                        "start": p.start,
                        "unit": p.unit,
                        "prior": None if p.prior is None else list(p.prior),
                        "free": p.free,
                        "tie": p.tie,
                        "about": p.about,
                    }
                    for p in made.parameters
                },
            }
        )
    elif output is None:
        typer.echo(rendered, nl=False)
    elif not quiet:
        typer.echo(f"{output}: {len(made.parameters)} parameters, {len(made.free)} of them free")

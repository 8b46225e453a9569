"""`walop-jax plot`: a figure of a run by name."""

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
    Path | None, typer.Argument(metavar="[RUN]", help="Folder of results; none: list the figures.")
]
NameArgument = Annotated[str | None, typer.Argument(metavar="[NAME]", help="The figure.")]
OutputOption = Annotated[
    Path | None,
    typer.Option(
        "--output", "-o", metavar="FILE", help="File to write: .pdf, .png, .svg (default: NAME.png)."
    ),
]
ParametersOption = Annotated[
    str | None,
    typer.Option("--parameters", metavar="A,B,…", help="Coefficients of a corner or trace plot, by name."),
]
XOption = Annotated[float, typer.Option("--x", help="Field point of transmission and modulation, X (deg).")]
YOption = Annotated[float, typer.Option("--y", help="The same, Y (deg).")]


def plot(
    run: RunArgument = None,
    name: NameArgument = None,
    output: OutputOption = None,
    parameters: ParametersOption = None,
    x: XOption = 0.0,
    y: YOption = 0.0,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Draw a figure of a run, by name, as a file.

    Without a name the figures are listed: accuracy of p over the field, maps of the matrix and of the retardance of the
    half-wave plates, camera transmissions, corner plots, and others. The format follows the name of the file.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.reports.named import FIGURES
    from walop_jax.runs.plot import plot_figure

    if run is None or name is None:
        listed = {key: entry.about for key, entry in FIGURES.items()}
        if json:
            print_json(listed)
        else:
            for key, about in listed.items():
                typer.echo(f"{key:<{max(map(len, listed))}}  {about}")
        return
    with progress(quiet or json) as tell:
        path = plot_figure(
            run,
            name,
            output or Path(f"{name}.png"),
            parameters=[part.strip() for part in (parameters or "").split(",") if part.strip()],
            place=(x, y),
            overwrite=overwrite,
            catalogue=catalogue_with(effects),
            progress=tell,
        )
    if json:
        print_json({"figure": name, "output": str(path)})
    elif not quiet:
        typer.echo(str(path))

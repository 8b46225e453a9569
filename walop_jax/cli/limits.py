"""`walop-jax limits`: what a calibration set can show, before anything is found in it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    EffectsOption,
    InstrumentOption,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    SeedOption,
    print_json,
    progress,
    switch_on_jax,
    warn,
)

STAGES = ("reading", "fit", "differentiating", "comparing", "finding what goes")


def limits(
    calsets: Annotated[
        list[Path],
        typer.Argument(
            metavar="CALSET...|PLAN.toml",
            help="Calibration sets (FITS), fitted as one, or an observing plan in place of them.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="RUN",
            help="Folder for limits.json and its two figures; it may be that of a fit of the same sets.",
        ),
    ] = None,
    model: ModelOption = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Say at which size every effect of the catalogue would be detected and named in calibration sets.

    And what those may be that are too small: the largest error of q and u that a single effect can make over
    the field without being detected. An observing plan (TOML, see walop-jax docs files) says the same before any
    data are taken.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.limits import limits_of_sets

    with progress(quiet or json, STAGES) as tell:
        run = limits_of_sets(
            calsets,
            output,
            model=model,
            instrument=instrument,
            seed=seed,
            overwrite=overwrite,
            catalogue=catalogue_with(effects),
            progress=tell,
        )
    if json:
        print_json(run.document)
    for sentence in run.warnings:
        warn(sentence)
    if not (json or quiet):
        typer.echo(run.found.display().text())

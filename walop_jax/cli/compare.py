"""`walop-jax compare`: the published method and the joint model on the same calibration set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    CalsetFiles,
    EffectsOption,
    InstrumentOption,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    RunFolder,
    SeedOption,
    print_json,
    progress,
    switch_on_jax,
    warn,
)

TruthOption = Annotated[
    Path | None,
    typer.Option("--truth", metavar="TABLE", help="True X, Y, M21 … M33 (FITS, CSV), for simulated sets."),
]
FilterOption = Annotated[str, typer.Option("--filter", metavar="NAME", help="Filter to compare in.")]
STAGES = ("reading", "fitting the joint model", "fitting and judging")


def compare(
    calsets: CalsetFiles,
    output: RunFolder,
    truth: TruthOption = None,
    filter_name: FilterOption = "SDSS-r",
    model: ModelOption = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Compare the method of Paper II, as it is published, with the joint fit.

    A quadratic per grid point, a transmission model per camera, 100 stars with p up to 5 %, corrections Δq and
    Δu; on the grid points and between them. The reference is the joint model, or the truth that comes with a
    simulated set. RUN/comparison.json has the statistics, comparison.fits every point, four figures the rest: also
    the spectral appendix and the full-Moon scheme.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.compare import compare_methods

    with progress(quiet or json, STAGES) as tell:
        found = compare_methods(
            calsets,
            output,
            truth=truth,
            filter_name=filter_name,
            model=model,
            instrument=instrument,
            seed=seed,
            overwrite=overwrite,
            progress=tell,
            catalogue=catalogue_with(effects),
        )
    for sentence in found.warnings:
        warn(sentence)
    if json:
        print_json(found.document)
    elif not quiet:
        typer.echo(found.comparison.display().text())
        typer.echo(str(output))

"""`walop-jax limits`: what a calibration set can show, before anything is found in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import (
    CalsetFiles,
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

if TYPE_CHECKING:
    from walop_jax.diagnosis.detection_limits import DetectionLimit, DetectionLimits


def limits(
    calsets: CalsetFiles,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="RUN", help="Folder for limits.json and its two figures."),
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
    the field without being detected. A set made by walop-jax simulate says what an observing plan is worth.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.limits import limits_of_sets

    with progress(quiet or json) as tell:
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
        _show(run.found)


def _show(found: DetectionLimits) -> None:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    table = Table(
        "effect", "parameter", "unit", "detected", "named alone", "error of q, u (%)", "may be taken for"
    )
    for entry in found.limits:
        table.add_row(
            entry.effect, entry.parameter, entry.unit, _range(entry), f"{entry.named:.2g}",
            " to ".join(f"{100 * e:.3f}" for e in entry.error_of_qu if np.isfinite(e)), ", ".join(entry.taken_for),
        )  # fmt: skip
    console = Console(highlight=False)
    console.print(table)
    if np.isfinite(found.protection).any():
        worst = int(np.nanargmax(found.protection))
        console.print(
            "largest error of q and u that a single effect can make undetected: "
            f"{100 * np.nanmax(found.protection):.3f} % at ({found.x[worst]:+.3f}, {found.y[worst]:+.3f}) deg "
            f"({found.caused_by[worst]}); median over the field {100 * np.nanmedian(found.protection):.3f} %",
            soft_wrap=True,
        )
    if found.untestable:
        console.print(f"cannot be seen in these data: {', '.join(found.untestable)}", soft_wrap=True)


def _range(entry: DetectionLimit) -> str:
    low, high = entry.detected
    return f"{low:.2g}" if high < 1.05 * low else f"{low:.2g} to {high:.2g}"

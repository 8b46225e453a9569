"""`walop-jax epoch`: does last month's calibration still fit, and what has moved?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import (
    UNTRUSTED,
    CalsetFiles,
    EffectsOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
    warn,
)

if TYPE_CHECKING:
    from walop_jax.runs.epoch import EpochComparison

OldProduct = Annotated[
    Path, typer.Argument(metavar="OLD", help="Old calibration product, or folder of a run.")
]


OutputOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="RUN", help="Folder for the new calibration and what was found."),
]

STAGES = ("reading", "fitting the new set", "looking for what")


def epoch(
    old: OldProduct,
    calsets: CalsetFiles,
    output: OutputOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Fit new calibration sets and compare with an old calibration: is the instrument still the same?

    Lists the parameters by how far they have moved, tests all of them together, and says how far off stars would be if
    the old calibration were still used. The new fit is that of the old model: plates, effects, priors and what is
    held. Where that does not explain the new data, what is missing is looked for as walop-jax diagnose does.

    Exit code 0 only where the old calibration still holds; 3 where something has moved, or where the new fit is not
    to be trusted.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.epoch import compare_epochs

    with progress(quiet or json, STAGES) as tell:
        compared = compare_epochs(
            old, calsets, output=output, overwrite=overwrite, progress=tell, catalogue=catalogue_with(effects)
        )
    if json:
        print_json(compared.document())
    for sentence in compared.found.warnings:
        warn(f"the new fit: {sentence}")
    if not (json or quiet):
        _show(compared)
    if not compared.found.holds:
        raise typer.Exit(UNTRUSTED)


def _show(compared: EpochComparison) -> None:
    typer.echo(compared.found.display().text())
    if compared.diagnosis is not None:
        named = ", ".join(step.effect for step in compared.diagnosis.steps) or "nothing that has a name"
        typer.echo(f"what the new fit lacks: {named} ({compared.diagnosis.verdict})")

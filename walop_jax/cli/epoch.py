"""`walop-jax epoch`: does last month's calibration still fit, and what has moved?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import (
    UNTRUSTED,
    CalsetFiles,
    JsonOption,
    OverwriteOption,
    QuietOption,
    SeedOption,
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
_SHOWN = 8


def epoch(
    old: OldProduct,
    calsets: CalsetFiles,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="RUN", help="Folder for the fit of the new sets.")
    ] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
    seed: SeedOption = None,
) -> None:
    """Fit new calibration sets and compare with an old calibration: is the instrument still the same?

    Parameters by how far they moved, a test over all of them together, and by how much stars would be off if
    the old calibration were used on. The new fit is that of the old model: plates, effects, priors and what is held.
    Where that does not explain the new data, what is missing is looked for as walop-jax diagnose does.

    Exit code 0 only where the old calibration still holds; 3 where something has moved, or where the new fit is
    not to be trusted.
    """
    del seed  # nothing is random
    switch_on_jax()
    from walop_jax.runs.epoch import compare_epochs

    with progress(quiet or json) as tell:
        compared = compare_epochs(old, calsets, output, overwrite=overwrite, progress=tell)
    if json:
        print_json(compared.document())
    for sentence in compared.found.warnings:
        warn(f"the new fit: {sentence}")
    if not (json or quiet):
        _show(compared)
    if not compared.found.holds:
        raise typer.Exit(UNTRUSTED)


def _show(compared: EpochComparison) -> None:
    from rich.console import Console
    from rich.table import Table

    found = compared.found
    table = Table("parameter", "old", "new", "change / σ", "unit")
    for entry in found.moved[:_SHOWN]:
        table.add_row(entry.name, f"{entry.old:.7g}", f"{entry.new:.7g}", f"{entry.z:+.1f}", entry.unit)
    console = Console(highlight=False)
    console.print(table)
    said = "still fits" if found.holds else "cannot be said" if found.fits else "HAS CHANGED"
    console.print(
        f"{said}: chance {found.p_value:.2g} (χ² = {found.test:.1f} in {found.directions} directions); with the old "
        f"calibration stars are off by {found.star_errors['p']['median']:.4f} % in p (median), "
        f"{found.star_errors['p']['max']:.3f} % at most",
        soft_wrap=True,
    )
    if compared.diagnosis is not None:
        named = ", ".join(step.effect for step in compared.diagnosis.steps) or "nothing that has a name"
        console.print(f"what the new fit lacks: {named} ({compared.diagnosis.verdict})", soft_wrap=True)

"""`walop-jax epoch`: does last month's calibration still fit, and what has moved?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import (
    CalsetFiles,
    EffectsOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
)

if TYPE_CHECKING:
    from walop_jax.science.epoch import Epoch

OldProduct = Annotated[
    Path, typer.Argument(metavar="OLD", help="Old calibration product, or folder of a run.")
]


OutputOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="RUN", help="Folder for the new calibration and what was found."),
]


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
    the old calibration were still used. The new fit has the effects of the old model.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.epoch import compare_epochs

    with progress(quiet or json) as tell:
        compared = compare_epochs(
            old, calsets, output=output, overwrite=overwrite, progress=tell, catalogue=catalogue_with(effects)
        )
    if json:
        print_json(compared.document())
    elif not quiet:
        _show(compared.found)


def _show(found: Epoch) -> None:
    typer.echo(found.display().text())

"""`walop-jax epoch`: does last month's calibration still fit, and what has moved?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import (
    CalsetFiles,
    EffectsOption,
    JsonOption,
    QuietOption,
    SeedOption,
    print_json,
    progress,
    switch_on_jax,
)

if TYPE_CHECKING:
    from walop_jax.science.epoch import Epoch

OldProduct = Annotated[
    Path, typer.Argument(metavar="OLD", help="Old calibration product, or folder of a run.")
]
_SHOWN = 8


def epoch(
    old: OldProduct,
    calsets: CalsetFiles,
    effects: EffectsOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
    seed: SeedOption = None,
) -> None:
    """Fit new calibration sets and compare with an old calibration: is the instrument still the same?

    Parameters by how far they moved, a test over all of them together, and by how much stars would be off if
    the old calibration were used on. The effects of the old model are those of the new fit.
    """
    del seed  # nothing is random
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.epoch import compare_epochs

    with progress(quiet or json) as tell:
        compared = compare_epochs(old, calsets, progress=tell, catalogue=catalogue_with(effects))
    if json:
        print_json(compared.document())
    elif not quiet:
        _show(compared.found)


def _show(found: Epoch) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("parameter", "old", "new", "change in errors of the change", "unit")
    for entry in found.moved[:_SHOWN]:
        table.add_row(entry.name, f"{entry.old:.7g}", f"{entry.new:.7g}", f"{entry.z:+.1f}", entry.unit)
    console = Console(highlight=False)
    console.print(table)
    console.print(
        f"{'still fits' if found.fits else 'HAS CHANGED'}: chance {found.p_value:.2g} (χ² = {found.test:.1f} in "
        f"{found.directions} directions); with the old calibration stars are off by "
        f"{found.star_errors['p']['median']:.4f} % in p (median), {found.star_errors['p']['max']:.3f} % at most",
        soft_wrap=True,
    )

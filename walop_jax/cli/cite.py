"""`walop-jax cite`: where the physics of a model comes from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    JsonOption,
    QuietOption,
    SeedOption,
    named,
    print_json,
    product_path,
    switch_on_jax,
)

Run = Annotated[
    Path | None,
    typer.Argument(metavar="[RUN]", help="Run, or its calibration.fits; default: the base model."),
]


def cite(
    run: Run = None, json: JsonOption = False, quiet: QuietOption = False, seed: SeedOption = None
) -> None:
    """List the sources of the physics in a fitted model, effects included."""
    del quiet, seed  # the list is all there is, and nothing is random
    from walop_jax.calibration.product import read_product

    held = None if run is None else read_product(product_path(run))
    switch_on_jax()
    from walop_jax.calibration.calibration import rebuild
    from walop_jax.fit import solver
    from walop_jax.fit.model_builder import model_without_data
    from walop_jax.model.references import Reference, references, stated_source

    with named(run):
        model = model_without_data("WALOP-SOUTH") if held is None else rebuild(held)
    found = [*references(model), Reference("fit", stated_source(solver.__doc__))]
    if json:
        print_json([{"what": entry.what, "source": entry.source} for entry in found])
        return
    for entry in found:
        typer.echo(f"{entry.what}: {entry.source}")

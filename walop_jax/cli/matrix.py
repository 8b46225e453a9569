"""`walop-jax matrix`: the instrument matrix and its errors at the field points of a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    EffectsOption,
    JsonOption,
    OutputTable,
    OverwriteOption,
    PosteriorOption,
    Product,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
    warn,
)

PointsOption = Annotated[
    Path, typer.Option("--points", metavar="TABLE", help="FITS, CSV or ECSV with X, Y in degrees.")
]


def matrix(
    product: Product,
    points: PointsOption,
    output: OutputTable,
    posterior: PosteriorOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Add M21, M22, M23, M31, M32, M33 and their errors to a table of field points (three for each arm).

    X and Y in degrees; optional TEFF, FILTER, TEMP, HA (absent: flat spectrum, SDSS-r, 10 Celsius, on the
    meridian), and CHWP_ANGLE, CHWP_IN, or those of any other moving element of the instrument (absent: out).

    FLAG is added: 16 high cross-talk (a single exposure can hardly be inverted there), 32 beyond the field
    points of the calibration, 64 filter or temperature that the calibration has not seen. Beyond the field
    of the instrument (0.35 degrees for the WALOPs) there is no value: NaN and FLAG 32.
    """
    switch_on_jax()
    from walop_jax.fit.verdict import Quality
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.matrix import tabulate_matrix

    with progress(quiet or json) as tell:
        found = tabulate_matrix(
            product,
            points,
            output,
            posterior=posterior,
            overwrite=overwrite,
            progress=tell,
            catalogue=catalogue_with(effects),
        )
    for sentence in found.warnings:
        warn(sentence)
    if json:
        print_json(found.document())
    elif not quiet:
        high = found.flags[Quality.HIGH_CROSSTALK]
        typer.echo(f"{output}: {found.rows} rows, {high} of them in zones of high cross-talk")

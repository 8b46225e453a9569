"""`walop-jax matrix`: the instrument matrix and its errors at the field points of a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    JsonOption,
    OutputTable,
    OverwriteOption,
    PosteriorOption,
    Product,
    QuietOption,
    SeedOption,
    named,
    print_json,
    product_path,
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
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Add M21, M22, M23, M31, M32, M33 and their errors to a table of field points.

    X and Y in degrees; optional TEFF, CHWP_IN, CHWP_ANGLE, FILTER, TEMP, HA (absent: flat spectrum,
    calibration plate out, SDSS-r, 10 Celsius, on the meridian).

    FLAG is added: 16 high cross-talk (a single exposure can hardly be inverted there), 32 beyond the field
    points of the calibration, 64 filter or temperature that the calibration has not seen. Beyond the field
    of the instrument (0.35 degrees) there is no value: NaN and FLAG 32.
    """
    del seed  # nothing is random here
    from walop_jax.calibration.product import read_product
    from walop_jax.data.user_tables import field_points, read_input_table, table_format, write_output_table
    from walop_jax.io.atomic import check_output

    table_format(output)
    check_output(output, overwrite=overwrite)
    path = product_path(product)
    held = read_product(path)
    table = read_input_table(points)
    wanted = field_points(table, held.instrument)

    switch_on_jax()
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.calibration.matrix import Settings
    from walop_jax.calibration.matrix_table import matrix_columns

    with progress(quiet or json) as tell:
        tell("working out the matrix")
        with named(path):
            calibration = Calibration.from_product(held)
        if posterior is not None:
            from walop_jax.posterior.propagate import with_draws

            calibration = with_draws(calibration, posterior)
        settings = Settings(wanted.filter, wanted.teff, wanted.chwp_angle, wanted.temp, wanted.ha)
        with named(points):
            columns = matrix_columns(calibration, wanted.x, wanted.y, settings, wanted.outside)
        write_output_table(output, table, columns, overwrite=overwrite)

    flag = columns["FLAG"][0]
    counts = {bit: int((flag & bit > 0).sum()) for bit in (16, 32, 64)}
    if not held.verdict.trusted:
        warn(f"{path}: this calibration is not trusted: {'; '.join(held.verdict.warnings) or 'see WARNINGS'}")
    if counts[32]:
        warn(f"{points}: {counts[32]} point(s) beyond the calibrated field: extrapolated, or NaN (FLAG 32)")
    if counts[64]:
        warn(f"{points}: {counts[64]} row(s) with a filter or temperature not in the calibration (FLAG 64)")
    if json:
        print_json(
            {
                "output": str(output),
                "rows": table.rows,
                "trusted": held.verdict.trusted,
                "flags": {str(bit): count for bit, count in counts.items()},
                "product": held.content_hash(),
            }
        )
    elif not quiet:
        typer.echo(f"{output}: {table.rows} rows, {counts[16]} of them in zones of high cross-talk")

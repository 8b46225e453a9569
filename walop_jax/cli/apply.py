"""`walop-jax apply`: a science catalogue of intensities in, Stokes parameters with errors out."""

from __future__ import annotations

import time
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

CatalogueFile = Annotated[
    Path, typer.Argument(metavar="CATALOGUE", help="FITS, CSV or ECSV with X, Y, N, N_ERR.")
]
DebiasOption = Annotated[
    str,
    typer.Option("--debias", metavar="MAS|WK", help="Estimator of P_DEBIASED: Plaszczynski et al. 2014, or "
                 "Wardle and Kronberg 1974."),
]  # fmt: skip
SaturationOption = Annotated[
    float | None,
    typer.Option("--saturation", metavar="ELECTRONS", help="Counts from here on are not used (FLAG 256)."),
]


def apply(
    product: Product,
    catalogue: CatalogueFile,
    output: OutputTable,
    debias: DebiasOption = "MAS",
    saturation: SaturationOption = None,
    posterior: PosteriorOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Turn the four intensities of stars into Stokes parameters: Q, U, P, EVPA and their errors.

    X and Y in degrees, N and N_ERR (4) in electrons; optional ID, TEFF, CHWP_IN, CHWP_ANGLE, ROTATOR, N_FLAG,
    FILTER, TEMP, HA. Rows of one ID (and filter) are one star: they are combined, whatever the angle of the
    calibration plate, and all hold the same result. With ROTATOR the results are on the sky.

    Errors hold photon noise and calibration; Q_COLOUR and U_COLOUR say what ignoring TEFF does. FLAG: 16 a
    direction of (q, u) is hardly measured, 32 beyond the calibrated field (no result a quarter beyond), 64
    filter, temperature or colour that the calibration has not seen, 128 a camera is missing, 256 flagged or
    saturated counts, 16384 no result; bits of the calibration itself are added to all rows.
    """
    began = time.perf_counter()
    del seed  # nothing is random here
    from walop_jax.calibration.product import read_product
    from walop_jax.data.catalogue import read_catalogue
    from walop_jax.data.user_tables import read_input_table, table_format, write_output_table
    from walop_jax.io.atomic import check_output
    from walop_jax.science.polarisation import ESTIMATORS

    if debias not in ESTIMATORS:
        raise typer.BadParameter(f"{debias!r} is neither MAS nor WK", param_hint="--debias")
    if saturation is not None and not saturation > 0:
        raise typer.BadParameter("must be above 0 electrons", param_hint="--saturation")
    table_format(output)
    check_output(output, overwrite=overwrite)
    path = product_path(product)
    held = read_product(path)
    table = read_input_table(catalogue)
    rows = read_catalogue(table, held.instrument, float("inf") if saturation is None else saturation)

    switch_on_jax()
    import numpy as np

    from walop_jax.calibration.calibration import Calibration
    from walop_jax.science.apply import apply as stokes
    from walop_jax.science.apply import not_carried_over
    from walop_jax.science.stokes_columns import header, stokes_columns

    with progress(quiet or json) as tell:
        tell("tabulating the analysis vectors")
        with named(path):
            calibration = Calibration.from_product(held)
        if posterior is not None:
            from walop_jax.posterior.propagate import with_moments

            calibration = with_moments(calibration, posterior)
        with named(catalogue):
            stars = stokes(calibration, rows, lambda done, all_: tell(f"{done} of {all_} rows"))
        tell("writing")
        columns = stokes_columns(stars, rows.star, debias)
        cards = header(held.content_hash(), debias, float(np.mean(np.isfinite(rows.rotator))))
        write_output_table(output, table, columns, overwrite=overwrite, header=cards)

    counts = {bit: int((stars.flag & bit > 0).sum()) for bit in (16, 32, 64, 128, 256, 16384)}
    if not held.verdict.trusted:
        warn(f"{path}: this calibration is not trusted: {'; '.join(held.verdict.warnings) or 'see WARNINGS'}")
    for effect in not_carried_over(calibration):
        warn(
            f"{path}: {effect} of the calibration's exposures cannot be undone in a catalogue; it is left out"
        )
    if counts[16384]:
        warn(f"{catalogue}: {counts[16384]} star(s) without a result (FLAG 16384)")
    if counts[32]:
        warn(f"{catalogue}: {counts[32]} star(s) beyond the calibrated field: extrapolated, or NaN (FLAG 32)")
    if counts[64]:
        warn(f"{catalogue}: {counts[64]} star(s) with a filter, temperature or TEFF beyond the calibration")
    seconds = time.perf_counter() - began
    if json:
        print_json(
            {
                "output": str(output),
                "rows": table.rows,
                "stars": len(stars.qu),
                "seconds": seconds,
                "estimator": debias,
                "trusted": held.verdict.trusted,
                "flags": {str(bit): count for bit, count in counts.items()},
                "product": held.content_hash(),
            }
        )
    elif not quiet:
        typer.echo(f"{output}: {table.rows} rows, {len(stars.qu)} stars, {seconds:.1f} s")

"""`walop-jax apply`: a science catalogue of intensities in, Stokes parameters with errors out."""

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

ForceOption = Annotated[
    bool,
    typer.Option("--force", help="Also stars whose filter or temperature it does not cover (FLAG 2048)."),
]

STAGES = ("reading", "tabulating", "writing")


def apply(
    product: Product,
    catalogue: CatalogueFile,
    output: OutputTable,
    debias: DebiasOption = "MAS",
    saturation: SaturationOption = None,
    posterior: PosteriorOption = None,
    effects: EffectsOption = None,
    force: ForceOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Turn the intensities of stars into Stokes parameters: Q, U, P, EVPA and their errors.

    X and Y in degrees, N and N_ERR (one value per camera) in electrons; optional ID, TEFF, ROTATOR, N_FLAG,
    FILTER, TEMP, HA, and CHWP_ANGLE, CHWP_IN or those of any other moving element. Rows of one ID (and filter)
    are one star: they are combined, wherever the moving elements stand, and all hold the same result. With
    ROTATOR the results are on the sky. Two cameras see one combination of q and u: a star needs several settings.

    Errors hold photon noise and calibration; Q_COLOUR and U_COLOUR say what ignoring TEFF does. FLAG: 16 a
    direction of (q, u) is hardly measured, 32 beyond the calibrated field (no result a quarter beyond), 64
    filter, temperature or colour that the calibration has not seen, 128 a camera is missing, 256 flagged or
    saturated counts, 2048 used with --force, 16384 no result, 131072 intensities that disagree with the
    calibration by more than noise and half a per cent; bits of the calibration itself are added to all rows.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.apply import apply_to_catalogue
    from walop_jax.science.polarisation import ESTIMATORS

    if debias not in ESTIMATORS:
        raise typer.BadParameter(f"{debias!r} is neither MAS nor WK", param_hint="--debias")
    if saturation is not None and not saturation > 0:
        raise typer.BadParameter("must be above 0 electrons", param_hint="--saturation")
    with progress(quiet or json, STAGES) as tell:
        found = apply_to_catalogue(
            product,
            catalogue,
            output,
            estimator=debias,
            saturation=saturation,
            posterior=posterior,
            force=force,
            overwrite=overwrite,
            progress=tell,
            effects=catalogue_with(effects),
        )
    for sentence in found.warnings:
        warn(sentence)
    if json:
        print_json(found.document())
    elif not quiet:
        typer.echo(f"{output}: {found.rows} rows, {found.stars} stars, {found.seconds:.1f} s")

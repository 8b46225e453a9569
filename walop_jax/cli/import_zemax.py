"""`walop-jax import-zemax`: the text exports of an optical design program become a calibration set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    JsonOption,
    OverwriteOption,
    QuietOption,
    print_json,
    progress,
    warn,
)

Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help='Folder of "Polarization Transmission" text exports.')
]
OutputOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="CALSET", help="Calibration set to write (FITS).")
]
InstrumentOption = Annotated[
    str | None,
    typer.Option("--instrument", help="Which instrument; default: what the titles say."),
]
CamerasOption = Annotated[
    str,
    typer.Option(
        "--cameras", metavar="O1,E1,O2,E2", help="Configurations of the design that are the cameras."
    ),
]
ErrorOption = Annotated[
    float,
    typer.Option("--error", help="Error of a transmission, as a share of it: how far to trust the design."),
]


def import_zemax(
    folder: Folder,
    output: OutputOption,
    instrument: InstrumentOption = None,
    cameras: CamerasOption = "1,3,2,4",
    error: ErrorOption = 1e-3,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Make a calibration set (KIND flux) of the transmissions that an optical design program gives.

    All *.txt in FOLDER and below it are read, each once; every wavelength becomes a monochromatic filter.
    Configuration, state of polarisation and field points are read in the exports, not in their names.

    Rows that lack a camera are left out, transmissions of 0 are flagged, with a warning in both cases.
    """
    try:
        configurations = tuple(int(part) for part in cameras.split(","))
    except ValueError:
        configurations = ()
    if len(set(configurations)) != 4 or len(configurations) != 4:
        raise typer.BadParameter(
            f"{cameras!r} are not four different configurations, as in 1,3,2,4", param_hint="--cameras"
        )
    if not 0.0 <= error < 1.0:
        raise typer.BadParameter(f"{error} is not a share, as in 0.001", param_hint="--error")
    from walop_jax.instruments.description import shipped
    from walop_jax.io.errors import nearest
    from walop_jax.runs.import_zemax import import_folder

    if instrument is not None and instrument.upper() not in shipped():
        raise typer.BadParameter(
            f"there is no {instrument!r}: {nearest(instrument, shipped())}", param_hint="--instrument"
        )
    with progress(quiet or json) as tell:
        made = import_folder(
            folder,
            output,
            instrument=instrument,
            configurations=configurations,
            error=error,
            overwrite=overwrite,
            progress=tell,
        )
    for remark in made.remarks:
        warn(remark)
    if json:
        print_json(made.document())
    elif not quiet:
        typer.echo(
            f"{output}: {made.instrument}, {len(made.wavelengths)} wavelengths, {made.exposures} exposures of "
            f"{made.points} points, {made.rows} rows to use"
        )

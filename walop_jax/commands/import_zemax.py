"""`walop-jax import-zemax`: the text exports of an optical design program become a calibration set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from walop_jax.commands.command import Argument, Job, Option, Outcome, PathLike, UsageError, command
from walop_jax.commands.inputs import SetFile
from walop_jax.io.errors import nearest

if TYPE_CHECKING:
    from walop_jax import CalibrationSet

FOLDER = Argument('Folder of "Polarization Transmission" text exports.', "FOLDER", Path)
INSTRUMENT = Option("Which instrument; default: that of the titles.", kind=str)
CAMERAS = Option("Configurations of the design that are the cameras.", "O1,E1,O2,E2", str)
ERROR = Option("Error of a transmission, as a share of it: how far to trust the design.")


@command(writes="file", jax=False)
def import_zemax(
    job: Job,
    folder: Annotated[PathLike, FOLDER],
    *,
    output: SetFile = None,
    instrument: Annotated[str | None, INSTRUMENT] = None,
    cameras: Annotated[str | Sequence[int], CAMERAS] = "1,3,2,4",
    error: Annotated[float, ERROR] = 1e-3,
) -> Outcome[CalibrationSet]:
    """Make a calibration set (KIND flux) of the transmissions that an optical design program gives.

    All *.txt in FOLDER and below it are read, each once; every wavelength becomes a monochromatic filter.
    Configuration, state of polarisation and field points are read in the exports, not in their names.

    Rows that lack a camera are left out, transmissions of 0 are flagged, with a warning in both cases.

    In Python: the set; its `remarks` name the rows that were left out.

    >>> design = walop.import_zemax("exports")  # doctest: +SKIP
    """
    from walop_jax.data.write import write_calibration_set
    from walop_jax.data.zemax import import_transmissions
    from walop_jax.instruments.description import shipped

    try:
        configurations = tuple(
            int(text_of_one) for text_of_one in (cameras.split(",") if isinstance(cameras, str) else cameras)
        )
    except ValueError:
        configurations = ()
    if len(set(configurations)) != 4 or len(configurations) != 4:
        raise UsageError(f"{cameras!r} are not four different configurations, as in 1,3,2,4", "cameras")
    if not 0.0 <= error < 1.0:
        raise UsageError(f"{error} is not a share, as in 0.001", "error")
    if instrument is not None and instrument.upper() not in shipped():
        raise UsageError(f"there is no {instrument!r}; {nearest(instrument, shipped())}", "instrument")
    design = import_transmissions(
        folder, instrument=instrument, configurations=configurations, error=error, tell=job.tell
    )
    job.tell("writing")
    if output is not None:
        write_calibration_set(output, design, overwrite=job.overwrite)
    document = {
        "output": output,
        "instrument": design.instrument,
        "wavelengths": [float(curve.wavelength[0]) for curve in design.filters.values()],
        "exposures": len(design.exposures),
        "points": len(design.points),
        "rows": design.intensities.rows,
        "remarks": list(design.remarks),
    }
    text = (
        f"{output}: {design.instrument}, {len(document['wavelengths'])} wavelengths, {document['exposures']} exposures "
        f"of {document['points']} points, {document['rows']} rows to use"
    )
    return Outcome(design, document, text, warnings=design.remarks)

"""`walop-jax import-zemax`: the text exports of an optical design program become a calibration set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Outcome, PathLike, UsageError, command, typed
from walop_jax.io.errors import nearest

if TYPE_CHECKING:
    from walop_jax import CalibrationSet


@command(writes="file", jax=False)
def import_zemax(
    job: Job,
    folder: PathLike,
    *,
    output: PathLike | None = None,
    instrument: str | None = None,
    cameras: str | Sequence[int] = "1,3,2,4",
    error: float = 1e-3,
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
        configurations = tuple(map(int, cameras.split(",") if isinstance(cameras, str) else cameras))
    except ValueError:
        configurations = ()
    if len(set(configurations)) != 4 or len(configurations) != 4:
        raise UsageError(f"{cameras!r} are not four different configurations, as in 1,3,2,4", "cameras")
    if not 0.0 <= error < 1.0:
        raise UsageError(f"{error} is not a share, as in 0.001", "error")
    if instrument is not None and instrument.upper() not in shipped():
        raise UsageError(f"there is no {instrument!r}; {nearest(instrument, shipped())}", "instrument")
    options = {"instrument": instrument, "configurations": configurations, "error": error}
    design = import_transmissions(folder, **options, tell=job.tell)
    job.tell("writing")
    if output is not None:
        write_calibration_set(output, design, overwrite=job.overwrite)
    wavelengths = [float(curve.wavelength[0]) for curve in design.filters.values()]
    exposures, points, rows = len(design.exposures), len(design.points), design.intensities.rows
    document = {"output": output, "instrument": design.instrument, "wavelengths": wavelengths}
    document |= {"exposures": exposures, "points": points, "rows": rows, "remarks": list(design.remarks)}
    text = f"{output}: {design.instrument}, {len(wavelengths)} wavelengths, {exposures} exposures of {points} points"
    text += f", {rows} rows to use"
    refit = typed("refit", output, "-o", "RUN")
    return Outcome(design, document, text, warnings=design.remarks, next=(refit,))

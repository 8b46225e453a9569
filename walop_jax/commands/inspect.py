"""`walop-jax inspect`: contents and faults of calibration sets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Option, Outcome, command, typed
from walop_jax.commands.inputs import Sets, paths_of

if TYPE_CHECKING:
    from walop_jax.data.inspection import InspectedSets


OPTIONS = {
    "data": Option("Calibration sets (FITS).", metavar="CALSET...", kind=list[Path], placed=True),
}


@command(jax=False, options=OPTIONS)
def inspect(job: Job, data: Sets) -> Outcome[InspectedSets]:
    """List the contents and the faults of calibration sets.

    Each file by itself; then whether they can be fitted as one. Exit code 1 if any cannot be read or fitted.

    In Python: an `InspectedSets`; errors of a single file, and contradictions between files, are among its `faults`.

    >>> walop.inspect("night.fits").faults
    ()
    """
    from walop_jax import CalibrationSet
    from walop_jax.data.inspection import InspectedSets, inspect_files
    from walop_jax.instruments.description import shipped

    if isinstance(data, CalibrationSet):
        paths, inspected = (), InspectedSets.of(data)
    else:
        paths = paths_of(data)
        inspected = inspect_files(paths, job.tell)
    strange = any(inspection.instrument not in shipped() for inspection in inspected.inspections)
    needed = ("CALSET", "--instrument", "FILE.toml") if strange else paths
    return Outcome(
        inspected,
        text="\n".join(inspection.display().text() for inspection in inspected.inspections),
        failure="; ".join(inspected.faults),
        next=(typed("refit", *needed, "-o", "RUN"),),
    )

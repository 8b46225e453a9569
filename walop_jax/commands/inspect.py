"""`walop-jax inspect`: contents and faults of calibration sets."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Outcome, command, typed
from walop_jax.commands.inputs import Sets, paths_of
from walop_jax.commands.products import IN_MEMORY
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import DataError

if TYPE_CHECKING:
    from walop_jax.data.inspection import Inspection


@dataclasses.dataclass(frozen=True, repr=False)
class InspectedSets(Displayed):
    """An inspection of every file, or the error that it gave; one of all as one set; faults in words."""

    sets: tuple[tuple[str, Inspection | DataError], ...]
    joint: Inspection | None
    faults: tuple[str, ...]

    @property
    def inspections(self) -> tuple[Inspection, ...]:
        """Those that could be made, that of all sets together the last."""
        readable = [inspection for _, inspection in self.sets if not isinstance(inspection, DataError)]
        return (*readable, *(() if self.joint is None else (self.joint,)))

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        sets = [
            {"files": [path], "error": str(of)} if isinstance(of, DataError) else dataclasses.asdict(of)
            for path, of in self.sets
        ]
        return {"sets": sets, "joint": None if self.joint is None else dataclasses.asdict(self.joint)}

    def display(self) -> Display:
        """The first of the inspections."""
        return self.inspections[0].display() if self.inspections else Display("nothing that can be read")


@command(jax=False)
def inspect(job: Job, data: Sets) -> Outcome[InspectedSets]:
    """List the contents and the faults of calibration sets.

    Each file by itself; then whether they can be fitted as one. Exit code 1 if any cannot be read or fitted.

    In Python: an `InspectedSets`. Raises `DataError` only if the sets cannot be one: errors of a single file are
    among its faults.

    >>> walop.inspect("night.fits").faults
    ()
    """
    from walop_jax import CalibrationSet
    from walop_jax.data.calset import read_calibration_set
    from walop_jax.data.inspection import inspect as inspection_of
    from walop_jax.instruments.description import shipped

    if isinstance(data, CalibrationSet):
        inspection = inspection_of(data)
        bad = tuple(str(entry) for entry in inspection.findings if entry.severity == "fault")
        whole_set = InspectedSets(((", ".join(inspection.files) or IN_MEMORY, inspection),), None, bad)
        return Outcome(whole_set, failure="; ".join(bad))
    sets: list[tuple[str, Inspection | DataError]] = []
    faults: list[str] = []
    paths = paths_of(data)
    for path in paths:
        job.tell(f"reading {path}")
        try:
            inspection = inspection_of(read_calibration_set(path))
        except DataError as error:
            faults.append(str(error))
            sets.append((str(path), error))
            continue
        faults += [f"{path}: {entry}" for entry in inspection.findings if entry.severity == "fault"]
        sets.append((str(path), inspection))
    joint = inspection_of(read_calibration_set(*paths)) if len(paths) > 1 and not faults else None
    inspected = InspectedSets(tuple(sets), joint, tuple(faults))
    strange = any(inspection.instrument not in shipped() for inspection in inspected.inspections)
    needed = ("CALSET", "--instrument", "FILE.toml") if strange else paths
    return Outcome(
        inspected,
        text="\n".join(inspection.display().text() for inspection in inspected.inspections),
        failure="; ".join(faults),
        next=(typed("refit", *needed, "-o", "RUN"),),
    )

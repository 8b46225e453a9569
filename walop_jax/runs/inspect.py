"""What is in calibration sets and what is wrong with them: file by file, then as one."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

from walop_jax.data import DataError, read_calibration_set
from walop_jax.data.inspection import Inspection, inspect


@dataclasses.dataclass(frozen=True)
class InspectedSets:
    """An inspection of every file, or the error that it gave; one of all as one set; faults in words."""

    sets: tuple[tuple[str, Inspection | DataError], ...]
    joint: Inspection | None
    faults: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "sets": [
                dataclasses.asdict(found)
                if isinstance(found, Inspection)
                else {"files": [path], "error": str(found)}
                for path, found in self.sets
            ],
            "joint": None if self.joint is None else dataclasses.asdict(self.joint),
        }


def inspect_sets(
    calsets: Sequence[str | os.PathLike[str]], *, progress: Callable[[Inspection], None] | None = None
) -> InspectedSets:
    """Inspect each file by itself; if there are several and none has a fault, also all of them as one set.

    `progress` is given every inspection as soon as it is there. Raises `DataError` only if the files cannot be one
    set: what is wrong with a single file is among the faults.
    """
    told = progress or (lambda found: None)
    sets: list[tuple[str, Inspection | DataError]] = []
    faults: list[str] = []
    for path in calsets:
        try:
            found = inspect(read_calibration_set(path))
        except DataError as error:
            faults.append(str(error))
            sets.append((str(path), error))
            continue
        faults += [f"{path}: {entry}" for entry in found.findings if entry.severity == "fault"]
        sets.append((str(path), found))
        told(found)
    joint = None
    if len(calsets) > 1 and not faults:
        joint = inspect(read_calibration_set(*calsets))
        told(joint)
    return InspectedSets(tuple(sets), joint, tuple(faults))

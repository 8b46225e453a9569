"""Text exports of an optical design program made into a calibration set on disk."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from walop_jax.data import check_output, import_transmissions, write_calibration_set
from walop_jax.data.zemax import CAMERA_CONFIGURATIONS, RELATIVE_ERROR


@dataclasses.dataclass(frozen=True)
class ImportedSet:
    """A calibration set that was written, what it holds (wavelengths in µm), and remarks on what was left out."""

    path: Path
    instrument: str
    wavelengths: tuple[float, ...]
    exposures: int
    points: int
    rows: int
    remarks: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        lists = {"wavelengths": list(self.wavelengths), "remarks": list(self.remarks)}
        known = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)[1:]}
        return {"output": str(self.path)} | known | lists


def import_folder(
    folder: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    instrument: str | None = None,
    configurations: Sequence[int] = CAMERA_CONFIGURATIONS,
    error: float = RELATIVE_ERROR,
    overwrite: bool = False,
    progress: Callable[[str], None] | None = None,
) -> ImportedSet:
    """Read the exports in `folder` and below it as `import_transmissions` does, and write the set as `output`.

    `progress` is told what is being done. Raises `DataError` as `import_transmissions` does and if the set cannot
    be written; ValueError for an `error` that is no share.
    """
    if not 0.0 <= error < 1.0:
        raise ValueError(f"error {error} is not a share, as in 0.001")
    tell = progress or (lambda text: None)
    check_output(output, overwrite=overwrite)
    calset = import_transmissions(
        folder, instrument=instrument, configurations=configurations, error=error, tell=tell
    )
    tell("writing")
    write_calibration_set(output, calset, overwrite=overwrite)
    return ImportedSet(
        path=Path(output),
        instrument=calset.instrument,
        wavelengths=tuple(float(curve.wavelength[0]) for curve in calset.filters.values()),
        exposures=len(calset.exposures),
        points=len(calset.points),
        rows=calset.intensities.rows,
        remarks=tuple(calset.remarks),
    )

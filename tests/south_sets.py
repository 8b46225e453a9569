"""Calibration sets of an independent simulator of WALOP-South, with known truth.

Cuts of 5 × 5 points come with the tests (`sets/`, made by `sets/cut.py`); the sets that they were cut from are read
where they lie beside the project.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

CUTS = Path(__file__).resolve().parent / "sets"
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
ABSENT = "not beside the project (../shared/data)"
"""What the reason of a skipped test ends with when a file of other people's is missing."""


@dataclasses.dataclass(frozen=True)
class SouthSet:
    """A set and its truth: files of the measurements, of the true matrices, and of the as-built values."""

    path: Path
    matrix: Path
    built: Path

    @classmethod
    def of(cls, folder: Path, name: str) -> SouthSet:
        """The set `name` (a, b, c or d) of a folder; its FITS files may be compressed."""
        stem = f"walop_south_{name}"
        path, matrix = (_found(folder / f"{stem}{end}.fits") for end in ("", "_truth"))
        return cls(path, matrix, folder / f"{stem}_truth.json")

    def as_built(self) -> dict[str, Any]:
        """The values that the instrument was simulated with, and its effects."""
        return json.loads(self.built.read_text())


def _found(path: Path) -> Path:
    packed = path.with_name(f"{path.name}.gz")
    return packed if packed.exists() else path

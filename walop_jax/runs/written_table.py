"""What the commands that write a table have to say of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from walop_jax.fit.verdict import Quality
from walop_jax.runs.left_out import KEY


@dataclasses.dataclass(frozen=True)
class WrittenTable:
    """A table that was written.

    `flags` counts the rows (stars, where rows are combined) with each bit of FLAG; `product` is the content hash of the
    calibration, `trusted` what it says of itself; `not_carried_over` names effects of its model that cannot be in the
    table; `warnings` are sentences about all of that.
    """

    path: Path
    rows: int
    trusted: bool
    flags: Mapping[Quality, int]
    product: str
    not_carried_over: tuple[str, ...]
    warnings: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Everything but the warnings as plain data."""
        return {
            "output": str(self.path),
            "rows": self.rows,
            "trusted": self.trusted,
            "flags": {str(int(bit)): count for bit, count in self.flags.items()},
            "product": self.product,
            KEY: list(self.not_carried_over),
        }

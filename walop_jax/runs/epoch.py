"""An old calibration, from its file, held against new calibration sets."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.from_file import product_path
from walop_jax.calibration.product import read_product, write_product
from walop_jax.calibration.summary import PRODUCT
from walop_jax.data import read_calibration_set
from walop_jax.io.errors import errors_naming
from walop_jax.io.folder import atomic_folder, check_folder
from walop_jax.io.text import json_text
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.reports.run import EPOCH
from walop_jax.science.epoch import Epoch, epoch

OUTPUTS = (PRODUCT, EPOCH)


@dataclasses.dataclass(frozen=True)
class EpochComparison:
    """What has moved; the content hash of the old product and the SHA-256 of the new sets."""

    found: Epoch
    old: str
    new: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {"old": self.old, "new": list(self.new)} | self.found.document()


def compare_epochs(
    old: str | os.PathLike[str],
    calsets: Sequence[str | os.PathLike[str]],
    *,
    output: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> EpochComparison:
    """Fit new calibration sets and compare with the calibration `old` (a product, or the folder of a run).

    With `output` a folder is written that holds the new calibration and `epoch.json`. `catalogue` are the effects
    that a model may have. `progress` is told what is being done. Raises `DataError` for files that cannot be read,
    and what `science.epoch` raises.
    """
    if output is not None:
        check_folder(output, OUTPUTS, overwrite=overwrite)
    path = product_path(old)
    product = read_product(path)
    calset = read_calibration_set(*calsets)
    if progress is not None:
        progress("fitting the new set")
    with errors_naming(path):
        found, new = epoch(Calibration.from_product(product, catalogue), calset)
    parents = tuple(entry.sha256 for entry in calset.inputs)
    compared = EpochComparison(found, product.content_hash(), parents)
    if output is not None:
        with atomic_folder(output, OUTPUTS, overwrite=overwrite) as folder:
            write_product(folder / PRODUCT, new.to_product())
            (folder / EPOCH).write_text(json_text(compared.document()), encoding="utf-8")
    return compared

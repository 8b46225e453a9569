"""An old calibration, from its file, held against new calibration sets."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.from_file import product_path
from walop_jax.calibration.product import read_product, write_product
from walop_jax.calibration.summary import PRODUCT
from walop_jax.data import read_calibration_set
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.findings import document as diagnosis_document
from walop_jax.diagnosis.trust import examined
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import errors_naming
from walop_jax.io.folder import output_folder
from walop_jax.io.text import json_text
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.reports.run import EPOCH
from walop_jax.science.epoch import Epoch, epoch, fit_like

OUTPUTS = (PRODUCT, EPOCH)


@dataclasses.dataclass(frozen=True)
class EpochComparison:
    """What has moved; the content hash of the old product and the SHA-256 of the new sets.

    `fitted` is the fit of the new sets; `diagnosis` says what it lacks, where it is not to be trusted.
    """

    found: Epoch
    old: str
    new: tuple[str, ...]
    fitted: FitResult
    diagnosis: Diagnosis | None = None

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        lacking = None if self.diagnosis is None else diagnosis_document(self.diagnosis)
        return {"old": self.old, "new": list(self.new)} | self.found.document() | {"diagnosis": lacking}


def compare_epochs(
    old: str | os.PathLike[str],
    calsets: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> EpochComparison:
    """Fit new calibration sets and compare with the calibration `old` (a product, or the folder of a run).

    Where the new fit is not to be trusted, what it lacks is looked for as `diagnose` does. With `output` a folder is
    written that holds the new calibration and `epoch.json`. `catalogue` are the effects that a model may have.
    `progress` is told what is being done. Raises `DataError` for files that cannot be read or written, and what
    `science.epoch` raises.
    """
    tell = progress or (lambda text: None)
    reserved = None if output is None else output_folder(output, OUTPUTS, overwrite=overwrite)
    with contextlib.nullcontext() if reserved is None else reserved as out:
        tell("reading")
        path = product_path(old)
        product = read_product(path)
        calset = read_calibration_set(*calsets)
        tell("fitting the new set")
        with errors_naming(path):
            calibration = Calibration.from_product(product, catalogue)
            result = examined(fit_like(calibration, calset))
            found = epoch(calibration, result)
        lacking = None
        if not found.new_trusted:
            tell("looking for what the new fit lacks")
            # Other readings of the data have been tried when its fit was examined.
            lacking = diagnose(calset, result.model, catalogue=catalogue, as_written=True, progress=tell)
        parents = tuple(entry.sha256 for entry in calset.inputs)
        compared = EpochComparison(found, product.content_hash(), parents, result, lacking)
        if out is not None:
            with out.filled() as folder:
                write_product(folder / PRODUCT, Calibration.from_fit(result).to_product())
                (folder / EPOCH).write_text(json_text(compared.document()), encoding="utf-8")
    return compared

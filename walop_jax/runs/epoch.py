"""An old calibration, from its file, held against new calibration sets."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.from_file import product_path
from walop_jax.calibration.product import read_product
from walop_jax.data import read_calibration_set
from walop_jax.diagnosis.document import document as diagnosis_document
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.trust import examined
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import errors_naming
from walop_jax.io.folder import check_folder
from walop_jax.runs.refit import OUTPUTS, write_fit
from walop_jax.science.epoch import Epoch, epoch, fit_like


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
    progress: Callable[[str], None] | None = None,
) -> EpochComparison:
    """Fit new calibration sets and compare with the calibration `old` (a product, or the folder of a run).

    Where the new fit is not to be trusted, what it lacks is looked for as `diagnose` does. The new fit is kept in the
    folder `output`, if given. `progress` is told what is being done. Raises `DataError` for files that cannot be read
    or written, and what `science.epoch` raises.
    """
    began, tell = time.perf_counter(), progress or (lambda text: None)
    if output is not None:
        check_folder(output, OUTPUTS, overwrite=overwrite)
    path = product_path(old)
    product = read_product(path)
    calset = read_calibration_set(*calsets)
    tell("fitting the new set")
    with errors_naming(path):
        calibration = Calibration.from_product(product)
        result = examined(fit_like(calibration, calset))
        found = epoch(calibration, result)
    if output is not None:
        write_fit(output, result, seconds=time.perf_counter() - began, overwrite=overwrite)
    lacking = None if found.new_trusted else diagnose(calset, result.model, progress=tell)
    return EpochComparison(
        found, product.content_hash(), tuple(entry.sha256 for entry in calset.inputs), result, lacking
    )

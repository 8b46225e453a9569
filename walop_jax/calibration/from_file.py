"""A calibration read from its file, or from the folder of the run that holds it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import CalibrationProduct, read_product
from walop_jax.calibration.summary import PRODUCT
from walop_jax.io.errors import errors_naming
from walop_jax.model.effects import EFFECTS, Effect


def product_path(run: str | os.PathLike[str]) -> Path:
    """The calibration product that a folder of a run, or the file itself, stands for."""
    path = Path(run)
    return path / PRODUCT if path.is_dir() else path


@dataclasses.dataclass(frozen=True)
class CalibrationFile:
    """A calibration with the file that it was read from and what that file says of itself."""

    path: Path
    product: CalibrationProduct
    calibration: Calibration

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence if the calibration is not to be trusted."""
        verdict = self.product.verdict
        if verdict.trusted:
            return ()
        why = "; ".join(verdict.warnings) or "see WARNINGS"
        return (f"{self.path}: this calibration is not trusted: {why}",)


def read_calibration(
    run: str | os.PathLike[str], catalogue: Sequence[type[Effect]] = EFFECTS
) -> CalibrationFile:
    """Read `calibration.fits`, given by its name or by the folder of the run.

    `catalogue` are the effects that its model may have.
    Raises `DataError` as `read_product` does, and if the model of the product cannot be rebuilt.
    """
    path = product_path(run)
    product = read_product(path)
    with errors_naming(path):
        return CalibrationFile(path, product, Calibration.from_product(product, catalogue))

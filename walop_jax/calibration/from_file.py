"""Names of before."""

import dataclasses

from walop_jax.calibration.product import PRODUCT, product_path, read_calibration

__all__ = ["PRODUCT", "CalibrationFile", "product_path", "read_calibration"]


def CalibrationFile(path, product, calibration):  # type: ignore[no-untyped-def]
    """Return the calibration with its path."""
    return dataclasses.replace(calibration, path=path)

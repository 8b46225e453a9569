"""Calibrations: what a fit has learnt of an instrument, its files, and its matrix anywhere in the field."""

from walop_jax.calibration.calibration import Calibration, ListedModel
from walop_jax.calibration.matrix import (
    SMALLEST_DETERMINANT,
    MatrixMaps,
    ResidualMap,
    matrix_names,
    residual_names,
)
from walop_jax.calibration.product import PRODUCT, product_path, read_calibration, write_calibration
from walop_jax.calibration.summary import FAILED, PARTIAL, SUMMARY, summary

__all__ = [
    "FAILED",
    "PARTIAL",
    "PRODUCT",
    "SMALLEST_DETERMINANT",
    "SUMMARY",
    "Calibration",
    "ListedModel",
    "MatrixMaps",
    "ResidualMap",
    "matrix_names",
    "product_path",
    "read_calibration",
    "residual_names",
    "summary",
    "write_calibration",
]

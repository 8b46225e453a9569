"""Calibrations: what a fit has learnt of an instrument, its files, and its matrix anywhere in the field."""

from walop_jax.calibration.calibration import Calibration, Product
from walop_jax.calibration.matrix import MatrixMaps, ResidualMap, matrix_names, residual_names
from walop_jax.calibration.product import (
    PRODUCT,
    product_path,
    read_calibration,
    read_product,
    write_calibration,
)
from walop_jax.calibration.summary import FAILED, SUMMARY, summary

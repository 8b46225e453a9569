"""Names of before."""

from walop_jax.calibration.maps import (
    SMALLEST_DETERMINANT,
    MatrixMaps,
    ResidualMap,
    matrix_names,
    residual_names,
)
from walop_jax.fit.verdict import Quality, Verdict
from walop_jax.io.text import in_ascii

__all__ = [
    "SMALLEST_DETERMINANT",
    "MatrixMaps",
    "Quality",
    "ResidualMap",
    "Verdict",
    "in_ascii",
    "matrix_names",
    "residual_names",
]

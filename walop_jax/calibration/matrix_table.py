"""The instrument matrix as columns of a table: values, errors and flags, row by row."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.records import matrix_names
from walop_jax.data.settings import Settings
from walop_jax.fit.verdict import Quality


def provenance(content: str, calibration: Calibration, *, drawn: bool = False) -> dict[str, str]:
    """Cards of a table of matrices: the calibration (hash of its content), and what the errors are made from.

    `drawn` where values and errors are those of draws of a posterior.
    """
    verdict = calibration.verdict
    made_from = "draws of the posterior" if drawn else f"covariance of the {verdict.covariance_from}"
    return {
        "CALHASH": content,
        "ERRFROM": f"{made_from}, {verdict.errors_from}",
        "TRUSTED": str(verdict.trusted)[0],
    }


def matrix_columns(
    calibration: Calibration,
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
    settings: Settings,
    outside: Bool[np.ndarray, " p"],
) -> dict[str, tuple[np.ndarray, str]]:
    """The matrix elements, their standard errors and FLAG, each with its description; NaN and 32 where `outside`.

    Raises `DataError` for a filter that neither the calibration nor the package knows.
    """
    inside = np.flatnonzero(~outside)
    there, covariance = calibration.matrix(x[inside], y[inside], settings[inside])
    values, errors = np.full((2, len(x), there.shape[1]), np.nan)
    values[inside] = there
    errors[inside] = np.sqrt(np.clip(np.diagonal(covariance, axis1=1, axis2=2), 0.0, None))
    flag = np.full(len(x), Quality.BEYOND_FIELD, np.int32)
    flag[inside] = calibration.flags(x[inside], y[inside], settings[inside], values[inside])
    columns: dict[str, tuple[np.ndarray, str]] = {}
    names = matrix_names(values.shape[1] // 3)
    for k, name in enumerate(names):
        columns[name] = values[:, k], f"element {name.lower()} of the instrument matrix"
    for k, name in enumerate(names):
        columns[f"{name}_ERR"] = errors[:, k], f"standard error of {name}"
    columns["FLAG"] = flag, "16 high cross-talk, 32 beyond the calibrated field, 64 filter or temperature"
    return columns

"""Importer of q, u of unpolarised stars behind a mirror that turns.

Columns: STAR, PARALLACTIC (deg), Q, Q_ERR, U, U_ERR, WAVELENGTH (um).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import bench_set

from walop_jax import CalibrationSet, FilterCurve

SCALE = 1e6  # counts of an arm: nothing depends on it


def nasmyth_set(table: Table | str | Path, floor: float = 0.0) -> CalibrationSet:
    """Each measurement as the intensities that it stands for: (1 + q)/2, (1 - q)/2, (1 + u)/2, (1 - u)/2.

    q = (N0 - N1)/(N0 + N1) has the error of the table where each of the two has 1/√2 of it. `floor` is added to the
    errors in quadrature. What `copied` doubts is left out.
    """
    rows = table if isinstance(table, Table) else Table.read(table, format="ascii.ecsv")
    rows = rows[~copied(rows)]
    q, u, wavelength, angle = (
        np.asarray(rows[name], float) for name in ("Q", "U", "WAVELENGTH", "PARALLACTIC")
    )
    counts = 0.5 * np.column_stack([1.0 + q, 1.0 - q, 1.0 + u, 1.0 - u])
    errors = np.hypot(np.column_stack([rows["Q_ERR"], rows["U_ERR"]]), floor) / np.sqrt(2.0)
    known = np.unique(wavelength)
    return bench_set(
        "NASMYTH",
        "measured on the sky; abh13/EFOSC2_Scripts; Wiersema et al. 2018, PASA 35, e012",
        "lamp",
        [FilterCurve(f"{1e3 * w:.0f}nm", np.array([w]), np.ones(1)) for w in known],
        np.searchsorted(known, wavelength),
        SCALE * counts,
        SCALE * np.repeat(errors, 2, axis=1),
        {"MIRROR": angle},
    )


def copied(rows: Table):
    """Measurements of a star that agree with those through another filter to the last digit of q, u and both errors.

    One of them is a copy, and nothing says which.
    """
    named = [(str(row["STAR"]), *(float(row[c]) for c in ("Q", "Q_ERR", "U", "U_ERR"))) for row in rows]
    return np.array([named.count(one) > 1 for one in named])

"""Standard stars that come with the package: a dated table of published values, and what SOURCES needs of them.

Equation    Q + iU = P exp(2i ANGLE); along it the error is P_ERR, across it 2 P √(ANGLE_ERR² + ANGLE_SCATTER²)
Limits      Of stars that are polarised by less than three errors the angle is not known: both errors are P_ERR. Where
            no angle is stated Q = U = 0, with the error √((P² + P_ERR²)/2).
            Stars that were never monitored are taken to vary by `USUAL_SCATTER`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

USUAL_SCATTER = 0.27
"""Degrees, the smallest variability of an angle that was found (Cotton et al. 2024, arXiv:2410.23466)."""

POLARISED = 3.0  # errors
UNPOLARISED = 0.005
"""Largest p of a standard of zero polarisation."""
LOWEST = 30.0  # deg above the horizon, of a standard that is up


def shipped_standards() -> Any:
    """The table as an astropy QTable, with the columns of SOURCES: rows can be taken over as they are.

    Rows of one star have one SOURCE; TEFF is not known. Version and date are in `meta`.
    """
    from astropy.table import QTable

    table = QTable.read(Path(__file__).with_suffix(".ecsv"), format="ascii.ecsv")
    names = [str(name) for name in table["NAME"]]
    order = list(dict.fromkeys(names))
    degree, error = (np.asarray(table[name], float) for name in ("P", "P_ERR"))
    angles = (table[name].to_value("deg") for name in ("ANGLE", "ANGLE_ERR", "ANGLE_SCATTER"))
    angle, stated, scatter = (np.deg2rad(np.asarray(values, float)) for values in angles)
    scatter = np.where(np.isfinite(scatter), scatter, np.deg2rad(USUAL_SCATTER))
    across = 2.0 * degree * np.hypot(np.nan_to_num(stated), scatter)
    across = np.where(degree > POLARISED * error, across, error)
    has_angle = np.isfinite(angle)
    either = np.sqrt(0.5 * (degree**2 + error**2))
    error, across = np.where(has_angle, error, either), np.where(has_angle, across, either)
    degree, angle = np.where(has_angle, degree, 0.0), np.where(has_angle, angle, 0.0)
    cos, sin = np.cos(2.0 * angle), np.sin(2.0 * angle)
    columns = {
        "SOURCE": np.array([order.index(name) for name in names]),
        "Q": degree * cos,
        "U": degree * sin,
        "Q_ERR": np.hypot(error * cos, across * sin),
        "U_ERR": np.hypot(error * sin, across * cos),
        "TEFF": np.full(len(table), np.nan),
    }
    for number, (name, values) in enumerate(columns.items()):
        table.add_column(values, index=number if number == 0 else number + 1, name=name)
    return table

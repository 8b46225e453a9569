"""Importer of the tables of a polarimeter with four photodiodes (SEQUENCE, POLARISER_ANGLE, PLATE_ANGLE, POWER, V)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import bench_set

from walop_jax.data.records import CalibrationSet, FilterCurve

SCALE = 1e6  # counts of one volt, and of one milliwatt
LASER = FilterCurve("532nm", np.array([0.532]), np.ones(1))
DIODE, METER = 5e-4, 1.5e-3  # scatter of a diode, over its mean, and of the meter, over its reading


def metasurface_set(table: Table | str | Path, diode: float = DIODE, meter: float = METER) -> CalibrationSet:
    """The table as one field point: voltages less the dark ones, and the reading of the meter as a fifth camera.

    The angle of the plate is counted from the axis of the polariser, which turns with it: PLATE_ANGLE less the angle
    that it has where the polariser stands at 0.
    """
    rows = table if isinstance(table, Table) else Table.read(table, format="ascii.ecsv")
    polariser = np.asarray(rows["POLARISER_ANGLE"], float)
    plate = np.ma.filled(np.ma.asarray(rows["PLATE_ANGLE"], float), np.nan)
    plate = plate - _start(plate, polariser)
    volts = np.array(list(rows["V"]), float) - np.asarray(rows.meta["dark"], float)
    power = np.asarray(rows["POWER"], float)
    sigma = np.hypot(np.array(list(rows["V_ERR"]), float), diode * volts.mean(axis=0))
    return bench_set(
        "METASURFACE",
        "measured; public repository juhlemand/metasurface_polarimetry",
        "clp",
        [LASER],
        np.zeros(len(rows), int),
        SCALE * np.column_stack([volts, power]),
        SCALE * np.column_stack([sigma, meter * power]),
        {"QWP": plate, "POL": polariser},
        polariser=polariser,
        mjd=60000.0 + np.arange(len(rows)) / 24.0 / 60.0,
    )


def _start(plate, polariser):
    """Angle of the plate's encoder where the plate stands at 45° to a polariser at 0°, to 90°."""
    return np.nanmedian((plate - polariser) % 90.0) - 45.0


def held_out(rows: Table):
    """States that are left out of a fit: every fifth angle of the polariser, and the second sequence of the plate."""
    number = np.round(np.asarray(rows["POLARISER_ANGLE"], float) / 5.0).astype(int)
    return (number % 5 == 2) | (np.asarray(rows["SEQUENCE"]) == "qwp_R")

"""Importer of the tables of a polarimeter with four photodiodes (SEQUENCE, POLARISER_ANGLE, PLATE_ANGLE, POWER, V)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import bench_set

from walop_jax import CalibrationSet, FilterCurve

SCALE = 1e6  # counts of one volt, and of one milliwatt
LASER = FilterCurve("532nm", np.array([0.532]), np.ones(1))
DIODE, METER = 5e-4, 1.5e-3  # scatter of a diode, over its mean, and of the meter, over its reading

DIODES = ("d1", "d2", "d3", "d4")
WAVES = ("cos", "sin")
PLATE = {
    "plate deviates the beam": [f"gain of {d} * {w} 1 QWP" for d in DIODES for w in WAVES],
    "plate shifts the beam": [f"gain of {d} * cos 0 QWP" for d in DIODES],
    "plate polarises": [f"diattenuation q of plate * {w} 2 QWP" for w in WAVES],
    "axis of the plate wobbles": [f"turn of plate * {w} 1 QWP" for w in WAVES],
    "plate, second order": [f"gain of {d} * {w} 2 QWP" for d in DIODES for w in WAVES],
}
"""What the plate does beyond a retardance, in the order in which it was found."""


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


def fifth_angles(rows: Table):
    """Every fifth angle of the polariser, in all sequences."""
    return np.round(np.asarray(rows["POLARISER_ANGLE"], float) / 5.0).astype(int) % 5 == 2


def with_free(model, *names: str):
    """The model with the parameters frozen whose names do not begin with one of `names`."""
    for parameter in model.parameters:
        if parameter.free and not parameter.name.startswith(names):
            model = model.change(parameter.name, free=False)
    return model


def started(model, result=None):
    """The model beginning at the values of a fit, as far as it has its parameters."""
    known = {} if result is None else dict(zip(result.model.names, result.values.tolist(), strict=True))
    for name in set(known) & set(model.names):
        model = model.change(name, start=known[name])
    return model

"""Importer of the table of a spectropolarimeter with two turning retarders (WAVELENGTH nm, V of every state)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import bench_set

from walop_jax import CalibrationSet, FilterCurve

SCALE = 1e6  # counts of the mean of a bin: nothing depends on it
HOURS = 1.0 / 60.0  # from one state to the next; not said in the table


def two_retarder_set(
    table: Table | str | Path, together: int = 18, chosen=None, noise: float = 0.0106
) -> CalibrationSet:
    """The table as one field point: `together` neighbouring wavelengths are a bin, which is a filter.

    Every wavelength is divided by its mean over the states: the lamp is no part of the story. `noise`, a share of the
    mean, is that of a single wavelength and state. `chosen` are numbers of bins; None: all.
    """
    rows = table if isinstance(table, Table) else Table.read(table, format="ascii.ecsv")
    wavelength = np.asarray(rows["WAVELENGTH"], float) * 1e-3
    states = np.array(list(rows["V"]), float)
    states /= states.mean(axis=1, keepdims=True)
    parts = np.array_split(np.arange(len(rows)), max(1, round(len(rows) / together)))
    parts = parts if chosen is None else [parts[i] for i in chosen]
    first, second = (np.asarray(rows.meta[name], float) for name in ("angles_1", "angles_2"))
    count = len(first)
    means = np.concatenate([states[part].mean(axis=0) for part in parts])
    sigma = np.repeat([noise / np.sqrt(len(part)) for part in parts], count)
    return bench_set(
        "TWO-RETARDERS",
        "measured; public repository eejames2017/UAH-Mueller-Matrix-Spectropolarimeter",
        "steady",
        [FilterCurve(f"{1e3 * wavelength[p].mean():.0f}nm", wavelength[p], np.ones(len(p))) for p in parts],
        np.repeat(np.arange(len(parts)), count),
        SCALE * means[:, None],
        SCALE * sigma[:, None],
        {"R1": np.tile(first, len(parts)), "R2": np.tile(second, len(parts))},
        polariser=np.zeros(len(means)),
        mjd=60000.0 + np.tile(np.arange(count), len(parts)) * HOURS / 24.0,
    )


WAVES = ("cos", "sin")
WANDER = {
    "second retarder deviates the beam": [
        f"diattenuation q of second * {w} 1 R2{colour}"
        for colour in ("", " * colour", " * colour * colour")
        for w in WAVES
    ],
    "first retarder tilted": [
        *(f"retardance u of first * {w} 1 R1" for w in WAVES),
        *(f"retardance v of first * {w} 1 R1{colour}" for colour in ("", " * colour") for w in WAVES),
        *(f"diattenuation v of first * {w} 1 R1" for w in WAVES),
    ],
    "first retarder deviates the beam": [f"gain of detector * {w} 1 R1" for w in WAVES],
    "lamp": ["gain of detector * hours * hours"],
}
"""What turns with the retarders beyond their retardance, step by step, and the lamp."""

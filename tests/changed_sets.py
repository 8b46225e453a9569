"""A calibration set with other numbers in its table of intensities."""

from __future__ import annotations

import dataclasses

import numpy as np

from walop_jax.data.records import Block, CalibrationSet
from walop_jax.data.table_intensities import TableIntensities


def block_of(calset: CalibrationSet) -> Block:
    """All of its intensities: arrays (point, exposure, camera) and (point, exposure)."""
    return calset.intensities.block(0, len(calset.points))


def with_block(calset: CalibrationSet, **columns: np.ndarray) -> CalibrationSet:
    """The set with other columns of that block."""
    block = dataclasses.replace(block_of(calset), **columns)
    return dataclasses.replace(calset, intensities=TableIntensities.dense(calset.points, block))

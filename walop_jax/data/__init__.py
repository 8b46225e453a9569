"""Calibration sets, filters and the sky: FITS, units, time and ephemeris live here and nowhere else.

This room turns files into plain immutable records and back. Units are checked at the door and are
gone afterwards: inside the package a number has the unit that the record's docstring gives.
"""

from walop_jax.data.calset import empty_sources, read_calibration_set, with_builtins
from walop_jax.data.frames import FrameIntensities, Grid
from walop_jax.data.merge import JoinedIntensities, merge_calibration_sets
from walop_jax.data.records import (
    KINDS,
    Block,
    CalibrationSet,
    DataFlag,
    Exposures,
    FilterCurve,
    InputFile,
    Intensities,
    Points,
    Position,
    Site,
    Sources,
)
from walop_jax.data.schema import CALVERS
from walop_jax.data.settings import BUILTIN_FILTERS, DEFAULT_FILTER, builtin_filter
from walop_jax.data.table_intensities import TableIntensities, empty_block
from walop_jax.data.write import write_calibration_set, write_frames
from walop_jax.data.zemax import import_transmissions
from walop_jax.io.atomic import atomic_path, check_output
from walop_jax.io.errors import DataError, nearest

__all__ = [
    "BUILTIN_FILTERS",
    "CALVERS",
    "DEFAULT_FILTER",
    "KINDS",
    "Block",
    "CalibrationSet",
    "DataError",
    "DataFlag",
    "Exposures",
    "FilterCurve",
    "FrameIntensities",
    "Grid",
    "InputFile",
    "Intensities",
    "JoinedIntensities",
    "Points",
    "Position",
    "Site",
    "Sources",
    "TableIntensities",
    "atomic_path",
    "builtin_filter",
    "check_output",
    "empty_block",
    "empty_sources",
    "import_transmissions",
    "merge_calibration_sets",
    "nearest",
    "read_calibration_set",
    "with_builtins",
    "write_calibration_set",
    "write_frames",
]

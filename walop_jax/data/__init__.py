"""Calibration sets, catalogues and filters: columns, units, checks, merging, exports of optical design programs.

This room turns files into plain immutable records and back. Units are checked at the door and are
gone afterwards: inside the package a number has the unit that the record's docstring gives.
"""

from walop_jax.data.calset import empty_sources, read_calibration_set
from walop_jax.data.frames import FrameIntensities, Grid
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.records import Block, CalibrationSet, DataFlag, Position, Site
from walop_jax.data.settings import BUILTIN_FILTERS, builtin_filter
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.data.zemax import import_transmissions
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import DataError

"""The light of one source through an instrument: as designed, or as fitted, from the file of its calibration."""

from __future__ import annotations

import os

from walop_jax.calibration.from_file import read_calibration
from walop_jax.data.filters import DEFAULT_FILTER, builtin_filter
from walop_jax.model.build import nominal_instrument
from walop_jax.model.instrument import Instrument
from walop_jax.model.trace import Sightline, Stage, trace


def trace_source(
    sightline: Sightline,
    product: str | os.PathLike[str] | None = None,
    *,
    instrument: str | os.PathLike[str] | None = None,
    filter_name: str = DEFAULT_FILTER,
) -> tuple[Stage, ...]:
    """The light of a source, stage by stage, through the instrument of a calibration, or `instrument` as designed.

    `product` is a calibration product or the folder of a run. Raises `DataError` for a file that cannot be read;
    it or another ValueError, with the nearest names, for an unknown instrument or filter.
    """
    if product is None:
        design = nominal_instrument() if instrument is None else Instrument.read(instrument)
        return trace(design, builtin_filter(filter_name), sightline)
    calibration = read_calibration(product).calibration
    fitted = calibration.model.instrument(calibration.values)
    return trace(fitted, calibration.filter_curve(filter_name), sightline)

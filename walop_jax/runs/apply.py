"""A calibration applied to a catalogue of intensities, from file to file."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.calibration.from_file import read_calibration
from walop_jax.data.catalogue import read_catalogue
from walop_jax.data.user_tables import read_input_table, table_format, write_output_table
from walop_jax.fit.verdict import Quality
from walop_jax.io.atomic import check_output
from walop_jax.io.errors import errors_naming
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior import with_moments
from walop_jax.runs.left_out import left_out_cards, left_out_sentences
from walop_jax.runs.written_table import WrittenTable
from walop_jax.science.apply import apply
from walop_jax.science.polarisation import ESTIMATORS
from walop_jax.science.stokes_columns import header, stokes_columns

BITS = (
    Quality.HIGH_CROSSTALK,
    Quality.BEYOND_FIELD,
    Quality.BEYOND_SETTINGS,
    Quality.CAMERA_MISSING,
    Quality.SATURATED,
    Quality.VALIDITY_FORCED,
    Quality.NO_STOKES,
    Quality.DISAGREES,
)
"""Bits of FLAG that a star can have by itself."""


@dataclasses.dataclass(frozen=True)
class StokesTable(WrittenTable):
    """A catalogue that was written: its stars, the estimator of p, and the time it took."""

    stars: int
    seconds: float
    estimator: str

    def document(self) -> dict[str, Any]:
        """Everything but the warnings as plain data."""
        own = {"stars": self.stars, "seconds": self.seconds, "estimator": self.estimator}
        return super().document() | own


def apply_to_catalogue(
    product: str | os.PathLike[str],
    catalogue: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    estimator: str = ESTIMATORS[0],
    saturation: float | None = None,
    posterior: str | os.PathLike[str] | None = None,
    force: bool = False,
    overwrite: bool = False,
    effects: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> StokesTable:
    """Add Q, U, P, EVPA, their errors and FLAG to the table `catalogue`, and write it as `output`.

    `product` is a calibration product or the folder of a run; `estimator` is one of `ESTIMATORS`; counts
    (electrons) from `saturation` on are not used; with `posterior` (a `posterior.nc`) mean and covariance are those
    of its draws; with `force` also stars whose filter or temperature the calibration does not cover. `effects` are
    those that its model may have. `progress` is told what is being done. Raises `DataError` for files that cannot be
    read or written and as `science.apply` does; ValueError for an unknown estimator and a saturation that is not
    above 0.
    """
    began = time.perf_counter()
    tell = progress or (lambda text: None)
    if estimator not in ESTIMATORS:
        raise ValueError(f"{estimator!r} is neither {' nor '.join(ESTIMATORS)}")
    if saturation is not None and not saturation > 0:
        raise ValueError(f"saturation {saturation} must be above 0 electrons")
    table_format(output)
    check_output(output, overwrite=overwrite)
    tell("reading")
    held = read_calibration(product, effects)
    table = read_input_table(catalogue)
    instrument = held.calibration.model.template.patched()
    limit = math.inf if saturation is None else saturation
    rows = read_catalogue(table, instrument, limit, always_in=held.calibration.always_in)

    tell("tabulating the analysis vectors")
    calibration = held.calibration if posterior is None else with_moments(held.calibration, posterior)
    with errors_naming(catalogue):
        stars = apply(calibration, rows, lambda done, all_: tell(f"{done} of {all_} rows"), force=force)
    tell("writing")
    columns = stokes_columns(stars, rows.star, estimator)
    content = held.product.content_hash()
    lost = calibration.left_behind
    cards = header(content, estimator, float(np.mean(np.isfinite(rows.rotator)))) | left_out_cards(lost)
    write_output_table(output, table, columns, overwrite=overwrite, header=cards)

    counts = {bit: int((stars.flag & bit > 0).sum()) for bit in BITS}
    said = (
        (Quality.NO_STOKES, "star(s) without a result (FLAG 16384)"),
        (Quality.BEYOND_FIELD, "star(s) beyond the calibrated field: extrapolated, or NaN (FLAG 32)"),
        (Quality.BEYOND_SETTINGS, "star(s) with a filter, temperature or TEFF beyond the calibration"),
        (
            Quality.DISAGREES,
            "star(s) whose intensities disagree with the calibration (FLAG 131072, CHI2): is "
            "the background subtracted, are the cameras in order?",
        ),
    )
    flagged = [f"{catalogue}: {counts[bit]} {text}" for bit, text in said if counts[bit]]
    return StokesTable(
        path=Path(output),
        rows=table.rows,
        stars=len(stars.qu),
        seconds=time.perf_counter() - began,
        estimator=estimator,
        trusted=held.product.verdict.trusted,
        flags=counts,
        product=content,
        not_carried_over=lost,
        warnings=(*held.warnings, *left_out_sentences(lost, held.path), *flagged),
    )

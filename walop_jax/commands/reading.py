"""Whatever the program has written, or reads, back in memory: one door for sets, calibrations and runs."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path

from walop_jax.calibration import FAILED, PRODUCT, read_calibration
from walop_jax.calibration.calibration import Calibration
from walop_jax.data import CalibrationSet, read_calibration_set
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import primary_keywords
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior.files import DOCUMENTS, Run


def read(
    *paths: str | os.PathLike[str], kinds: Collection[str] = (), catalogue: Sequence[type[Effect]] = EFFECTS
) -> CalibrationSet | Calibration | Run:
    """Read calibration sets (several become one), a calibration product, or the folder of a run.

    `kinds` are kinds of exposures beyond those of the format, `catalogue` the effects that a fitted model may have.
    Raises `DataError`, naming file, extension, column and row, for what cannot be read or trusted.
    """
    if not paths:
        raise fail("no file was given", advice="name a calibration set, a calibration product or a run")
    first = Path(paths[0])
    if len(paths) == 1 and first.is_dir():
        if not any((first / name).exists() for name in (*DOCUMENTS.values(), PRODUCT)):
            what = f"holds no results{', its fit did not converge' if (first / FAILED).exists() else ''}"
            raise fail(what, file=first, advice="give the RUN of a command, or a FITS file")
        return Run(first, tuple(catalogue))
    if len(paths) == 1 and "PRODVERS" in primary_keywords(first):
        return read_calibration(first, catalogue)
    return read_calibration_set(*paths, kinds=kinds)

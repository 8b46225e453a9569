"""Whole frames made a calibration set of some hundred field points that says the same, from files to a file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence

from walop_jax.data.records import CalibrationSet
from walop_jax.data.write import write_calibration_set
from walop_jax.diagnosis.trust import pixel_structure
from walop_jax.fit.refit import FitResult, refit
from walop_jax.fit.stand_in import with_pixel_structure
from walop_jax.io.atomic import check_output
from walop_jax.io.errors import fail
from walop_jax.io.heartbeat import repeated
from walop_jax.io.text import read_text
from walop_jax.likelihood.compression import compressed
from walop_jax.likelihood.pixels import PixelPosterior
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.runs.inputs import sets_and_model


@dataclasses.dataclass(frozen=True)
class CompressedRun:
    """The fit of the frames, and the set that stands for their pixels at its minimum."""

    result: FitResult
    calset: CalibrationSet


def compress_frames(
    calsets: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] | None = None,
    instrument: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    memory: float | None = None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> CompressedRun:
    """Fit whole frames, and write the file `output`: a calibration set that stands for all of their pixels.

    It is read by everything that reads calibration sets. Arguments as for `refit_sets`. Raises `DataError` for files
    that cannot be read or written and for a set that cannot be compressed, ValueError for a model file that does not
    fit and a fit that does not converge, and what `refit` raises.
    """
    tell = progress or (lambda text: None)
    text = "" if model is None else read_text(model)
    check_output(output, overwrite=overwrite)
    tell("reading")
    calset, chosen = sets_and_model(calsets, text, model, instrument, catalogue)
    with repeated(tell) as say:
        result = refit(calset, chosen, progress=say, memory=memory)
    if not isinstance(result.posterior, PixelPosterior):
        raise fail(
            "cannot be compressed",
            file=calsets[0],
            advice="only whole frames of many pixels can, under a model that is smooth over the field, with detectors "
            "that report counts as they are; tables and small frames are small enough as they are",
        )
    if not result.converged:
        raise ValueError(f"the fit of the frames did not converge ({result.minimum.message})")
    tell("compressing")
    found = with_pixel_structure(compressed(result.posterior), pixel_structure(result))
    write_calibration_set(output, found, overwrite=overwrite)
    return CompressedRun(result, found)

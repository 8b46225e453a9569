"""`walop-jax compress`: whole frames as a calibration set of some hundred field points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Outcome, command
from walop_jax.commands.inputs import (
    IN_MEMORY,
    Effects,
    InstrumentLike,
    Memory,
    ModelLike,
    SetFile,
    Sets,
    in_bytes,
    set_and_model,
)
from walop_jax.io.errors import fail

if TYPE_CHECKING:
    from walop_jax import CalibrationSet


@command(stages=("reading", "fitting", "compressing"), writes="file")
def compress(
    job: Job,
    data: Sets,
    *,
    output: SetFile = None,
    model: ModelLike = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
    memory: Memory = 2.0,
) -> Outcome[CalibrationSet]:
    """Make of whole frames a calibration set of some hundred field points that says the same.

    The frames are fitted first. SET.fits is a megabyte; refit, diagnose, limits, epoch and sample read it like any
    other set and answer in seconds as from all pixels, near the values that were fitted: they say when these have
    moved too far. What is smaller than a twentieth of the field is not in it; the residual map of refit shows that.

    In Python: the set. Raises `DataError` for one that cannot be compressed, ValueError for a fit that does not
    converge.

    >>> small = walop.compress("frames.fits")  # doctest: +SKIP
    """
    from walop_jax.data.write import write_calibration_set
    from walop_jax.diagnosis.trust import pixel_structure
    from walop_jax.fit.refit import refit
    from walop_jax.fit.stand_in import with_pixel_structure
    from walop_jax.likelihood.compressed import compressed
    from walop_jax.likelihood.frames import PixelPosterior

    job.begin("reading")
    calset, chosen = set_and_model(data, model, instrument, effects)
    with job.repeated() as say:
        result = refit(calset, chosen, progress=say, memory=in_bytes(memory))
    if not isinstance(result.posterior, PixelPosterior):
        raise fail(
            "cannot be compressed",
            file=calset.inputs[0].path if calset.inputs else IN_MEMORY,
            advice="only whole frames of many pixels can, under a model that is smooth over the field, with detectors "
            "that report counts as they are; tables and small frames are small enough as they are",
        )
    if not result.converged:
        raise ValueError(f"the fit of the frames did not converge ({result.minimum.message})")
    job.begin("compressing")
    found = with_pixel_structure(compressed(result.posterior), pixel_structure(result))
    if output is not None:
        write_calibration_set(output, found, overwrite=job.overwrite)
    record, points = found.compression, len(found.points)
    assert record is not None
    size = None if output is None else Path(output).stat().st_size
    ratio = record.chi2 / max(record.dof, 1)
    return Outcome(
        found,
        lambda: {
            "output": output,
            "points": points,
            "pixels": record.pixels,
            "chi2": record.chi2,
            "dof": record.dof,
            "bytes": size,
        },
        lambda: (
            f"{record.pixels:,} pixels (χ²/dof {ratio:.5f}) in {points} field points: {output}, "
            f"{(size or 0) / 1e6:.1f} MB"
        ),
        warnings=result.warnings,
    )

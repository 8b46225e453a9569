"""`walop-jax compress`: whole frames as a calibration set of some hundred field points."""

from __future__ import annotations

import typer

from walop_jax.cli.common import (
    CalsetFiles,
    EffectsOption,
    InstrumentOption,
    JsonOption,
    MemoryOption,
    ModelOption,
    OutputSet,
    OverwriteOption,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
    warn,
)

STAGES = ("reading", "preparing the fit", "compressing")


def compress(
    calsets: CalsetFiles,
    output: OutputSet,
    model: ModelOption = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    memory: MemoryOption = 2.0,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Make of whole frames a calibration set of some hundred field points that says the same.

    The frames are fitted first. SET.fits is a megabyte; refit, diagnose, limits, epoch and sample read it like any
    other set and answer in seconds as from all pixels, near the values that were fitted: they say when these have
    moved too far. What is smaller than a twentieth of the field is not in it; the residual map of refit shows that.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.compress import compress_frames

    with progress(quiet or json, STAGES) as tell:
        found = compress_frames(
            calsets,
            output,
            model=model,
            instrument=instrument,
            overwrite=overwrite,
            memory=memory * 1e9,
            catalogue=catalogue_with(effects),
            progress=tell,
        )
    record, points = found.calset.compression, len(found.calset.points)
    assert record is not None
    ratio = record.chi2 / max(record.dof, 1)
    if json:
        print_json(
            {
                "output": str(output),
                "points": points,
                "pixels": record.pixels,
                "chi2": record.chi2,
                "dof": record.dof,
                "bytes": output.stat().st_size,
            }
        )
    for sentence in found.result.warnings:
        warn(sentence)
    if not (json or quiet):
        size = output.stat().st_size / 1e6
        typer.echo(
            f"{record.pixels:,} pixels (χ²/dof {ratio:.5f}) in {points} field points: {output}, {size:.1f} MB"
        )

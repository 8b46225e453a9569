"""`walop-jax refit`: the joint fit of calibration sets, from files to files."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from walop_jax.cli.common import (
    UNTRUSTED,
    CalsetFiles,
    CommandError,
    EffectsOption,
    InstrumentOption,
    JsonOption,
    MemoryOption,
    ModelOption,
    OverwriteOption,
    ProcessesOption,
    QuietOption,
    RunFolder,
    print_json,
    progress,
    shared,
    switch_on_jax,
    warn,
)

if TYPE_CHECKING:
    from walop_jax.runs.refit import RefitRun

STAGES = ("reading", "preparing the fit", "mapping the field")


def refit(
    calsets: CalsetFiles,
    output: RunFolder,
    model: ModelOption = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    memory: MemoryOption = 2.0,
    processes: ProcessesOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Fit all field points of calibration sets jointly: RUN/calibration.fits and RUN/summary.json.

    RUN is created if necessary. If it holds a calibration already, the command stops unless --overwrite is given;
    then these two files are replaced and all others stay.

    A fit that does not converge leaves RUN/summary.failed.json, no calibration, and exit code 1. One that
    converges but is not to be trusted (it does not explain the data, a parameter lies far from its prior, the
    residuals hold patterns or differ between parts of the data) is written with TRUSTED = F and warnings, exit
    code 3.

    Sets of more than 65536 points (whole frames) are read in slabs on every pass. Finished slabs are kept in
    RUN/partial until the end, so that the same command resumes an interrupted fit. The calibration then holds a map of
    what the smooth model leaves.
    """
    switch_on_jax()
    with shared(processes) as crew, progress(quiet or json or crew.index > 0, STAGES) as tell:
        from walop_jax.model.effects.own import catalogue_with
        from walop_jax.runs.refit import refit_sets

        found = refit_sets(
            calsets,
            output,
            model=model,
            instrument=instrument,
            overwrite=overwrite,
            memory=memory * 1e9,
            processes=crew,
            progress=tell,
            catalogue=catalogue_with(effects),
        )
    if crew.index > 0:
        return
    if json:
        print_json(found.summary)
    if not found.result.converged:
        raise CommandError(
            f"{output}: the fit did not converge ({found.result.minimum.message}); see summary.failed.json there"
        )
    for sentence in found.warnings:
        warn(sentence)
    if not (json or quiet):
        _show(found, output)
    if not found.result.trusted:
        raise typer.Exit(UNTRUSTED)


def _show(found: RefitRun, output: Path) -> None:
    typer.echo(dataclasses.replace(found.result.display(), notes=found.result.notes).text())
    verdict = "trusted" if found.result.trusted else "NOT trusted"
    typer.echo(f"{verdict}: {output}   ({found.seconds:.1f} s)")

"""`walop-jax refit`: the joint fit of calibration sets, from files to files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.cli.common import (
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
    SeedOption,
    print_json,
    progress,
    shared,
    switch_on_jax,
    warn,
)

if TYPE_CHECKING:
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.refit import RefitRun


def refit(
    calsets: CalsetFiles,
    output: RunFolder,
    model: ModelOption = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    memory: MemoryOption = 2.0,
    processes: ProcessesOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Fit all field points of calibration sets jointly: RUN/calibration.fits and RUN/summary.json.

    RUN is made if need be. A RUN that holds a calibration is left alone unless --overwrite is given; then
    these two files are replaced and others stay.

    A fit that does not converge leaves RUN/summary.failed.json, no calibration, and exit code 1. One that
    converges without explaining the data is written with TRUSTED = F and warnings, exit code 0.

    Sets of more than 65536 points (whole frames) are read in slabs, anew on every pass. Finished slabs
    are kept in RUN/partial until the end: the same command goes on where it was interrupted. The
    calibration holds a map of what the smooth model leaves.
    """
    switch_on_jax()
    with shared(processes) as crew, progress(quiet or json or crew.index > 0) as tell:
        from walop_jax.runs.refit import refit_sets

        found = refit_sets(
            calsets,
            output,
            model=model,
            instrument=instrument,
            seed=seed,
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


def _show(found: RefitRun, output: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    result = found.result
    table = Table("parameter", "value", "error", "unit", "from its prior")
    series = set(result.model.positions("throughput").tolist())
    for i, (p, value, sigma) in enumerate(
        zip(result.model.parameters, result.values, result.sigma, strict=True)
    ):
        if i in series or sigma == 0:
            continue
        pull = "" if p.prior is None else f"{(value - p.prior[0]) / p.prior[1]:+.2f} σ"
        table.add_row(p.name, f"{value:.7g}", f"{sigma:.2g}", p.unit, pull)
    console = Console(highlight=False)
    console.print(table)
    console.print(
        f"χ² = {result.chi2:.6g} for {result.dof} degrees of freedom "
        f"({result.chi2 / max(result.dof, 1):.4f}), {result.n_data} intensities, "
        f"{len(result.model.free)} free parameters, {found.seconds:.1f} s",
        soft_wrap=True,
    )
    console.print(f"{'trusted' if result.trusted else 'NOT trusted'}: {output}", markup=False, soft_wrap=True)

"""`walop-jax refit`: the joint fit of calibration sets, from files to files."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.cli.common import (
    CalsetFiles,
    CommandError,
    JsonOption,
    MemoryOption,
    ModelOption,
    OverwriteOption,
    ProcessesOption,
    QuietOption,
    RunFolder,
    SeedOption,
    json_text,
    named,
    print_json,
    progress,
    read_text,
    shared,
    switch_on_jax,
    warn,
)

if TYPE_CHECKING:
    from walop_jax.calibration.records import ResidualMap
    from walop_jax.fit.refit import FitResult
    from walop_jax.likelihood.problem import Problem


def refit(
    calsets: CalsetFiles,
    output: RunFolder,
    model: ModelOption = None,
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
    began = time.perf_counter()
    from walop_jax.calibration.summary import PRODUCT, SUMMARY
    from walop_jax.io.folder import check_folder

    text = "" if model is None else read_text(model)
    check_folder(output, (PRODUCT, SUMMARY), overwrite=overwrite)
    switch_on_jax()
    with shared(processes) as first, progress(quiet or json or not first) as tell:
        from walop_jax.calibration.residual_map import residual_map
        from walop_jax.calibration.summary import PARTIAL, identity, summary
        from walop_jax.data import read_calibration_set
        from walop_jax.fit.misfit import describe
        from walop_jax.fit.model_builder import model_for
        from walop_jax.fit.refit import fit
        from walop_jax.likelihood.journal import Journal
        from walop_jax.likelihood.problem import Problem

        tell("reading")
        calset = read_calibration_set(*calsets)
        with named(model):
            chosen = model_for(calset, text)
        problem = Problem(calset, chosen, memory=memory * 1e9)
        tell(f"preparing the fit; data will take {problem.chunks.memory / 1e9:.2g} GB")
        if problem.is_large:
            passes = problem.passes
            here = f"{passes.processes.index}/{passes.processes.count}"
            passes.journal = Journal(output / PARTIAL, f"{identity(calset, chosen)} {here}")
            passes.watch = _watching(tell, len(calset.points))
        result = fit(problem, progress=lambda label, step, chi2: tell(f"{label}: step {step}, χ² {chi2:.7g}"))
        residuals = residual_map(problem, result.values) if problem.is_large and result.converged else None
        misfit = None
        if not result.explains_data and first:
            tell("looking at the misfit")
            misfit = describe(problem, result.values)
        seconds = time.perf_counter() - began
        found = summary(result, calset, seconds=seconds, misfit=misfit, residuals=residuals) | {"seed": seed}
        if first:
            tell("mapping the field")
            _write(output, result, problem, residuals, found, overwrite=overwrite)
    if not first:
        return
    if json:
        print_json(found)
    if not result.converged:
        raise CommandError(
            f"{output}: the fit did not converge ({result.minimum.message}); see summary.failed.json there"
        )
    for sentence in (*result.warnings, *(() if misfit is None else misfit.sentences())):
        warn(sentence)
    if not (json or quiet):
        _show(result, output, seconds)


def _watching(tell: Callable[[str], None], points: int) -> Callable[[str, int, float], None]:
    def watch(label: str, done: int, rate: float) -> None:
        left = (points - done) / rate
        tell(f"{label}: {done:,} of {points:,} points, {rate:,.0f} points/s, {left:.0f} s left of this pass")

    return watch


def _write(
    output: Path,
    result: FitResult,
    problem: Problem,
    residuals: ResidualMap | None,
    found: dict[str, Any],
    *,
    overwrite: bool,
) -> None:
    """The files of a run; what was kept of a fit on the way goes."""
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.calibration.product import write_product
    from walop_jax.calibration.summary import FAILED, PARTIAL, PRODUCT, SUMMARY
    from walop_jax.io.atomic import atomic_path
    from walop_jax.io.folder import atomic_folder

    if not result.converged:
        output.mkdir(exist_ok=True)
        with atomic_path(output / FAILED, overwrite=True) as temporary:
            temporary.write_text(json_text(found), encoding="utf-8")
    else:
        calibration = dataclasses.replace(Calibration.from_fit(result, problem), residuals=residuals)
        product = calibration.to_product()
        with atomic_folder(output, (PRODUCT, SUMMARY), overwrite=overwrite) as folder:
            write_product(folder / PRODUCT, product)
            (folder / SUMMARY).write_text(json_text(found), encoding="utf-8")
        (output / FAILED).unlink(missing_ok=True)
    shutil.rmtree(output / PARTIAL, ignore_errors=True)


def _show(result: FitResult, output: Path, seconds: float) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("parameter", "value", "error", "unit", "from its prior")
    for p, value, sigma in zip(result.model.parameters, result.values, result.sigma, strict=True):
        if p.name.startswith("throughput.") or sigma == 0:
            continue
        pull = "" if p.prior is None else f"{(value - p.prior[0]) / p.prior[1]:+.2f} σ"
        table.add_row(p.name, f"{value:.7g}", f"{sigma:.2g}", p.unit, pull)
    console = Console(highlight=False)
    console.print(table)
    console.print(
        f"χ² = {result.chi2:.6g} for {result.dof} degrees of freedom "
        f"({result.chi2 / max(result.dof, 1):.4f}), {result.n_data} intensities, "
        f"{len(result.model.free)} free parameters, {seconds:.1f} s",
        soft_wrap=True,
    )
    console.print(f"{'trusted' if result.trusted else 'NOT trusted'}: {output}", markup=False, soft_wrap=True)

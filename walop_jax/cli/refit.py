"""`walop-jax refit`: the joint fit of calibration sets, from files to files."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.cli.common import (
    CalsetFiles,
    CommandError,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    RunFolder,
    SeedOption,
    json_text,
    named,
    print_json,
    progress,
    read_text,
    switch_on_jax,
    warn,
)

if TYPE_CHECKING:
    from walop_jax.fit.refit import FitResult


def refit(
    calsets: CalsetFiles,
    output: RunFolder,
    model: ModelOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Fit all field points of calibration sets jointly: RUN/calibration.fits and RUN/summary.json.

    RUN is made if need be. A RUN that holds a calibration is left alone unless --overwrite is given; then
    these two files are replaced and others stay.

    A fit that does not converge leaves RUN/summary.failed.json, no calibration, and exit code 1. One that
    converges without explaining the data is written with TRUSTED = F and warnings, exit code 0.
    """
    began = time.perf_counter()
    from walop_jax.data.atomic import atomic_path
    from walop_jax.data.folder import atomic_folder, check_folder
    from walop_jax.data.product import write_product
    from walop_jax.fit.summary import FAILED, PRODUCT, SUMMARY, summary

    text = "" if model is None else read_text(model)
    check_folder(output, (PRODUCT, SUMMARY), overwrite=overwrite)
    switch_on_jax()
    from walop_jax.data import read_calibration_set
    from walop_jax.fit.building import model_for
    from walop_jax.fit.calibration import Calibration
    from walop_jax.fit.misfit import describe
    from walop_jax.fit.refit import fit
    from walop_jax.likelihood.problem import Problem

    with progress(quiet or json) as tell:
        tell("reading")
        calset = read_calibration_set(*calsets)
        with named(model):
            chosen = model_for(calset, text)
        tell("preparing the fit")
        problem = Problem(calset, chosen)
        if problem.sketches:
            every = len(calset.points)
            problem.watch = lambda done, rate: tell(
                f"{done:,} of {every:,} points, {rate:,.0f} points/s, {(every - done) / rate:.0f} s left of this step"
            )
        result = fit(problem, progress=lambda label, step, chi2: tell(f"{label}: step {step}, χ² {chi2:.7g}"))
        misfit = None
        if not result.explains_data:
            tell("looking at the misfit")
            misfit = describe(problem, result.values)

        def summarise() -> dict[str, Any]:
            seconds = time.perf_counter() - began
            return summary(result, calset, seconds=seconds, misfit=misfit) | {"seed": seed}

        if not result.converged:
            output.mkdir(exist_ok=True)
            found = summarise()
            with atomic_path(output / FAILED, overwrite=True) as temporary:
                temporary.write_text(json_text(found), encoding="utf-8")
        else:
            tell("mapping the field")
            product = Calibration.from_fit(result, problem).to_product()
            found = summarise()
            with atomic_folder(output, (PRODUCT, SUMMARY), overwrite=overwrite) as folder:
                write_product(folder / PRODUCT, product)
                (folder / SUMMARY).write_text(json_text(found), encoding="utf-8")
            (output / FAILED).unlink(missing_ok=True)

    if json:
        print_json(found)
    if not result.converged:
        raise CommandError(
            f"{output}: the fit did not converge ({result.minimum.message}); see {FAILED} there"
        )
    for sentence in (*result.warnings, *(() if misfit is None else misfit.sentences())):
        warn(sentence)
    if not (json or quiet):
        _show(result, output, found["seconds"])


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

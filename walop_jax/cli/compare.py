"""`walop-jax compare`: the published method and the joint model on the same calibration set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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

FILES = (
    "comparison.json",
    "comparison.fits",
    "comparison_histogram.png",
    "comparison_map.png",
    "comparison_offset.png",
    "comparison_spectral.png",
)
TruthOption = Annotated[
    Path | None,
    typer.Option("--truth", metavar="TABLE", help="True X, Y, M21 … M33 (FITS, CSV), for simulated sets."),
]
FilterOption = Annotated[str, typer.Option("--filter", metavar="NAME", help="Filter to compare in.")]


def compare(
    calsets: CalsetFiles,
    output: RunFolder,
    truth: TruthOption = None,
    filter_name: FilterOption = "SDSS-r",
    model: ModelOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Run the method of Paper II as it is published, and the joint fit, and tell how good each is.

    A quadratic per grid point, a transmission model per camera, 100 stars with p up to 5 %, corrections Δq and
    Δu; on the grid points and between them. The reference is the joint model, or the truth that comes with a
    simulated set. RUN/comparison.json has the statistics, comparison.fits every point, four figures the rest: also
    the spectral appendix and the full-Moon scheme.
    """
    from walop_jax.io.folder import atomic_folder, check_folder

    text = "" if model is None else read_text(model)
    check_folder(output, FILES, overwrite=overwrite)
    switch_on_jax()
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.data import read_calibration_set
    from walop_jax.data.user_tables import new_table, true_matrices, write_output_table
    from walop_jax.fit.model_builder import model_for
    from walop_jax.fit.refit import fit
    from walop_jax.likelihood.problem import Problem
    from walop_jax.paper.comparison import Truth
    from walop_jax.paper.comparison import compare as both
    from walop_jax.reports import comparison_figures as figures

    with progress(quiet or json) as tell:
        tell("reading")
        calset = read_calibration_set(*calsets)
        known = None if truth is None else Truth(*true_matrices(truth, calset.instrument))
        with named(model):
            chosen = model_for(calset, text)
        tell("fitting the joint model")
        problem = Problem(calset, chosen)
        result = fit(problem)
        if not result.converged:
            raise CommandError(f"the joint fit did not converge ({result.minimum.message})")
        tell("fitting and judging the polynomials")
        found = both(calset, Calibration.from_fit(result, problem), known, filter_name, seed or 0)
        document = found.document()
        with atomic_folder(output, FILES, overwrite=overwrite) as folder:
            (folder / FILES[0]).write_text(json_text(document), encoding="utf-8")
            write_output_table(folder / FILES[1], new_table(found.columns()), {})
            for name in FILES[2:]:
                figure = getattr(figures, f"{name.removeprefix('comparison_').removesuffix('.png')}_figure")
                figure(found).savefig(folder / name, dpi=130)
    if not result.trusted:
        warn("the joint fit is not trusted: see walop-jax refit")
    if json:
        print_json(document)
    elif not quiet:
        _show(document, output)


def _show(document: dict, output: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("where", "error", "method", "median", "rms", "95 %", "max", "< 0.1 %")
    for place, title in (("on_grid", "on grid"), ("between", "between")):
        for quantity in ("q", "u", "p"):
            for method in ("paper", "joint"):
                s = document[place][method]["all"][quantity]
                row = [f"{s[k]:.4f} %" for k in ("median", "rms", "p95", "max")]
                table.add_row(title, quantity, method, *row, f"{100 * s['share_below_goal']:.1f} %")
    console = Console(highlight=False)
    console.print(table)
    console.print(
        f"joint errors from the {document['joint_errors_from']}; {output}", markup=False, soft_wrap=True
    )

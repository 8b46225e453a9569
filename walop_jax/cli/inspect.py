"""`walop-jax inspect`: what is in calibration sets, and what is wrong with them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import CommandError, JsonOption, QuietOption, print_json

if TYPE_CHECKING:
    from walop_jax.data.inspection import Inspection

Files = Annotated[list[Path], typer.Argument(metavar="CALSET...", help="Calibration sets (FITS).")]


def inspect(calsets: Files, json: JsonOption = False, quiet: QuietOption = False) -> None:
    """Say what is in calibration sets and what is wrong with them.

    Each file by itself; then whether they can be fitted as one. Exit code 1 if any cannot be read or fitted.
    """
    from walop_jax.runs.inspect import inspect_sets

    found = inspect_sets(calsets, progress=None if json or quiet else _show)
    if json:
        print_json(found.document())
    if found.faults:
        raise CommandError("; ".join(found.faults))


def _show(report: Inspection) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.print(f"[bold]{', '.join(report.files)}[/bold]", soft_wrap=True)
    low_x, high_x, low_y, high_y = report.field
    counted = math.isfinite(report.median_counts)
    lines = {
        "instrument": f"{report.instrument}, {report.telescope} ({report.origin or 'origin not stated'})",
        "field points": f"{report.points}, X {low_x:+.3f} … {high_x:+.3f}°, Y {low_y:+.3f} … {high_y:+.3f}°",
        "cameras": str(report.cameras),
        "polariser angles": f"{len(report.angles)} modulo 180°, widest gap {report.widest_gap:.3g}°",
        **{
            f"element {use.prefix}": f"in {use.exposures} exposures, {len(use.angles)} angles"
            for use in report.elements
        },
        "used": f"{report.rows} of {report.possible} (exposure, point) pairs"
        + (f" at {report.looked_at} points looked at" if report.looked_at < report.points else ""),
        "flagged": ", ".join(f"{count} {name}" for name, count in report.flags.items()) or "none",
        "median counts": f"{report.median_counts:.4g} electrons" if counted else "none: KIND flux throughout",
        "errors": f"{report.noise_ratio**0.5:.4g} × the photon noise √N (median)" if counted else "as stated",
        "standards": ", ".join(report.sources) or "none",
        "filters": ", ".join(report.filters),
    }
    for name, text in lines.items():
        console.print(f"  {name:<17} {text}", markup=False, soft_wrap=True)
    table = Table("kind", "filter", "calibration plate", "source", "exposures", "angles", "used")
    for group in report.groups:
        table.add_row(
            group.kind,
            group.filter,
            group.calibration_plate,
            group.teff,
            str(group.exposures),
            str(group.angles) if group.angles else "",
            f"{100 * group.used:.0f} %",
        )
    console.print(table)
    if not report.findings:
        console.print("  nothing is wrong", style="green")
    colours = {"fault": "red", "doubt": "yellow", "note": "cyan"}
    for finding in report.findings:
        console.print(f"  [{colours[finding.severity]}]{finding.severity}[/] ", end="")
        console.print(str(finding), markup=False, soft_wrap=True)

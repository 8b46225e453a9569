"""`walop-jax quality`: a row of quality numbers for each night, kept in a table, with limits and a figure."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from walop_jax.commands.command import Job, Option, Outcome, PathLike, command, several
from walop_jax.commands.plot import check_picture
from walop_jax.commands.products import Effects, Product, calibration_of
from walop_jax.io.atomic import check_output
from walop_jax.io.display import Display
from walop_jax.io.run_folder import RunFolder
from walop_jax.io.text import rounded, with_error

SHOWN = {
    "CHI2DOF": (1.0, ""), "ANGLE": (1.0, "deg"), "P_RATIO": (1.0, ""), "ZERO_Q": (100.0, "%"), "ZERO_U": (100.0, "%"),
    "ACCURACY": (100.0, "%"),
}  # fmt: skip
"""Columns that are printed, with the factor and the unit in which they are."""


OPTIONS = {
    "runs": Option(
        "Runs or calibrations, one for each night.", metavar="RUN...", kind=list[Path], placed=True
    ),
    "output": Option(
        "Table that the nights are added to (.ecsv, .csv, .fits).",
        metavar="QUALITY.ecsv",
        kind=Path,
        short="-o",
        required=True,
    ),
    "limits": Option("Limits in place of those of the package.", metavar="LIMITS.toml", kind=Path),
    "figure": Option("Draw all nights of the table: .png, .pdf, .svg.", metavar="FILE", kind=Path),
}


@command(stages=("reading", "writing"), outputs=("output", "figure"), options=OPTIONS)
def quality(
    job: Job,
    runs: Product | Sequence[Product],
    *,
    output: PathLike | None = None,
    limits: PathLike | None = None,
    figure: PathLike | None = None,
    effects: Effects = None,
) -> Outcome[Any]:
    """Add a row of quality numbers for each night to a table, and list those outside their limits.

    Angle and p of polarised standards and q, u of unpolarised ones against their catalogue (each as all other data see
    it), χ², gains of the cameras, the accuracy of p and undetectable errors. A night that is there already is
    replaced, the same calibration is not added twice; the table is whole whenever it is read.

    Exit code 3 if a number of these nights is outside its limits, or a fit is not trusted.

    In Python: the astropy table, of all nights where `output` is given.

    >>> walop.quality("RUN")["CHI2DOF", "OUTSIDE"]  # doctest: +SKIP
    """
    from walop_jax.io.plain_tables import table_format
    from walop_jax.reports.posterior_figures import save_figure
    from walop_jax.reports.survey_figures import quality_figure
    from walop_jax.science.quality import ERRORS, OUTSIDE, append, quality_row, read_limits, table_of_nights

    allowed = read_limits(limits)
    if output is not None:
        check_output(output, overwrite=True)
        table_format(output)
    if figure is not None:
        check_picture(figure, overwrite=True)
    sources = several(runs)
    rows, remarks = [], []
    for number, run in enumerate(sources, start=1):
        job.tell(f"run {number} of {len(sources)}", "reading")
        held, folder = calibration_of(run, effects), getattr(run, "folder", run)
        folder = Path(folder) if isinstance(folder, str | os.PathLike) else None
        documents = RunFolder(folder).documents if folder is not None and folder.is_dir() else {}
        accuracy = documents.get("summary", {}).get("accuracy_of_p")
        rows.append(quality_row(held, str(folder or held.path), accuracy))
        if rows[-1]["NIGHTS"] > 1:
            nights = f"{rows[-1]['NIGHTS']} nights"
            remarks.append(f"{rows[-1]['RUN']}: holds {nights}, its row is that of the last")
    job.begin("writing")
    table, table_remarks = append(output, table_of_nights(rows), allowed)
    remarks += table_remarks
    if figure is not None:
        save_figure(figure, quality_figure(table, allowed), overwrite=True)
    hashes = {row["CALHASH"] for row in rows}
    mine = [row for row in table if str(row["CALHASH"]) in hashes]
    out = [f"night {row['NIGHT']:.0f}: {row[OUTSIDE]} outside the limits" for row in mine if row[OUTSIDE]]

    def printed(row: Any, name: str) -> str:
        factor, _ = SHOWN[name]
        if name not in ERRORS:
            return rounded(factor * float(row[name]))
        return with_error(factor * float(row[name]), factor * float(row[ERRORS[name]]))

    shown = tuple(
        (f"{row['NIGHT']:.0f}", *(printed(row, name) for name in SHOWN), str(row[OUTSIDE])) for row in mine
    )
    head = (
        "night (MJD)",
        *(f">{name} ({unit})" if unit else f">{name}" for name, (_, unit) in SHOWN.items()),
        "outside",
    )
    title = f"{output or 'Quality numbers'}: {len(table)} night{'s' if len(table) != 1 else ''}"
    nights = [{name: row[name] for name in table.colnames} for row in mine]
    document = {"output": output, "nights": nights, "limits": {n: list(pair) for n, pair in allowed.items()}}
    document |= {"outside": out, "remarks": remarks}
    display = Display(title, head=head, rows=shown)
    return Outcome(table, document, display=display, warnings=(*remarks, *out), trusted=not out)

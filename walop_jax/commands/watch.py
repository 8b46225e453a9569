"""`walop-jax watch`: when a calibration became invalid, from the stars of many nights."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.apply import stars_of
from walop_jax.commands.command import Job, Option, Outcome, PathLike, command, figure_file, typed
from walop_jax.commands.products import Effects, Product, calibration_of
from walop_jax.commands.tables import named_tables
from walop_jax.io.errors import errors_naming
from walop_jax.io.names import WATCHED

if TYPE_CHECKING:
    from walop_jax.science.watch import Watch

TABLE, FIGURE = "watch.fits", "watch.png"


OPTIONS = {
    "calibration": Option(
        "Calibration product, or the folder of a run.", metavar="RUN/calibration.fits", kind=Path, placed=True
    ),
    "catalogues": Option(
        "FITS, CSV or ECSV with X, Y, N, N_ERR, and MJD.",
        metavar="CATALOGUE...",
        kind=list[Path],
        placed=True,
    ),
    "output": Option(
        "Folder for watch.json, watch.fits and watch.png.", metavar="RUN", kind=Path, short="-o"
    ),
    "force": Option("Also stars whose filter or temperature the calibration does not cover."),
}


@command(stages=("reading", "tabulating", "watching"), writes=(WATCHED, TABLE, FIGURE), options=OPTIONS)
def watch(
    job: Job,
    calibration: Product,
    catalogues: Any,
    *,
    output: PathLike | None = None,
    effects: Effects = None,
    force: bool = False,
) -> Outcome[Watch]:
    """Find when a calibration became invalid, from the stars of many nights: no calibration exposures are needed.

    Four cameras have three unknowns: one number of every row is left. Rows of one MJD are an exposure group; catalogues
    without MJD are a group each, in their order. Steps, drifts and single exposures of cameras and arms are looked for,
    as a whole, growing over the field, or in a spot of it, with their size, date, and the smallest that would have been
    seen. Stars that are seen at several settings of the plate or the rotator single out the camera; others hardly
    can. Changes of the optics that explain the stars as well are reported.

    Exit code 0 only where the calibration still holds, 3 where it does not.

    In Python: a `Watch`; `catalogues` is a path, an astropy table, columns by name, or several of them in a list.

    >>> walop.watch("RUN", ["night1.fits", "night2.fits"])  # doctest: +SKIP
    """
    from walop_jax.reports.survey_figures import watch_figure
    from walop_jax.science.watch import watch as watched

    job.begin("reading")
    held = calibration_of(calibration, effects)
    names, tables = zip(*named_tables(catalogues), strict=True)
    rows = [stars_of(table, held) for table in tables]
    job.tell("tabulating the analysis vectors", "tabulating")
    with errors_naming(", ".join(names)):
        history = watched(held, rows, names=names, force=force)
    table = history.to_table()
    return Outcome(
        history,
        extra={"product": held.content_hash()},
        files={
            TABLE: lambda path: table.write(path, format="fits"),
            FIGURE: figure_file(watch_figure, history),
        },
        saved_as=WATCHED,
        warnings=held.warnings,
        trusted=history.holds,
        next=(typed("report", output),),
    )

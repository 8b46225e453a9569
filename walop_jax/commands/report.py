"""`walop-jax report`: one self-contained page about a run."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Option, Outcome, PathLike, UsageError, command, write_text
from walop_jax.commands.inputs import goal_of, save
from walop_jax.commands.products import Effects, FitLike, catalogue_of, fit_of, folder_of
from walop_jax.io.atomic import check_output
from walop_jax.io.text import encodable

if TYPE_CHECKING:
    from walop_jax.reports.page import Page

PAGE = "report.html"


OPTIONS = {
    "run": Option("Folder of results, of whichever command.", metavar="RUN", kind=Path, placed=True),
    "output": Option("Page to write (default: RUN/report.html).", metavar="FILE", kind=Path, short="-o"),
    "data": Option(
        "Calibration set of the fit, if it has moved; again for each.", metavar="CALSET", kind=list[Path]
    ),
}


@command(stages=("reading", "drawing"), writes=(), options=OPTIONS)
def report(
    job: Job,
    run: FitLike,
    output: PathLike | None = None,
    *,
    data: Sequence[PathLike] | None = None,
    effects: Effects = None,
    goal: float | None = None,
) -> Outcome[Page]:
    """Write one HTML page about a run, figures inside: it needs no network and no other file, and can be mailed or
    printed.

    First whether the calibration is good enough for --goal (default: that of the fit), and what to do if not. The
    verdict, the accuracy of p over the field, the data, the findings, residuals before and after, maps
    of the matrix and of its errors, pulls from the priors, all parameters, warnings, inputs and versions, as far as RUN
    holds them; the page names missing files. Results of sample and limits in RUN are there as well; compare,
    check, limits, plan and stack have pages of their own. A page that exists is made anew; another file
    of that name is left alone unless --overwrite is given.

    In Python: a `Page`; of a fit or a diagnosis in memory, which needs an `output`.

    >>> walop.report(result, "page.html")  # doctest: +SKIP
    """
    from walop_jax import FitResult, Run
    from walop_jax.commands.diagnose import write
    from walop_jax.reports.page import Page, is_page, kind_of_run, render, render_other
    from walop_jax.reports.run import read_run

    wanted = goal_of(goal)
    with tempfile.TemporaryDirectory() as scratch:
        if isinstance(fit_of(run), FitResult):
            if output is None:
                raise UsageError("give output, the folder for the page of a fit in memory", "output")
            folder, data = Path(scratch) / "fit", ()
            written: Any = save if isinstance(run, FitResult) else write
            written(run, folder)
        else:
            folder = folder_of(run)  # pyright: ignore[reportArgumentType]
        target = folder / PAGE if output is None else Path(output)
        job.begin("reading")
        kind = kind_of_run(folder)
        if kind != "fit" and (wanted is not None or data):
            raise UsageError("this is for the page about a fit", "data" if wanted is None else "goal")
        contents = read_run(Run(folder, catalogue_of(effects), tuple(data or ()))) if kind == "fit" else None
        overwrite = job.overwrite or is_page(target)
        check_output(target, overwrite=overwrite)
        job.tell("drawing", "drawing")
        page = render_other(folder, kind) if contents is None else render(contents, wanted)
    text, missing = encodable(page[0]), page[1]
    write_text(target, text, overwrite=overwrite)
    return Outcome(Page(target, len(text.encode()), missing), next=("open the page in a browser",))

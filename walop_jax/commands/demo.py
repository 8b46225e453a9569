"""`walop-jax demo`: the main job on the calibration set that comes with the package."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from walop_jax.commands.command import Job, Option, Outcome, command, command_of
from walop_jax.commands.inputs import PathLike
from walop_jax.commands.refit import STAGES, refit
from walop_jax.io.errors import fail

if TYPE_CHECKING:
    from walop_jax.fit.refit import FitResult

SET = "walop_south_small.fits"
FOLDER = Option("Folder to write.", "FOLDER", Path, "-o")


@command(stages=STAGES, writes=())
def demo(job: Job, *, output: Annotated[PathLike, FOLDER] = "walop-jax-demo") -> Outcome[FitResult]:
    """Fit the small calibration set that comes with the package, and write the page about it.

    A simulated run of WALOP-South: the set is copied to FOLDER, the fit is FOLDER/RUN, its page FOLDER/RUN/report.html.

    In Python: the fit.

    >>> walop.demo(output="there")  # doctest: +SKIP
    """
    from walop_jax.commands.report import report

    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    calset, run = folder / SET, folder / "RUN"
    shutil.copyfile(_shipped(), calset)
    fit = command_of(refit).run(job, {"data": [calset], "output": run})
    page = command_of(report).run(job, {"run": run}).value.path
    return Outcome(
        fit.value,
        {"run": str(run), "page": str(page), "summary": fit.content},
        f"{fit.printed()}\nThe page about it: {page}",
        warnings=fit.warnings,
        trusted=fit.trusted,
        next=(
            f"walop-jax matrix {run} --x 0.1 --y 0.2",
            f"walop-jax diagnose {calset} -o {folder}/DIAGNOSIS",
        ),
    )


def _shipped() -> Path:
    """The set in an installed package, or in a clone."""
    package = Path(__file__).resolve().parents[1]
    for path in (package / "demo" / SET, package.parent / "fits_data" / SET):
        if path.exists():
            return path
    raise fail("the demonstration set is not there", file=SET, advice="install the package again")

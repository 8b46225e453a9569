"""`walop-jax demo`: the main job on the calibration set that comes with the package."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Option, Outcome, PathLike, command, command_of, typed
from walop_jax.commands.refit import STAGES, refit
from walop_jax.io.errors import fail

if TYPE_CHECKING:
    from walop_jax.fit.refit import FitResult

SET, PLAN, SEED = "walop_south_small.fits", "walop_south_small_plan.toml", 2026
STARS, CORRECTED, COUNT = "stars.fits", "stars_corrected.fits", 200


OPTIONS = {
    "output": Option("Folder to write.", metavar="FOLDER", kind=Path, short="-o"),
}


@command(stages=STAGES, writes=(), options=OPTIONS)
def demo(job: Job, *, output: PathLike = "walop-jax-demo") -> Outcome[FitResult]:
    """Fit the small calibration set that comes with the package, write its page, and correct stars.

    A simulated run of WALOP-South: the set is copied to FOLDER, the fit is FOLDER/RUN, its page FOLDER/RUN/report.html.
    The stars are simulated as well, as the same instrument sees them: FOLDER/stars.fits, with true q and u in
    FOLDER/stars_truth.json; FOLDER/stars_corrected.fits is what walop-jax apply makes of them.

    In Python: the fit, a `FitResult`.

    >>> walop.demo(output="there")  # doctest: +SKIP
    """
    from walop_jax.commands.report import report

    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    calset, run = folder / SET, folder / "RUN"
    shutil.copyfile(_shipped(SET), calset)
    fit = command_of(refit).run(job, {"data": [calset], "output": run})
    page = command_of(report).run(job, {"run": run}).value.path
    pull = _stars(job, run, folder)
    places = {"run": str(run), "page": str(page), "stars": str(folder / CORRECTED)}
    return Outcome(
        fit.value,
        {**places, "pull": pull, "summary": fit.content},
        f"{fit.printed()}\nThe page about it: {page}\n{COUNT} simulated stars corrected with it: {folder / CORRECTED}; "
        f"q and u differ from the truth by {pull:.2f} of their errors (rms)",
        warnings=fit.warnings,
        trusted=fit.trusted,
        next=(
            typed("matrix", run, "--x", "0.1", "--y", "0.2"),
            typed("diagnose", calset, "-o", folder / "DIAGNOSIS"),
        ),
    )


def _stars(job: Job, run: Path, folder: Path) -> float:
    """Simulate stars, correct them, and give the rms difference from the truth in their errors."""
    import json

    import numpy as np

    from walop_jax.commands.apply import apply
    from walop_jax.commands.simulate import simulate

    again = dataclasses.replace(job, seed=SEED, overwrite=True)  # made anew, as the set is
    truth = folder / "stars_truth.json"
    options = {"plan": _shipped(PLAN), "stars": COUNT, "output": folder / STARS, "truth": truth}
    command_of(simulate).run(again, options)
    arguments = {"calibration": run, "catalogue": [folder / STARS], "output": folder / CORRECTED}
    corrected = command_of(apply).run(again, arguments).value
    true = json.loads(truth.read_text(encoding="utf-8"))["stars"]
    pulls = [(np.asarray(corrected[n]) - true[n.lower()]) / np.asarray(corrected[f"{n}_ERR"]) for n in "QU"]
    return float(np.sqrt(np.nanmean(np.square(pulls))))


def _shipped(name: str) -> Path:
    """A file in an installed package, or in a clone."""
    package = Path(__file__).resolve().parents[1]
    for path in (package / "demo" / name, package.parent / "fits_data" / name):
        if path.exists():
            return path
    raise fail("is not there", file=name, advice="install the package again")

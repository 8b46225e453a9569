"""`walop-jax epoch`: does last month's calibration still fit, and which parameters have moved?"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Option, Outcome, PathLike, command, typed
from walop_jax.commands.inputs import Sets, set_of
from walop_jax.commands.products import Effects, Product, calibration_of, catalogue_of
from walop_jax.io.errors import errors_naming
from walop_jax.io.names import CLIPPED, EPOCH, PRODUCT

if TYPE_CHECKING:
    from walop_jax.science.epoch import Epoch


OPTIONS = {
    "old": Option("Old calibration product, or folder of a run.", metavar="OLD", kind=Path, placed=True),
    "new": Option(
        "Calibration sets (FITS), fitted as one.", metavar="CALSET...", kind=list[Path], placed=True
    ),
    "output": Option(
        "Folder for the new calibration and the comparison.", metavar="RUN", kind=Path, short="-o"
    ),
}


@command(stages=("reading", "fitting", "lacking"), writes=(PRODUCT, EPOCH), random=True, options=OPTIONS)
def epoch(
    job: Job, old: Product, new: Sets, *, output: PathLike | None = None, effects: Effects = None
) -> Outcome[Epoch]:
    """Fit new calibration sets and compare with an old calibration: is the instrument still the same?

    Reports the changes with their sizes, and how far off stars would be if the old calibration were still used; lists
    the parameters by how far they have moved, and tests all of them together. The new fit is that of the old model:
    plates, effects, priors and fixed parameters. Where that does not explain the new data and did explain the old ones,
    missing effects are looked for as by walop-jax diagnose, and the old calibration is compared with the model found.

    Exit code 0 only where the old calibration still holds; 3 where something has moved, or where the new data are not
    explained.

    In Python: an `Epoch`.

    >>> walop.epoch("RUN", "new.fits").holds  # doctest: +SKIP
    """
    from walop_jax import Calibration
    from walop_jax.calibration.product import write_calibration
    from walop_jax.diagnosis.findings import document
    from walop_jax.diagnosis.trust import examined
    from walop_jax.diagnosis.workflow import diagnose
    from walop_jax.science.epoch import epoch as compared
    from walop_jax.science.epoch import fit_like

    job.begin("reading")
    held = calibration_of(old, effects)
    calset = set_of(new, held.design)
    job.tell("fitting the new set", "fitting")
    with errors_naming(held.path):
        result = examined(fit_like(held, calset), job.seed)
        comparison = compared(held, result)
    lacking = None
    if comparison.fits is None:
        job.tell("looking for effects that the new fit lacks", "lacking")
        # Other readings of the data have been tried when its fit was examined.
        options = {"catalogue": catalogue_of(effects), "seed": job.seed, "progress": job.progress}
        lacking = diagnose(calset, result.model, as_written=True, **options)
        if lacking is not None and lacking.after.trusted:
            result = lacking.after
            comparison = compared(held, result)
    shown = comparison.display()
    if lacking is not None:
        named = ", ".join(step.effect for step in lacking.steps) or "nothing that has a name"
        lacks = f"missing from the old model: {named} ({lacking.verdict.replace('_', ' ')})"
        shown = dataclasses.replace(shown, notes=(*shown.notes, lacks))
    return Outcome(
        comparison,
        {
            "old": held.content_hash(),
            "old_file": held.path,
            "old_date": held.date,
            "new": [entry.sha256 for entry in calset.inputs],
            "new_files": [str(entry.path) for entry in calset.inputs],
            **comparison.document(),
            "diagnosis": None if lacking is None else document(lacking),
        },
        display=shown,
        files={PRODUCT: lambda path: write_calibration(path, Calibration.from_fit(result))},
        saved_as=EPOCH,
        drop=(CLIPPED,),
        warnings=[f"the new fit: {w}" if w in result.warnings else w for w in comparison.warnings],
        trusted=comparison.holds,
        next=(typed("report", output),),
    )

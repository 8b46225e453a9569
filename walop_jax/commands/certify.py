"""`walop-jax certify`: is this calibration fit for use? Go or no-go, with advice."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Option, Outcome, PathLike, after_fit, command
from walop_jax.commands.products import Effects, Product, catalogue_of, fit_of, folder_of
from walop_jax.io.errors import DataError, errors_naming
from walop_jax.io.names import COMMISSIONING, IN_MEMORY, PRODUCT

if TYPE_CHECKING:
    from walop_jax.science.commissioning import Certificate


OPTIONS = {
    "calibration": Option(
        "Calibration product, or the folder of a run.", metavar="RUN/calibration.fits", kind=Path, placed=True
    ),
    "output": Option(
        "Folder for commissioning.json; it may be that of the fit.", metavar="RUN", kind=Path, short="-o"
    ),
}


@command(writes=(COMMISSIONING,), options=OPTIONS)
def certify(
    job: Job, calibration: Product, effects: Effects = None, *, output: PathLike | None = None
) -> Outcome[Certificate]:
    """Check a calibration from its checksums to its physics and its accuracy: go or no-go, with its shortfalls.

    Version, content hash, convergence, covariance, validity (dates, filters, temperatures), hashes of the
    calibration sets it was made from, maps against parameters, and that no camera has a negative transmission: exit
    code 1 if any of these does not hold.

    A go needs a fit that converged and explains the data, exposures that are enough for a fit, and p of stars (p ≤ 5 %)
    known to 0.05 % in half of the field by the calibration alone; else it is a no-go, exit code 3. The accuracy of p
    in 95 % of the field, further missing exposures and undetectable errors are reported with a remedy.
    To rehearse a night, give the fit of a set of walop-jax simulate PLAN.

    In Python: a `Certificate`. Raises `DataError` for a file that cannot be read, has been changed, or is of another
    version.

    >>> [check.name for check in walop.certify("RUN").failed]  # doctest: +SKIP
    """
    from walop_jax import Calibration, FitResult, Run
    from walop_jax.calibration.certify import certify as checks_of
    from walop_jax.calibration.product import product_path, read_calibration, validity
    from walop_jax.science.commissioning import Certificate, requirements
    from walop_jax.science.field_accuracy import field_accuracy

    job.tell("checking")
    source: Any = fit_of(calibration)
    held: Any = Calibration.from_fit(source) if isinstance(source, FitResult) else source
    if isinstance(held, Calibration):
        path = Path(IN_MEMORY)
    else:
        path = product_path(folder_of(held))
        held = read_calibration(path, catalogue_of(effects), any_model=True)
    with errors_naming(path):
        checks = tuple(checks_of(held))
    needs, calset = (), None
    if any(check.name == "model" and check.passed for check in checks):
        job.tell("working out the accuracy of p")
        if isinstance(source, FitResult):
            accuracy = field_accuracy(held)
            needs = requirements(source.checked_verdict(), source.minimum.message, accuracy, source.calset)
        else:
            with contextlib.suppress(DataError):  # its exposures are looked at where they can be found
                calset = Run(path.parent).calset if path.name == PRODUCT else None
            needs = requirements(held.verdict, "", field_accuracy(held), calset)
    parents = tuple(entry.sha256 for entry in held.inputs)
    certificate = Certificate(path, checks, needs, validity(held), held.content_hash(), parents)
    failed = ", ".join(check.name for check in certificate.failed)
    return Outcome(
        certificate,
        saved_as=COMMISSIONING,
        failure=failed and f"{path}: not valid: {failed}",
        trusted=certificate.go,
        next=after_fit(calibration)[1:] if certificate.go else (),
    )

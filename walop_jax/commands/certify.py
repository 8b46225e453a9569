"""`walop-jax certify`: is this calibration product fit for use?"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Outcome, command
from walop_jax.commands.inputs import IN_MEMORY, Effects, Product, catalogue_of, folder_of
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import errors_naming

if TYPE_CHECKING:
    from walop_jax.calibration.certify import Check, Validity


@dataclasses.dataclass(frozen=True, repr=False)
class Certificate(Displayed):
    """The checks of a product, what it may be applied to, its content hash and the SHA-256 of its inputs."""

    path: Path
    checks: tuple[Check, ...]
    validity: Validity
    content: str
    parents: tuple[str, ...]

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that do not hold; the product is fit for use if there are none."""
        return tuple(check for check in self.checks if not check.passed)

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        from walop_jax.calibration.product import PRODVERS

        return {
            "product": str(self.path),
            "valid": not self.failed,
            "schema": PRODVERS,
            "content": self.content,
            "parents": list(self.parents),
            "validity": self.validity._asdict(),
            "checks": [check._asdict() for check in self.checks],
        }

    def display(self) -> Display:
        """Every check, and the verdict."""
        rows = [("ok" if check.passed else "FAILED", check.name, check.found) for check in self.checks]
        verdict = "NOT fit for use" if self.failed else "fit for use"
        return Display(f"{self.path}: {verdict}", head=("", "check", "found"), rows=tuple(rows))


@command()
def certify(job: Job, calibration: Product, effects: Effects = None) -> Outcome[Certificate]:
    """Check a calibration product from its checksums to its physics; exit code 1 if anything does not hold.

    Version, content hash, convergence, covariance, validity (dates, filters, temperatures), hashes of the
    calibration sets it was made from, maps against parameters, and that no camera has a negative transmission.

    In Python: a `Certificate`. Raises `DataError` for a file that cannot be read, has been changed, or is of another
    version.

    >>> [check.name for check in walop.certify("RUN").failed]  # doctest: +SKIP
    """
    from walop_jax import Calibration, FitResult
    from walop_jax.calibration.certify import certify as checks_of
    from walop_jax.calibration.certify import validity
    from walop_jax.calibration.product import product_path, read_product

    job.tell("checking")
    if isinstance(calibration, Calibration | FitResult):
        there = Calibration.from_fit(calibration) if isinstance(calibration, FitResult) else calibration
        path, product, catalogue = Path(IN_MEMORY), there.product, there.model.catalogue
    else:
        path = product_path(folder_of(calibration))
        product, catalogue = read_product(path), catalogue_of(effects)
    with errors_naming(path):
        checks = tuple(checks_of(product, catalogue))
    parents = tuple(entry.sha256 for entry in product.inputs)
    found = Certificate(path, checks, validity(product), product.content_hash(), parents)
    why = "; ".join(f"{check.name} ({check.found})" for check in found.failed)
    return Outcome(
        found,
        failure=f"{path}: not valid: {why}" if found.failed else "",
    )

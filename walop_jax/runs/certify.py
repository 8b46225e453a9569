"""A calibration product checked, from its file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from walop_jax.calibration.certify import Check, Validity, certify, validity
from walop_jax.calibration.from_file import product_path
from walop_jax.calibration.product import PRODVERS, read_product
from walop_jax.io.errors import errors_naming
from walop_jax.model.effects import EFFECTS, Effect


@dataclasses.dataclass(frozen=True)
class Certificate:
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
        return {
            "product": str(self.path),
            "valid": not self.failed,
            "schema": PRODVERS,
            "content": self.content,
            "parents": list(self.parents),
            "validity": self.validity._asdict(),
            "checks": [check._asdict() for check in self.checks],
        }


def certify_product(
    product: str | os.PathLike[str], catalogue: Sequence[type[Effect]] = EFFECTS
) -> Certificate:
    """Check a calibration product, or that in the folder of a run, from its checksums to its physics.

    Raises `DataError` for a file that cannot be read, that has been changed or is of another version.
    """
    path = product_path(product)
    held = read_product(path)
    with errors_naming(path):
        checks = certify(held, catalogue)
    parents = tuple(entry.sha256 for entry in held.inputs)
    return Certificate(path, tuple(checks), validity(held), held.content_hash(), parents)

"""Go or no-go: requirements on a calibration before stars are measured with it, and gaps in its exposures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from walop_jax.calibration.certify import Check, Validity
from walop_jax.calibration.product import PRODVERS
from walop_jax.data.inspection import inspect
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.verdict import Verdict
from walop_jax.io.display import Display, Displayed
from walop_jax.science.field_accuracy import FieldAccuracy, Requirement


def requirements(
    verdict: Verdict, message: str, accuracy: FieldAccuracy | None, calset: CalibrationSet | None
) -> tuple[Requirement, ...]:
    """Requirements on a fit with its verdict; `accuracy` is that of p over the field, `calset` its data, if known.

    The accuracy of a fit that is not trusted is not known: nothing is required of it.
    """
    blocking = [doubt.sentence for doubt in verdict.against if doubt.blocking and doubt.sentence]
    checks = [
        Requirement(
            "the fit has reached its minimum", verdict.converged, message or "converged",
            "look at the data with walop-jax inspect",
        ),
        Requirement(
            "the model explains the data", verdict.trusted,
            "trusted" if verdict.trusted else [*blocking, *verdict.warnings, "not trusted"][0],
            "walop-jax diagnose looks for missing effects",
        ),
    ]  # fmt: skip
    if accuracy is not None and verdict.trusted:
        checks += [accuracy.middle, *accuracy.requirements]
    for finding in () if calset is None else inspect(calset).findings:
        fault = finding.severity == "fault"
        checks.append(Requirement("exposures and errors", False, finding.what, finding.advice, fault))
    return tuple(checks)


def is_go(asked: Sequence[Requirement]) -> bool:
    """True if everything that is needed is met."""
    return all(need.met for need in asked if need.needed)


def requirement_rows(asked: Sequence[Requirement]) -> tuple[tuple[str, str, str], ...]:
    """A row for each requirement: ok, NO where it is needed, advice where it is not; the requirement, the result."""
    return tuple(
        ("ok" if need.met else "NO" if need.needed else "advice", need.what, need.found) for need in asked
    )


def requirement_advice(asked: Sequence[Requirement]) -> tuple[str, ...]:
    """Advice on requirements that are not met, the needed ones first."""
    ordered = sorted(asked, key=lambda need: not need.needed)
    return tuple(
        need.found if need.advice in need.found else f"{need.found}: {need.advice}"
        for need in ordered
        if not need.met
    )


@dataclasses.dataclass(frozen=True, repr=False)
class Certificate(Displayed):
    """Checks of a product, requirements for stars, validity, hash (`content`), SHA-256 of its inputs (`parents`)."""

    path: Path
    checks: tuple[Check, ...]
    requirements: tuple[Requirement, ...]
    validity: Validity
    content: str
    parents: tuple[str, ...]

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that do not hold; the product is valid if there are none."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def go(self) -> bool:
        """True if the product is valid and everything that is needed is met."""
        return not self.failed and is_go(self.requirements)

    @property
    def missing(self) -> tuple[str, ...]:
        """Advice on requirements that are not met, the needed ones first."""
        return requirement_advice(self.requirements)

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "product": str(self.path),
            "go": self.go,
            "requirements": [dataclasses.asdict(requirement) for requirement in self.requirements],
            "valid": not self.failed,
            "schema": PRODVERS,
            "content": self.content,
            "parents": list(self.parents),
            "validity": self.validity._asdict(),
            "checks": [check._asdict() for check in self.checks],
        }

    def display(self) -> Display:
        """Go or no-go, a line for each check and requirement, and advice on those that are not met."""
        rows = [("ok" if check.passed else "FAILED", check.name, check.found) for check in self.checks]
        rows += requirement_rows(self.requirements)
        title = f"{self.path}: {'go' if self.go else 'NO GO'}"
        return Display(title, head=("", "requirement", "result"), rows=tuple(rows), notes=self.missing)

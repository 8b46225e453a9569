"""Go or no-go: requirements on a calibration before stars are measured with it, and gaps in its exposures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from walop_jax.calibration.certify import Check
from walop_jax.calibration.product import PRODVERS, Validity
from walop_jax.data.inspection import inspect
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.verdict import Doubt, Quality, Verdict
from walop_jax.io.display import Display, Displayed
from walop_jax.science.field_accuracy import FieldAccuracy, Requirement


def requirements(
    verdict: Verdict, message: str, accuracy: FieldAccuracy | None, calset: CalibrationSet | None
) -> tuple[Requirement, ...]:
    """Requirements on a fit with its verdict; `accuracy` is that of p over the field, `calset` its data, if known.

    The accuracy of a fit that is not trusted is not known: nothing is required of it.
    """
    blocking = [doubt.sentence for doubt in verdict.doubts if doubt.blocking and doubt.sentence]
    judged = "trusted" if verdict.trusted else [*blocking, *verdict.warnings, "not trusted"][0]
    minimum = "the fit has reached its minimum", verdict.converged, message or "converged"
    explains = "the model explains the data", verdict.trusted, judged
    checks = [
        Requirement(*minimum, "look at the data with walop-jax inspect"),
        Requirement(*explains, "walop-jax diagnose looks for missing effects"),
    ]
    if accuracy is not None and verdict.trusted:
        checks += [accuracy.middle, *accuracy.requirements]
    for finding in () if calset is None else inspect(calset).findings:
        fault = finding.severity == "fault"
        checks.append(Requirement("exposures and errors", False, finding.what, finding.advice, fault))
    return tuple(checks)


REMADE = "make the calibration again from its sets: walop-jax refit"
SAID_BY_THE_FIT = ("converged", "explains the data")
"""Checks whose failure the verdict on the fit says as well, with its reason."""
MEASURED = "measured"  # the check that the accuracy for stars says as well, with its remedy
CURES = {
    "conditioned": "take the exposures that separate the parameters: walop-jax plan",
    "validity": "state MJD in EXPOSURES, and the curves of all filters in FILTERS",
    "parents": "fit sets from files, whose hashes are recorded: walop-jax refit",
    "model": "give the --effects and --elements with which it was made",
    "physics": "walop-jax inspect looks for counts that no camera can have",
    MEASURED: "observe an unpolarised and a polarised standard, or the moonlit sky",
}
"""Remedies of checks that do not hold; of all others `REMADE`."""


@dataclasses.dataclass(frozen=True, repr=False)
class Certificate(Displayed):
    """Checks of a product, requirements for stars, validity, hash (`content`), SHA-256 of its inputs (`parents`).

    `verdict` is that for stars, as its fit has it; `facts` are the accuracy of p, its limits, and what could hide.
    """

    path: Path
    checks: tuple[Check, ...]
    requirements: tuple[Requirement, ...]
    validity: Validity | None = None
    content: str = ""
    parents: tuple[str, ...] = ()
    verdict: Verdict = dataclasses.field(default_factory=Verdict)
    facts: tuple[tuple[str, str], ...] = ()

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that do not hold; the product is valid if there are none."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def go(self) -> bool:
        """True if the product is valid and everything that is needed is met."""
        return not self.failed and all(need.met for need in self.requirements if need.needed)

    @property
    def unmet(self) -> tuple[Requirement, ...]:
        """The requirements that are not met, the needed ones first."""
        return tuple(sorted((n for n in self.requirements if not n.met), key=lambda need: not need.needed))

    @property
    def missing(self) -> tuple[str, ...]:
        """Advice on requirements that are not met, the needed ones first."""
        return tuple(n.found if n.advice in n.found else f"{n.found}: {n.advice}" for n in self.unmet)

    @property
    def against(self) -> tuple[Doubt, ...]:
        """The reasons that it holds: those of the verdict, and the failed checks that say more."""
        said = () if self.verdict.trusted else SAID_BY_THE_FIT
        said += (MEASURED,) if any(doubt.off for doubt in self.verdict.doubts) else ()
        failed = (check for check in self.failed if check.name not in said)
        checks = (
            Doubt(Quality(0), f"{check.name}: {check.found}", remedy=CURES.get(check.name, REMADE))
            for check in failed
        )
        return (*self.verdict.doubts, *checks)

    def document(self) -> dict[str, Any]:
        """Checks and requirements as plain data, the part `commissioning` of check.json."""
        return {
            "product": str(self.path),
            "go": self.go,
            "requirements": [_plain(requirement) for requirement in self.requirements],
            "valid": not self.failed,
            "schema": PRODVERS,
            "content": self.content,
            "parents": list(self.parents),
            "validity": self.validity and self.validity._asdict(),
            "checks": [check._asdict() for check in self.checks],
        }

    def display(self) -> Display:
        """A line for each check and requirement (NO: it is needed), with the accuracy of p and what could hide."""
        rows = [("ok" if check.passed else "FAILED", check.name, check.found) for check in self.checks]
        for need in self.requirements:
            rows.append(("ok" if need.met else "NO" if need.needed else "advice", need.what, need.found))
        title = f"{self.path}: {'go' if self.go else 'no go'}"
        said = {doubt.what for doubt in self.verdict.reasons}
        notes = (text for need, text in zip(self.unmet, self.missing, strict=True) if need.found not in said)
        return Display(title, self.facts, ("", "requirement", "result"), tuple(rows), tuple(notes))


def _plain(need: Requirement) -> dict[str, Any]:
    return {key: value for key, value in dataclasses.asdict(need).items() if key != "off"}

"""Go or no-go: what a calibration must show before stars are measured with it, and what the exposures lack for it."""

from __future__ import annotations

import dataclasses
from typing import Any

from walop_jax.calibration.could_hide import off_by, unmeasured
from walop_jax.calibration.thresholds import GOAL
from walop_jax.data.inspection import inspect
from walop_jax.fit.refit import FitResult
from walop_jax.io.display import Display, Displayed
from walop_jax.io.text import two_digits
from walop_jax.science.field_accuracy import SHARE, FieldAccuracy

MOST = GOAL / 2  # error of p that the calibration may make


@dataclasses.dataclass(frozen=True)
class Requirement:
    """Something that is asked of a calibration: whether it is met, what was found, and what to do if not.

    One that is not `needed` is no reason against a go.
    """

    what: str
    met: bool
    found: str
    advice: str = ""
    needed: bool = True


@dataclasses.dataclass(frozen=True, repr=False)
class Commissioning(Displayed):
    """A fit with what is asked of it."""

    fit: FitResult
    requirements: tuple[Requirement, ...]

    @property
    def go(self) -> bool:
        """True if everything that is needed is met."""
        return all(one.met for one in self.requirements if one.needed)

    @property
    def missing(self) -> tuple[str, ...]:
        """Advice on requirements that are not met, what is needed first."""
        ordered = sorted(self.requirements, key=lambda one: not one.needed)
        return tuple(f"{one.found}: {one.advice}" for one in ordered if not one.met)

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {"go": self.go, "requirements": [dataclasses.asdict(one) for one in self.requirements]}

    def display(self) -> Display:
        """Go or no-go, a line for each requirement, and what is missing."""
        rows = tuple(
            (
                "yes" if one.met else "NO" if one.needed else "no",
                f"{one.what} (required)" if one.needed else one.what,
                one.found,
            )
            for one in self.requirements
        )
        title = f"Commissioning of {self.fit.model.name}: {'go' if self.go else 'NO GO'}"
        return Display(title, head=("met", "asked", "found"), rows=rows, notes=self.missing)


def commissioning(result: FitResult, accuracy: FieldAccuracy | None) -> Commissioning:
    """Requirements on an examined fit; `accuracy` is that of p over the field, None where nobody knows it."""
    found = [
        Requirement(
            "the fit has reached its minimum", result.converged, result.minimum.message or "converged",
            "look at the data with walop-jax inspect",
        ),
        Requirement(
            "the model explains the data", result.trusted, "trusted" if result.trusted else "; ".join(result.warnings),
            "walop-jax diagnose says what is missing",
        ),
    ]  # fmt: skip
    if accuracy is not None:
        limit = accuracy.limited_by.split(" (")[0]
        for where, reached, needed in (
            ("50 % of the field", accuracy.median, True),
            (accuracy.judged, accuracy.reached, False),
        ):
            cause = f", most of it from {limit}" if limit else ""
            advice = (
                f"{two_digits((reached / MOST) ** 2)} times the light, over several nights (walop-jax stack); "
                "walop-jax plan says which exposures"
            )
            if not needed and accuracy.without_u > 1.0 - SHARE:
                strip = f"{100 * accuracy.without_u:.0f} % of the field"
                cause = f", worst beside the {strip} where one exposure carries almost no information on u"
                advice = "observe the stars there with the calibration plate at 22.5° as well"
            asked = f"p known to {two_digits(100 * MOST)} % in {where}"
            said = f"{two_digits(100 * reached)} %{cause}"
            found.append(Requirement(asked, reached <= MOST, said, advice, needed))
        for name, one in unmeasured(accuracy.not_measured).items():
            asked = f"what moves stars by {two_digits(100 * MOST)} % is measured"
            lacking = f"{name} not measured, {off_by(*one.error)} at the usual size"
            found.append(Requirement(asked, one.error[0] <= MOST, lacking, one.remedy))
        if accuracy.hidden > 0:
            found.append(
                Requirement(
                    f"no single mistake can hide that is worth {two_digits(100 * GOAL)} %",
                    accuracy.hidden <= GOAL,
                    f"q or u off by {two_digits(100 * accuracy.hidden)} % from {accuracy.hidden_by}",
                    accuracy.remedy or "walop-jax limits says which exposures would show it",
                    needed=False,
                )
            )
    for one in inspect(result.calset).findings:
        found.append(
            Requirement("exposures and errors", False, one.what, one.advice, needed=one.severity == "fault")
        )
    return Commissioning(result, tuple(found))

"""Go or no-go: requirements on a calibration before stars are measured with it, and gaps in its exposures."""

from __future__ import annotations

from collections.abc import Sequence

from walop_jax.data.inspection import inspect
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.verdict import Verdict
from walop_jax.science.field_accuracy import FieldAccuracy, Requirement


def requirements(
    verdict: Verdict, message: str, accuracy: FieldAccuracy | None, calset: CalibrationSet | None
) -> tuple[Requirement, ...]:
    """Requirements on a fit with its verdict; `accuracy` is that of p over the field, `calset` its data, if known."""
    checks = [
        Requirement(
            "the fit has reached its minimum", verdict.converged, message or "converged",
            "look at the data with walop-jax inspect",
        ),
        Requirement(
            "the model explains the data", verdict.trusted,
            "trusted" if verdict.trusted else "; ".join(verdict.warnings) or "not trusted",
            "walop-jax diagnose looks for missing effects",
        ),
    ]  # fmt: skip
    if accuracy is not None:
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
    return tuple(f"{need.found}: {need.advice}" for need in ordered if not need.met)

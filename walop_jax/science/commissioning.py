"""Go or no-go: requirements on a calibration before stars are measured with it, and gaps in its exposures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from walop_jax.calibration.could_hide import off_by, unmeasured
from walop_jax.data.inspection import inspect
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.verdict import Verdict
from walop_jax.io.text import two_digits
from walop_jax.science.field_accuracy import SHARE, FieldAccuracy


@dataclasses.dataclass(frozen=True)
class Requirement:
    """A requirement on a calibration: whether it is met, the value, and advice if not.

    One that is not `needed` is no reason against a go.
    """

    what: str
    met: bool
    found: str
    advice: str = ""
    needed: bool = True


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
        allowed, goal = accuracy.goal / 2, two_digits(100 * accuracy.goal)
        limit = accuracy.limited_by.split(" (")[0]
        for where, reached, needed in (
            ("50 % of the field", accuracy.median, True),
            (accuracy.judged, accuracy.reached, False),
        ):
            cause = f", most of it from {limit}" if limit else ""
            advice = (
                f"{two_digits((reached / allowed) ** 2)} times the light, over several nights (walop-jax stack); "
                "walop-jax plan says which exposures"
            )
            if not needed and accuracy.without_u > 1.0 - SHARE:
                strip = f"{100 * accuracy.without_u:.0f} % of the field"
                cause = f", worst beside the {strip} where one exposure carries almost no information on u"
                advice = "observe the stars there with the calibration plate at 22.5° as well"
            text = f"p known to {two_digits(100 * allowed)} % in {where}"
            value = f"{two_digits(100 * reached)} %{cause}"
            checks.append(Requirement(text, reached <= allowed, value, advice, needed))
        for name, effect in unmeasured(accuracy.not_measured).items():
            text = f"what moves stars by {two_digits(100 * allowed)} % is measured"
            lacking = f"{name} not measured, {off_by(*effect.error)} at the usual size"
            checks.append(Requirement(text, effect.error[0] <= allowed, lacking, effect.remedy))
        if accuracy.hidden > 0:
            checks.append(
                Requirement(
                    f"no undetectable error exceeds {goal} %",
                    accuracy.hidden <= accuracy.goal,
                    f"q or u off by {two_digits(100 * accuracy.hidden)} % from {accuracy.hidden_by}",
                    accuracy.remedy or "walop-jax limits says which exposures would show it",
                    needed=False,
                )
            )
    for finding in () if calset is None else inspect(calset).findings:
        checks.append(
            Requirement(
                "exposures and errors",
                False,
                finding.what,
                finding.advice,
                needed=finding.severity == "fault",
            )
        )
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

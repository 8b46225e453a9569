"""A diagnosis as plain data, `diagnosis.json` (docs: files)."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from walop_jax.diagnosis.findings import Diagnosis, Step

DIAGNOSIS = "diagnosis.json"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _step(step: Step) -> dict[str, Any]:
    return {
        "effect": step.effect,
        "parameters": {
            name: {"value": value, "sigma": 0.0, "unit": ""} for name, value in step.choices.items()
        }
        | {
            name: {"value": value, "sigma": sigma, "unit": unit}
            for name, (value, sigma, unit) in step.parameters.items()
        },
        "alternatives": list(step.alternatives),
        "score": step.score,
        "p_value": step.p_value,
        "chi2_before": step.chi2_before,
        "chi2_after": step.chi2_after,
        "heldout_before": step.heldout_before.mean,
        "heldout_after": step.heldout_after.mean,
        "sentences": [dataclasses.asdict(told) for told in step.told],
        "equivalent": list(step.equivalent),
        "nameless": list(step.nameless),
        "separated_by": step.separated_by,
        "where": step.where,
        "heldout_scheme": step.heldout_before.scheme,
        "confirmed": step.confirmed,
        "log_bayes": step.log_bayes,
        "change_of_qu": _number(step.change_of_qu),
        "negligible": step.negligible,
        "robust_error_ratio": _number(step.robust_ratio),
        "separation_sigma": {
            name: value
            for name, value in sorted(step.separation.items(), key=lambda s: s[1])
            if math.isfinite(value)
        },
    }


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of diagnosis.json."""
    unexplained = diagnosis.unexplained
    return {
        "verdict": diagnosis.verdict,
        "steps": [_step(step) for step in diagnosis.steps],
        "candidates": [
            {"effect": name, "score": score, "p_value": p} for name, score, p in diagnosis.candidates
        ],
        "unexplained": None
        if unexplained is None
        else {
            "p_value": unexplained.p_value,
            "description": unexplained.description,
            "patterns": [{"pattern": name, "p_value": p} for name, p in unexplained.patterns],
            "free_form": list(unexplained.term),
            "chi2_before": _number(unexplained.chi2_before),
            "chi2_after": _number(unexplained.chi2_after),
            "change_of_qu": _number(unexplained.change_of_qu),
        },
        "p_value": diagnosis.p_value,
        "remaining_p_value": diagnosis.remaining_p,
        "noise_scale": _number(diagnosis.noise_scale),
        "noise_p_value": _number(diagnosis.noise_p),
        "limits": [
            {
                "effect": limit.effect,
                "parameter": limit.parameter,
                "unit": limit.unit,
                "value": limit.value,
                "sigma": limit.sigma,
                "below_95": limit.below,
            }
            for limit in diagnosis.limits
        ],
        "choices": [
            {"change": choice.change, "left": choice.left, "better_by": _number(choice.better_by)}
            for choice in diagnosis.choices
        ],
        "classes": [dataclasses.asdict(alike) for alike in diagnosis.classes],
        "cannot_be_tested": list(diagnosis.untestable),
        "chi2_per_dof_before": diagnosis.before.chi2 / max(diagnosis.before.dof, 1),
        "chi2_per_dof_after": diagnosis.after.chi2 / max(diagnosis.after.dof, 1),
        "caution": diagnosis.caution,
        "seconds": diagnosis.seconds,
    }

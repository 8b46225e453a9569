"""The summary of a fit as plain data, `summary.json`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from walop_jax.calibration.matrix import ResidualMap
from walop_jax.io.code import software_versions

if TYPE_CHECKING:
    from walop_jax.fit.misfit import Misfit
    from walop_jax.fit.refit import FitResult


def summary(
    result: FitResult,
    *,
    seconds: float,
    accuracy: Mapping[str, Any] | None = None,
    misfit: Misfit | None = None,
    residuals: ResidualMap | None = None,
) -> dict[str, Any]:
    """The content of `summary.json` (docs: files) of a fit with a verdict; fixed parameters have sigma 0.

    `accuracy` is how well stars are known with it (the document of `science.field_accuracy`), `misfit` where the model
    fails, `residuals` are those over the field.
    """
    verdict = result.checked_verdict()
    undetected, keys = None, ("name", "size", "unit", "kind", "measured")
    if result.hidden is not None:
        undetected = [{key: getattr(each, key) for key in keys} for each in result.hidden.errors]
    parameters = {
        p.name: {"value": float(value), "sigma": float(sigma), "unit": p.unit}
        for p, value, sigma in zip(result.model.parameters, result.values, result.sigma, strict=True)
    }
    return {
        "chi2": result.chi2,
        "dof": result.dof,
        "n_data": result.n_data,
        "parameters": parameters,
        "converged": result.converged,
        "message": result.minimum.message,
        "seconds": seconds,
        "versions": software_versions(),
        "inputs": [{"path": str(e.path), "sha256": e.sha256} for e in result.calset.inputs],
        "cells": result.calset.cells,
        "trusted": verdict.trusted,
        "quality": int(verdict.quality),
        "doubts": list(verdict.residual_doubts),
        "warnings": list(verdict.warnings),
        "structure": dataclasses.asdict(verdict.structure),
        "hidden": undetected,
        "accuracy_of_p": accuracy,
        "instrument": result.model.name,
        "effects": list(result.model.effect_names),
        "free_parameters": len(result.model.free),
        "noise_scale": result.noise_scale,
        "errors_from": result.errors_from,
        "steps": result.minimum.steps,
        "starts": result.minimum.starts,
        "seconds_fit": result.seconds,
        "scaled_gradient": result.minimum.scaled_gradient,
        "condition_number": result.minimum.condition,
        "chi2_history": list(result.minimum.history),
        "misfit": None if misfit is None else misfit.document(),
        "residual_map": None
        if residuals is None
        else {
            "cells": [residuals.grid.width, residuals.grid.height],
            "filter": residuals.filter,
            "rms_beyond_noise": residuals.excess(),
            "significance": residuals.significance(),
        },
        "clipped": None if result.clipped is None else result.clipped.document(),
        "remarks": list(result.calset.remarks),
    }

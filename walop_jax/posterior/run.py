"""The folder of a run: its data, found again, and its fit, made again from where it ended."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import CalibrationProduct
from walop_jax.data import read_calibration_set
from walop_jax.fit.model_builder import model_for
from walop_jax.fit.refit import FitResult, fit, with_honest_errors
from walop_jax.io.errors import fail
from walop_jax.likelihood import limits
from walop_jax.likelihood.expansion import STATED
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS, Effect

SAME_FIT = 0.05  # standard errors


def locate(path: Path, run: Path) -> Path:
    """Where the data of a run lie: as they were named, in the folder of the run, or beside it; `DataError` if
    nowhere."""
    for folder in (Path(), run, run.parent):
        if (folder / path).exists():
            return folder / path
    raise fail("the data of this run are not there any more", file=path, advice="put them back, or refit")


def fit_of_run(
    product: CalibrationProduct,
    run: Path,
    model_text: str | None = None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
) -> FitResult:
    """The fit behind a calibration product in the folder `run`; `catalogue` are the effects that it may have.

    Raises `DataError` when the data are missing, not those of the fit or too many to be sampled, and when the fit does
    not come out as the product says (another model, or another version of the physics). Errors are made as those of
    the product were, and the verdict is its verdict.
    """
    if not product.inputs:
        raise fail("does not say what it was fitted to", file=run, advice="make it with walop-jax refit")
    calset = read_calibration_set(*(locate(Path(entry.path), run) for entry in product.inputs))
    if sorted(entry.sha256 for entry in calset.inputs) != sorted(entry.sha256 for entry in product.inputs):
        raise fail("the data have changed since the fit", file=product.inputs[0].path, advice="refit them")
    text = "\n".join(product.model) if model_text is None else model_text
    design = Calibration.from_product(product, catalogue).model.template
    model = model_for(calset, text, design, catalogue)
    if model.names != tuple(str(name) for name in product.parameters.name):
        raise fail(
            "was fitted with another model", file=run, advice="run walop-jax refit with this model first"
        )
    likelihood = Likelihood.of(calset, model)
    if likelihood.layout.large:
        raise fail(
            f"has {len(calset.points)} field points: the posterior of so many is as good as normal, and "
            "calibration.fits holds its covariance",
            file=product.inputs[0].path,
            advice=f"sample sets of up to {limits.LARGE_ABOVE} points; walop-jax compress makes one of frames",
        )
    result = fit(likelihood, start=np.asarray(product.parameters.value, float))
    away = np.abs(result.values - product.parameters.value) / np.where(result.sigma > 0, result.sigma, 1.0)
    if not result.converged or np.max(away) > SAME_FIT:
        name = model.names[int(np.argmax(away))]
        raise fail(
            f"fitted again, {name} moves by {np.max(away):.2g} standard errors", file=run,
            advice="run walop-jax refit with this model and version first",
        )  # fmt: skip
    if product.verdict.errors_from != STATED:
        result = with_honest_errors(result)
    if result.errors_from != product.verdict.errors_from and product.verdict.covariance_from == "fit":
        result = dataclasses.replace(
            result, covariance=product.covariance, errors_from=product.verdict.errors_from
        )
    return dataclasses.replace(result, verdict=product.verdict)

"""Fits of the field points that stand for all pixels of whole frames (`likelihood.compressed`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.refit import FitResult, fit
from walop_jax.fit.verdict import Structure
from walop_jax.likelihood.compressed import compressed
from walop_jax.likelihood.frames import PixelExpansion, stands_for_pixels
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.runner import Progress, Runner
from walop_jax.model.specification import Model

FARTHEST = 100.0
"""Standard errors from where the pixels were summed up to which a set that stands for them is good: a thousandth of the
way is left."""


def on_field_points(result: FitResult) -> FitResult:
    """The same values and errors beside a set that stands for all pixels; any other fit is unchanged."""
    if not isinstance(result.expansion, PixelExpansion):
        return result
    likelihood = Likelihood.of(compressed(result.expansion), result.model, interpolate=False)
    expansion = likelihood.expand(result.values, result.noise_scale)
    return dataclasses.replace(result, likelihood=likelihood, expansion=expansion)


def in_field_points(
    calset: CalibrationSet, model: Model, tell: Progress, look: Callable[[FitResult], Structure]
) -> CalibrationSet:
    """Whole frames as the set that stands for them, `look` giving the spread of pixels; any other set as it is."""
    likelihood = Likelihood.of(calset, model, runner=Runner(progress=tell))
    if not (likelihood.layout.large and stands_for_pixels(likelihood, model.start)):
        return calset
    tell("fitting all pixels")
    result = fit(likelihood)
    summed = on_field_points(result).calset
    if summed.compression is not None:
        summed = with_pixel_structure(summed, look(result))
        tell(f"looking at {len(summed.points)} field points that stand for all pixels")
    return summed


def with_pixel_structure(calset: CalibrationSet, structure: Structure) -> CalibrationSet:
    """A set that stands for pixels with the record of how much these differ beyond the model."""
    assert calset.compression is not None
    record = dataclasses.replace(calset.compression, gain=structure.gain, response=structure.response)
    return dataclasses.replace(calset, compression=record)


def with_pixels(result: FitResult) -> FitResult:
    """The fit of a set that stands for pixels with the χ² and the degrees of freedom of these; any other as it is.

    From where they were summed χ² of the pixels changes as that of the field points does. The data of the set beside
    them count by themselves, and so do parameters that there were not.
    """
    compression, likelihood = result.calset.compression, result.likelihood
    if compression is None:
        return result
    summed = compression.covers(result.calset.exposures)
    before = float(np.sum(likelihood.residuals(values_then(result))[1][:, summed] ** 2))
    beside = np.where(summed, 0, likelihood.used.sum(axis=0)) @ likelihood.data_per_row
    new = [result.model.parameters[i] for i in result.model.free]
    further = sum((p.prior is not None) - 1 for p in new if p.name not in compression.values)
    data = compression.chi2 + result.expansion.data - before
    dof = compression.dof + round(float(beside)) + further
    return dataclasses.replace(result, expansion=dataclasses.replace(result.expansion, data=data, dof=dof))


def values_then(result: FitResult) -> Float[np.ndarray, " n"]:
    """Values at which the pixels of a set were summed; parameters that were not there then have their start values."""
    compression, model = result.calset.compression, result.model
    assert compression is not None
    starts = zip(model.names, model.start, strict=True)
    return np.array([compression.values.get(name, start) for name, start in starts])[model.masters]


def moved(result: FitResult) -> float:
    """Distance (standard errors, all parameters together) of a fit from where the pixels of its set were summed.

    0 for a set that stands for no pixels. Parameters that were not there then count from their start values, those of
    sources that the pixels did not see not at all.
    """
    compression, model, exposures = result.calset.compression, result.model, result.calset.exposures
    if compression is None:
        return 0.0
    kinds = exposures.kind[compression.covers(exposures)]
    unseen = [source.name for source in model.template.sources if source.kind not in kinds]
    step = (result.values - values_then(result))[model.free]
    step[[model.parameters[i].part in unseen for i in model.free]] = 0.0
    return float(np.sqrt(max(step @ result.expansion.matrix @ step, 0.0)))

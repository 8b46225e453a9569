"""Errors of the data that have parameters, while a diagnosis looks for what is missing.

A fit of a model that lacks something takes the misfit for noise if its errors are free (`model/noise.py`): a ghost of
3 % makes the scale of N_ERR 35, and no residual is left to find it by. While names are searched for, the errors are
therefore held at what neither the parameters nor any candidate explains. In the model that is found they are free.

Equation    the v that maximise −½ Σ r̃² − ½ Σ (1 − h̃) ln ρ(v) with its terms for the fluxes (`likelihood/noise.py`),
                r̃ = P̃ r,   h̃ = diag (1 − P̃) − ê²
Symbols     r residuals for errors that are held; P̃ projects off the fluxes, the free parameters and the columns of all
            candidates (`score.ScoreSpace`); v scale and fraction of the errors; ρ = σ²/N_ERR²
Example     N_ERR too small by a factor 1.3, and a ghost: the errors are held at 1.3 ± 0.03
Source      restricted maximum likelihood: Patterson & Thompson 1971, Biometrika 58, 545
Limits      P̃ is that of the errors from which it starts, made anew once. What no candidate explains is noise here, so
            that nothing remains `unexplained`; a misfit so gross that a fit had to scale the errors is not taken for
            noise: the errors are then held as stated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy import linalg, optimize

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.examination import Examination
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.shapes import AnyVector
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.noise import noise_expansion, variance_ratio
from walop_jax.model.noise import FRACTION_START, NOISE
from walop_jax.model.specification import Model

ROUNDS = 2  # the projection hangs on the errors, a little: once more with those that were found


def fits_errors(model: Model) -> bool:
    """True if errors of the data are among the free parameters of a model."""
    return bool(np.isin(model.positions(NOISE), model.free).any())


def with_errors_held(likelihood: Likelihood, examined: Callable[[FitResult], Examination]) -> Model:
    """The model of a likelihood with its free errors held at what no candidate explains.

    `examined` scores all candidates against a fit. A model without free errors comes back as it is.
    """
    model = likelihood.model
    if not fits_errors(model):
        return model
    assert model.template.noise is not None
    scales = len(model.template.noise.scales)
    stated = np.where(np.arange(len(model.positions(NOISE))) < scales, 1.0, 0.0)
    held = _held(model, stated)
    for _ in range(ROUNDS):
        result = fit(Likelihood.of(likelihood.calset, held, runner=likelihood.runner))
        if result.noise_scale > 1.0:
            return _held(model, stated)
        held = _held(model, errors_behind(examined(result), model))
    return held


def held_closer(examination: Examination, free: FitResult, model: Model) -> Model | None:
    """The model with its free errors held at what is left once additions were found.

    A far effect has no linear step that explains it: before it is found, it makes the errors too large. They are those
    of `free`, the fit with the additions and free errors; if that takes something for noise, so that variances grow by
    more than `thresholds.UNEVEN` in the mean, they are those behind all candidates. None where they are the same as
    before, or where nothing is free.
    """
    if not fits_errors(model):
        return None
    result, terms = examination.result, examination.result.likelihood.points.reader.noise_terms
    counts, weight = map(result.likelihood.points_as_stated.gathered, ("counts", "weight"))

    def grown(held: Model) -> AnyVector:
        """ln of the variances of all data over those of the examination."""
        before, after = result.model.instrument(result.values).noise, held.instrument(held.start).noise
        assert before is not None
        assert after is not None
        old, new = (variance_ratio(noise, terms, counts, weight) for noise in (before, after))
        return np.log(new / old)[weight > 0]

    most = np.log1p(thresholds.UNEVEN)
    values = free.values[[free.model.index(name) for name in _names(model)]]
    held = _held(model, np.abs(values))
    if grown(held).mean() > most:
        held = _held(model, errors_behind(examination, model))
    return None if np.abs(grown(held)).max(initial=0.0) < most else held


def _names(model: Model) -> list[str]:
    """Names of the errors of the data."""
    return [model.parameters[i].name for i in model.positions(NOISE).tolist()]


def with_errors_free(result: FitResult, model: Model) -> FitResult:
    """The fit of the same set and effects, its errors as free as those of `model`."""
    if not fits_errors(model):
        return result
    free = result.model
    for i in model.positions(NOISE).tolist():
        given = model.parameters[i]
        start = float(result.values[free.index(given.name)]) or FRACTION_START
        free = free.change(given.name, free=given.free, start=start, prior=given.prior)
    return fit(Likelihood.of(result.calset, free, runner=result.likelihood.runner), start=result.values)


def _held(model: Model, values: AnyVector) -> Model:
    """The model with its free errors held at some values."""
    for i, value in zip(model.positions(NOISE).tolist(), values.tolist(), strict=True):
        if model.parameters[i].free:
            model = model.change(model.parameters[i].name, free=False, start=value)
    return model


def errors_behind(examination: Examination, model: Model) -> AnyVector:
    """Values of all errors of `model` that describe what is left behind the candidates of an examination.

    Scales come first, then fractions, as among the parameters. What `model` holds keeps its value.
    """
    result, at = examination.result, model.positions(NOISE)
    likelihood, terms = result.likelihood, result.likelihood.points.reader.noise_terms
    residual, taken = _behind_candidates(examination)
    counts, weight = map(likelihood.points_as_stated.gathered, ("counts", "weight"))
    noise = result.model.instrument(result.values).noise
    assert noise is not None
    scales = len(noise.scales)
    raw = residual * result.noise_scale * np.sqrt(variance_ratio(noise, terms, counts, weight))
    start = np.concatenate([np.asarray(noise.scale, float), np.asarray(noise.fraction, float)])
    free = np.isin(at, model.free)
    known = [(k, model.parameters[i].prior) for k, i in enumerate(at.tolist())]

    size = np.full(len(start), FRACTION_START)
    size[:scales] = max(result.noise_scale * examination.table.noise_scale, thresholds.ROUNDING)

    def objective(in_sizes: AnyVector) -> tuple[float, AnyVector]:
        values = start.copy()
        values[free] = in_sizes * size[free]
        tried = dataclasses.replace(noise, scale=values[:scales], fraction=values[scales:])
        r = raw / np.sqrt(variance_ratio(tried, terms, counts, weight))
        found = noise_expansion(
            tried, terms, counts, weight, r, likelihood.flux_known, likelihood.flux_groups, taken
        )
        value, gradient = 0.5 * (float(np.sum(r**2)) + found.value), found.gradient.copy()
        for k, prior in known:
            if prior is not None:
                away = (values[k] - prior[0]) / prior[1]
                value, gradient[k] = value + 0.5 * away**2, gradient[k] + away / prior[1]
        return value, gradient[free] * size[free]

    values, first = start.copy(), np.ones(np.count_nonzero(free))
    values[free] = np.abs(optimize.minimize(objective, first, jac=True, method="BFGS").x) * size[free]
    return values


def _behind_candidates(
    examination: Examination,
) -> tuple[Float[np.ndarray, "p e k"], Float[np.ndarray, "p e k"]]:
    """Residuals behind the parameters and all candidates, and the part of every datum that these take up."""
    design, space = examination.design, examination.bare
    chosen, lower = space.independent()
    basis, rows = design.projector.basis, design.rows
    columns = np.concatenate(examination.columns, axis=1)[:, chosen].astype(float) / design.fit.noise_scale
    columns = np.pad(columns, ((0, len(basis) - rows), (0, 0)))
    columns = columns - basis @ (basis.T @ columns)
    unit = linalg.solve_triangular(lower, columns.T, lower=True).T
    left = design.projector(design.residual)
    left = left - unit @ (unit.T @ left)
    taken = np.sum(unit**2, axis=1) + np.sum(basis**2, axis=1)
    return design.cube(left), design.cube(taken)

"""The search for the minimum of a likelihood: from afar on a small set or a sample, then near it on all of a large one.

Every search ends: a model that is far from the data (χ²/dof above `FAR_OFF`) is given so many passes over them as
`most_passes` says, all starts together. With residuals of a wrong model, errors of the data are scaled until χ²/dof is
1, and the plates are tried one order of retardance away; more starts and steps buy nothing then.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.fit.minimise import MAXIMUM_STEPS, Minimum, minimise
from walop_jax.io.errors import fail
from walop_jax.io.shapes import Vector
from walop_jax.likelihood import limits
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Expansion, Likelihood, UsedData
from walop_jax.model import materials
from walop_jax.model.noise import NOISE
from walop_jax.model.specification import Model

FoundMinimum = Minimum[Expansion]

FAR_OFF = 25.0  # χ²/dof above which other orders are tried and the errors scaled
MAXIMUM_RESCALINGS = 4
FIRST_STEPS = 20
OTHER_STEPS = 12  # of a start one order of retardance away
MOST_ORDERS = 8  # times that fringes of air are tried some orders away from the best so far
# Scaled gradient of a large set: 10⁻³ of a standard error is 10⁻⁶ in χ², and of a χ² of 10⁹ rounding leaves 10⁻⁷.
LARGE_TOLERANCE = 1e-3
ERROR_ROUNDS = 4  # searches for errors of the data, each with what the others of the one before take up
SETTLED = 1e-2  # standard errors that they may move by in the last of them


def free_scales(model: Model) -> Vector:
    """The natural step (f) of each free parameter, in which a solver counts."""
    return np.array([model.parameters[i].scale for i in model.free])


def most_passes(model: Model) -> int:
    """Passes over the data that a model far from them is worth: the first search, and one for each free parameter."""
    return FIRST_STEPS + len(model.free)


def _search(
    likelihood: Likelihood,
    label: str,
    first: Vector,
    noise_scale: float,
    near: Expansion | None = None,
    maximum_steps: int = MAXIMUM_STEPS,
    **how: Any,
) -> FoundMinimum:
    """The minimum from a full vector of start values, its `x` full as well; `near` is an expansion at similar ones.

    `how` goes to `minimise`.
    """
    model = likelihood.model

    def evaluate(x: Vector) -> Expansion:
        nonlocal near
        near = likelihood.expand(model.full(x, first), noise_scale, near)
        return near

    def tell(step: int, best: Expansion) -> None:
        likelihood.runner.tell(f"{label}: step {step} of at most {maximum_steps}, χ²/dof {best.misfit:.6g}")

    minimum = minimise(
        evaluate,
        first[model.free],
        free_scales(model),
        maximum_steps=maximum_steps,
        far_off=lambda expansion: not expansion.misfit < FAR_OFF,
        progress=tell,
        **how,
    )
    return dataclasses.replace(minimum, x=model.full(minimum.x, first))


def moved_within(likelihood: Likelihood, values: Vector, distance: float) -> Vector:
    """Values (n) that lie within `distance` of the minimum, in standard errors of all parameters together.

    `values` come back as they are if they lie within it. If no values within it are reached, the closest come back that
    a few steps lead to.
    """
    how = {"maximum_steps": FIRST_STEPS, "tolerance": distance}
    return _search(likelihood, "closer to the data", values, 1.0, **how).x


def with_errors_fitted(
    likelihood: Likelihood, best: FoundMinimum, first: Vector, noise_scale: float
) -> FoundMinimum:
    """The minimum in all parameters, those of the errors of the data included.

    `best` is the minimum with these errors held at the start values `first`. Scales begin where they would make χ²/dof
    of the residuals 1.
    """
    model, expansion, start = likelihood.model, best.expansion, best.x.copy()
    noise, at = model.template.noise, model.positions(NOISE)
    assert noise is not None
    start[at] = first[at]
    for i in at[: len(noise.scales)]:  # scales stand ahead of fractions
        if model.parameters[i].free:
            start[i] *= np.sqrt(expansion.misfit)
    at_start, values, found = likelihood, best.x, best
    for _ in range(ERROR_ROUNDS):
        taken = _taken_up(at_start, values, expansion)
        live = likelihood.with_errors_at(None)
        live = dataclasses.replace(live, taken=taken, light=likelihood.light_at(values))
        label = "fit with errors of the data"
        sought = _search(live, label, model.full(start[model.free], start), noise_scale, expansion)
        found = dataclasses.replace(sought, starts=best.starts, steps=found.steps + sought.steps)
        moved = (found.x - start)[model.free] * np.sqrt(np.diag(found.expansion.matrix))
        if not found.converged or np.abs(moved[np.isin(model.free, at)]).max(initial=0.0) < SETTLED:
            break
        # What the other parameters take up of the data hangs on the errors, a little.
        start, values = found.x.copy(), found.x
        at_start = likelihood.with_errors_at(values)
        expansion = at_start.expand(values, noise_scale, expansion)
    return found


def _taken_up(likelihood: Likelihood, values: Vector, expansion: Expansion) -> Float[np.ndarray, "p e k"]:
    """The part of every intensity that the parameters of the model take up, its errors held; `expansion` is there.

    Of a set whose optics are interpolated all intensities have the mean: of so many data each is taken up by a
    thousandth.
    """
    model, cameras = likelihood.model, likelihood.cameras
    unit = free_scales(model)
    inverse = np.linalg.pinv(expansion.matrix * np.outer(unit, unit), rcond=1e-15, hermitian=True)
    inverse *= np.outer(unit, unit)
    used = likelihood.used
    if not likelihood.layout.interpolated:
        rows = likelihood.jacobian(values) / expansion.noise_scale
        taken = np.zeros((*used.shape, cameras))
        taken[used] = np.einsum("df,fg,dg->d", rows, inverse, rows, optimize=True).reshape(-1, cameras)
        return taken
    known, select = likelihood.priors, model.selection()
    prior = np.zeros((len(values), len(values)))
    prior[known.index, known.index] = known.width**-2
    of_data = expansion.matrix - select.T @ prior @ select
    data = float(expansion.used_data.rows @ likelihood.data_per_row)
    mean = float(np.sum(inverse * of_data)) / max(data, 1.0)
    return np.broadcast_to(
        (mean * used * likelihood.data_per_row / cameras)[..., None], (*used.shape, cameras)
    )


def find_minimum(
    likelihood: Likelihood, first: Vector, noise_scale: float | None, target_objective: float | None
) -> FoundMinimum:
    """The minimum of a set from start values that may be far away; of a large one, from that of a sample of it.

    The sample of a very large set is large itself. `noise_scale` and `target_objective` as for `refit.fit`.
    Raises `DataError` when the exposures cannot determine the instrument.
    """
    layout = likelihood.layout
    if not layout.large:
        return _best_gaps(likelihood, _from_afar(likelihood, first, noise_scale, target_objective))
    sample_set = thinned(likelihood.calset, max(limits.SAMPLE, layout.points // limits.FARTHEST))
    sample = Likelihood.of(sample_set, likelihood.model, runner=likelihood.runner)
    sample = sample.with_errors_at(likelihood.errors_at)
    best = find_minimum(sample, first, noise_scale, target_objective)
    scale = best.expansion.noise_scale
    found = _search(likelihood, "fit of all points", best.x, scale, tolerance=LARGE_TOLERANCE, damping=0.0)
    return dataclasses.replace(found, starts=best.starts)


def _best_gaps(likelihood: Likelihood, best: FoundMinimum) -> FoundMinimum:
    """The lowest minimum with air gaps some orders of their fringes thicker or thinner.

    Fringes of gaps a quarter of a wavelength apart differ by their sign, within a narrow band: each is a minimum of its
    own. Steps go on while they lower the objective.
    """
    model, quarter = likelihood.model, 0.25 * float(np.asarray(likelihood.plan.wavelength).mean())
    for gap in model.gaps() if best.converged else ():
        for _ in range(MOST_ORDERS):
            before = best
            for order in (-2, -1, 1, 2):
                start = before.x.copy()
                start[gap] += order * quarter
                if start[gap] <= 0:
                    continue
                label = f"checking for another order of fringes ({model.names[gap]} = {start[gap]:.4g} µm)"
                scale = before.expansion.noise_scale
                trial = _search(likelihood, label, start, scale, before.expansion, maximum_steps=OTHER_STEPS)
                best = dataclasses.replace(best, starts=best.starts + 1)
                if trial.converged and trial.expansion.objective < best.expansion.objective:
                    best = dataclasses.replace(trial, starts=best.starts)
            if best.x is before.x:
                break
    return best


def _from_afar(
    likelihood: Likelihood, first: Vector, noise_scale: float | None, target_objective: float | None
) -> FoundMinimum:
    """The minimum of a search from start values that may be far away; if the model is poor, `_far_off` takes over."""
    check_identifiable(likelihood)
    scale = noise_scale or 1.0
    best = _search(likelihood, "fit", first, scale, maximum_steps=FIRST_STEPS)
    improving = (
        best.expansion.objective < target_objective
        if target_objective is not None
        else best.expansion.misfit < FAR_OFF
    )
    if not best.converged and improving:
        how = {"damping": 0.0, "secant": True}
        best = _search(likelihood, "fit, continued", best.x, scale, best.expansion, **how)
    if noise_scale is not None or best.expansion.misfit < FAR_OFF:
        return best
    return _far_off(likelihood, best)


def _far_off(likelihood: Likelihood, best: FoundMinimum) -> FoundMinimum:
    """The best minimum of a model that does not fit: errors scaled to the residuals, and plates tried a wave thicker or
    thinner.
    """
    budget, starts = most_passes(likelihood.model) - best.steps, 1

    def search(label: str, values: Vector, scale: float, maximum_steps: int) -> FoundMinimum:
        nonlocal budget
        maximum_steps = max(1, min(maximum_steps, budget))
        attempt = _search(likelihood, label, values, scale, best.expansion, maximum_steps=maximum_steps)
        budget -= attempt.steps
        return attempt

    def rescaled(best: FoundMinimum) -> FoundMinimum:
        for _ in range(MAXIMUM_RESCALINGS):
            scale = float(np.sqrt(best.expansion.misfit)) if best.expansion.misfit > FAR_OFF else 1.0
            if budget <= 0 or abs(scale / best.expansion.noise_scale - 1.0) < 0.1:
                break
            # Half of the budget at most: the other orders are to be tried as well.
            label = f"the model is far off; errors × {scale:.3g}"
            best = search(label, best.x, scale, max(FIRST_STEPS, budget // 2))
        return best

    best = rescaled(best)
    starts_left = list(_order_starts(likelihood)) if best.expansion.misfit > FAR_OFF else []
    for number, (label, first_values) in enumerate(starts_left, start=2):
        if budget <= 0:
            break
        label = f"start {number} of {len(starts_left) + 1}, {label}"
        trial, starts = search(label, first_values, best.expansion.noise_scale, OTHER_STEPS), starts + 1
        if trial.expansion.objective < best.expansion.objective:
            best = rescaled(trial)
    if not best.converged and budget > 0:
        best = search("the best of them", best.x, best.expansion.noise_scale, budget)
    if not best.converged and (misfit := best.expansion.misfit) > FAR_OFF:
        passes = most_passes(likelihood.model) - budget
        message = (
            f"given up after {passes} steps from {starts} starts: χ²/dof stays near {misfit:.3g}, and more steps "
            "buy nothing; check the columns of the set, INSTRUME and the description of the instrument, or look for "
            "missing effects (walop-jax diagnose)"
        )
        best = dataclasses.replace(best, message=message)
    return dataclasses.replace(best, starts=starts)


def check_identifiable(likelihood: Likelihood, used_data: UsedData | None = None) -> None:
    """Raise `DataError` when the exposures cannot determine an instrument at all.

    `used_data` says which data of the set are used, if the caller has counted them already; else they are counted here.
    """
    rows = (likelihood.used_data if used_data is None else used_data).rows
    e, inputs = likelihood.calset.exposures, ", ".join(str(entry.path) for entry in likelihood.calset.inputs)
    polariser = likelihood.model.template.polariser is not None
    through = (e.clp_in | (not polariser)) & (rows > 0)
    angles = np.unique(np.round(np.mod(e.clp_angle[through & e.clp_in], 180.0), 3))
    turning = [e.position(prefix).angle for prefix in likelihood.plan.moving]
    states = np.stack([np.zeros(len(e)), *turning], axis=1)[through]
    states = len(np.unique(np.nan_to_num(states, nan=-1.0), axis=0))
    if len(angles) < 3 and ((polariser and len(angles) == 0) or states < 3):
        what = f"{len(angles)} distinct polariser angle(s) modulo 180° with usable data"
        advice = "a fit of the instrument needs at least 3, better 8 or more spread over 360°"
        raise fail(what, file=inputs, extension="EXPOSURES", column="CLP_ANGLE", advice=advice)
    if likelihood.layout.points < 2 and likelihood.model.template.throughput.degree > 0:
        remedy = "write degree = 0 under [throughput] of the instrument file, or give more points"
        advice = f"the throughput over the field needs several; {remedy}"
        raise fail("a single field point", file=inputs, extension="POINTS", advice=advice)


def _order_starts(likelihood: Likelihood) -> Iterator[tuple[str, Vector]]:
    """Start values with one crystal layer a wave of its retardance thicker or thinner: plates wrap every 2π."""
    model, wavelength = likelihood.model, np.asarray(likelihood.plan.wavelength).mean()
    for place, layer in model.thicknesses().items():
        one_wave = wavelength / abs(materials.CRYSTALS[layer.material].birefringence(wavelength))
        for sign, word in ((-1, "thinner"), (1, "thicker")):
            start = model.start
            start[place] += sign * one_wave
            if start[place] > 0:
                label = f"checking for a second minimum ({model.names[place]} one wave {word})"
                yield label, model.full(start[model.free])

"""The search for the minimum of a likelihood: from afar on a small set, from a sample's minimum on a large one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.fit.minimise import Minimum, minimise, newton
from walop_jax.fit.solver import Request, WhenStale
from walop_jax.io.errors import fail
from walop_jax.likelihood import limits, pixels
from walop_jax.likelihood.expansion import Posterior
from walop_jax.likelihood.frames import stands_for_pixels, strips_of
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.thinning import thinned
from walop_jax.model import materials
from walop_jax.model.specification import Model

Vector = Float[np.ndarray, " n"]
Expand = Callable[[Vector, float, Posterior | None], Posterior]

FAR_OFF = 25.0  # χ²/dof above which other orders are tried and the errors scaled
MAXIMUM_RESCALINGS = 4
FIRST_STEPS = 20
# Scaled gradient of a large set: 10⁻³ of a standard error is 10⁻⁶ in χ², and of a χ² of 10⁹ rounding leaves 10⁻⁷.
LARGE_TOLERANCE = 1e-3


@dataclasses.dataclass(frozen=True)
class Found:
    """A minimum, the values of all parameters there, and from how many places it was sought."""

    minimum: Minimum
    values: Vector
    starts: int = 1

    @property
    def posterior(self) -> Posterior:
        """The expansion at the minimum."""
        if not isinstance(self.minimum.expansion, Posterior):
            raise TypeError("a fit needs a Posterior expansion")
        return self.minimum.expansion

    @property
    def misfit(self) -> float:
        """χ² of the data with their errors as given, per degree of freedom."""
        return self.posterior.data / max(self.posterior.dof, 1)


def free_scales(model: Model) -> Vector:
    """The unit in which a solver thinks of each free parameter."""
    return np.array([model.parameters[i].scale for i in model.free])


def _search(
    likelihood: Likelihood,
    label: str,
    first: Vector,
    noise_scale: float,
    near: Posterior | None = None,
    expand: Expand | None = None,
    **how: Any,
) -> Found:
    """The minimum from a full vector of start values; `near` is an expansion at similar ones, if there is any.

    `expand` takes the place of `Likelihood.expand`.
    """
    expand = expand or likelihood.expand
    model = likelihood.model
    select, origin = model.selection(), first[model.free]

    def full(x: Vector) -> Float[np.ndarray, " all"]:
        return first + select @ (x - origin)

    def evaluate(x: Vector, request: Request) -> Posterior:
        if request.matrix:
            return expand(full(x), noise_scale, request.near or near)
        return likelihood.slope(full(x), request.near)

    def tell(step: int, objective: float) -> None:
        likelihood.runner.tell(f"{label}: step {step}, χ² {objective:.7g}")

    minimum = minimise(evaluate, origin, free_scales(model), progress=tell, **how)
    return Found(minimum, full(minimum.x))


def find_minimum(
    likelihood: Likelihood, first: Vector, noise_scale: float | None, worth: float | None
) -> Found:
    """The minimum of a set from start values that may be far away; of a large one, from that of a sample of it.

    `noise_scale` and `worth` are those of `refit.fit`. Raises `DataError` when the exposures cannot determine the
    instrument.
    """
    if not likelihood.layout.large:
        return _minimum_from_afar(likelihood, first, noise_scale, worth)
    if stands_for_pixels(likelihood, first):
        return _minimum_of_pixels(likelihood, first, noise_scale, worth)
    near, scale, starts = _minimum_of_sample(likelihood, first, noise_scale, worth)
    found = _search(
        likelihood,
        "fit of all points",
        near,
        scale,
        matrix=WhenStale(),
        damping=0.0,
        tolerance=LARGE_TOLERANCE,
    )
    return dataclasses.replace(found, starts=starts)


def _minimum_of_pixels(
    likelihood: Likelihood, first: Vector, noise_scale: float | None, worth: float | None
) -> Found:
    """The minimum of whole frames: of a sample, then of some strips of image rows, then of all."""
    near, scale, starts = _minimum_of_sample(likelihood, first, noise_scale, worth, limits.PIXEL_SAMPLE)
    every = strips_of(likelihood) // limits.FIRST_STRIPS
    if every > 1:
        alone = dataclasses.replace(likelihood, runner=dataclasses.replace(likelihood.runner, journal=None))
        near = _search_pixels(alone, "fit of some image rows", near, scale, every, 1.0).values
    found = _search_pixels(likelihood, "fit of all pixels", near, scale, 1, LARGE_TOLERANCE)
    return dataclasses.replace(found, starts=starts)


def _search_pixels(
    likelihood: Likelihood, label: str, first: Vector, noise_scale: float, every: int, tolerance: float
) -> Found:
    """The minimum of one strip of image rows in `every`, by Newton steps where these lead there."""
    model = likelihood.model
    select, origin = model.selection(), first[model.free]

    def expand(values: Vector, noise_scale: float, _: Posterior | None = None) -> Posterior:
        return pixels.expand(likelihood, values, noise_scale, every)

    def full(x: Vector) -> Float[np.ndarray, " all"]:
        return first + select @ (x - origin)

    def tell(step: int, objective: float) -> None:
        likelihood.runner.tell(f"{label}: pass {step}, χ² {objective:.10g}")

    minimum = newton(
        lambda x: expand(full(x), noise_scale), origin, free_scales(model), tolerance=tolerance, progress=tell
    )
    if minimum is not None:
        return Found(minimum, full(minimum.x))
    return _search(likelihood, label, first, noise_scale, expand=expand, damping=0.0, tolerance=tolerance)


def _minimum_of_sample(
    likelihood: Likelihood,
    first: Vector,
    noise_scale: float | None,
    worth: float | None,
    points: int | None = None,
) -> tuple[Vector, float, int]:
    """The minimum of a sample of a large set, the factor on the errors, and from how many places it was sought.

    Without a number of `points` the sample of a very large set is large itself.
    """
    points = points or max(limits.SAMPLE, likelihood.layout.points // limits.FARTHEST)

    def make() -> Vector:
        sample = Likelihood.of(
            thinned(likelihood.calset, points),
            likelihood.model,
            memory=likelihood.layout.allowed,
            runner=dataclasses.replace(likelihood.runner, journal=None),
        )
        found = find_minimum(sample, first, noise_scale, worth)
        return np.append(found.values, [found.posterior.noise_scale, found.starts])

    journal = likelihood.runner.journal
    key = f"sample {points} {first.tobytes().hex()} {noise_scale} {worth}"
    *values, scale, starts = make() if journal is None else journal.remembered(key, make)
    return np.array(values), float(scale), int(starts)


def _minimum_from_afar(
    likelihood: Likelihood, first: Vector, noise_scale: float | None, worth: float | None
) -> Found:
    """The minimum from start values that may be far away, the errors of the data scaled if need be."""
    check_identifiable(likelihood)
    given = noise_scale or 1.0
    found = _search(likelihood, "fit", first, given, maximum_steps=FIRST_STEPS)
    promising = found.posterior.objective < worth if worth is not None else found.misfit < FAR_OFF
    if not found.minimum.converged and promising:
        found = _search(likelihood, "fit, continued", found.values, given, found.posterior, damping=0.0)
    if noise_scale is not None:
        return found
    for _ in range(MAXIMUM_RESCALINGS):
        scale = float(np.sqrt(found.misfit))
        if scale**2 < FAR_OFF or abs(scale / found.posterior.noise_scale - 1.0) < 0.1:
            break
        found = _search(likelihood, f"errors × {scale:.3g}", first, scale, found.posterior)
    if not found.misfit > FAR_OFF:
        return found
    starts = 1
    for label, other in _order_starts(likelihood):
        trial = _search(likelihood, label, other, found.posterior.noise_scale, found.posterior)
        starts += 1
        if trial.posterior.objective < found.posterior.objective:
            found = trial
    return dataclasses.replace(found, starts=starts)


def check_identifiable(likelihood: Likelihood) -> None:
    """Raise `DataError` when the exposures cannot determine an instrument at all."""
    e, inputs = likelihood.calset.exposures, ", ".join(str(entry.path) for entry in likelihood.calset.inputs)
    through = e.clp_in & (likelihood.census.rows > 0)
    angles = np.unique(np.round(np.mod(e.clp_angle[through], 180.0), 3))
    turning = [e.position(prefix).angle for prefix in likelihood.plan.moving]
    states = len(
        np.unique(np.nan_to_num(np.stack([np.zeros(len(e)), *turning], axis=1)[through], nan=-1.0), axis=0)
    )
    if len(angles) < 3 and (len(angles) == 0 or states < 3):
        raise fail(
            f"{len(angles)} distinct polariser angle(s) modulo 180° with usable data",
            file=inputs,
            extension="EXPOSURES",
            column="CLP_ANGLE",
            advice="a fit of the instrument needs at least 3, better 8 or more spread over 360°",
        )
    if likelihood.layout.points < 2 and likelihood.model.template.throughput.degree > 0:
        raise fail(
            "a single field point",
            file=inputs,
            extension="POINTS",
            advice="the joint fit over the field needs several",
        )


def _order_starts(likelihood: Likelihood) -> Iterator[tuple[str, Vector]]:
    """Start values one order of retardance away: first-order plates wrap every 2π."""
    wavelength = np.asarray(likelihood.plan.wavelength).mean()
    birefringence = float(
        materials.MGF2_E.refractive_index(wavelength) - materials.MGF2_O.refractive_index(wavelength)
    )
    one_wave = wavelength / birefringence
    thick = [name for name in reversed(likelihood.model.names) if name.endswith("plate.mgf2")]
    for name in thick:
        for sign in (-1, 1):
            start = likelihood.model.start.copy()
            start[likelihood.model.index(name)] += sign * one_wave
            yield f"{name} {sign:+d} wave", start

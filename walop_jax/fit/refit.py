"""The joint fit of a calibration set: start values, Levenberg–Marquardt, gates, covariance."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.levenberg import MAXIMUM_STEPS, Expansion, Minimum, minimise, polish
from walop_jax.likelihood.chunks import thinned
from walop_jax.likelihood.problem import Posterior, Problem, base_model
from walop_jax.model import materials
from walop_jax.model.specification import Model

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

SUSPECT_SIGMA = 5.0  # excess of χ² over its expectation, in its own standard deviations
PRIOR_EDGE = 4.0  # standard deviations
FAR_OFF = 25.0  # χ²/dof above which other orders are tried and the errors scaled
MAXIMUM_RESCALINGS = 4
FIRST_STEPS = 20
# Scaled gradient of a large set: 10⁻³ of a standard error is 10⁻⁶ in χ², and of a χ² of 10⁹ rounding leaves 10⁻⁷.
LARGE_TOLERANCE = 1e-3
SAMPLE = 16384  # field points of a large set on which its fit begins
# Points of a set for each one of its sample: the sample's minimum is some six standard errors from that of the set,
# which a step leaves a thousandth of.
FARTHEST = 32
Progress = Callable[[str, int, float], None]


@dataclasses.dataclass(frozen=True)
class _Found:
    minimum: Minimum
    values: Vector  # of all parameters


@dataclasses.dataclass(frozen=True)
class FitResult:
    """A fit and how far it can be trusted.

    `values` and `covariance` are of all parameters in tree order, frozen ones with zero variance. `trusted` needs a
    converged fit that explains the data; `warnings` says in words what does not hold.
    """

    model: Model
    values: Vector
    covariance: Matrix
    posterior: Posterior
    minimum: Minimum
    n_data: int
    dof: int
    starts: int
    seconds: float
    warnings: tuple[str, ...]

    @property
    def chi2(self) -> float:
        """χ² of data and priors."""
        return self.posterior.chi2

    @property
    def sigma(self) -> Vector:
        """Standard errors of all parameters."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    @property
    def n_priors(self) -> int:
        """Number of free parameters that are known beforehand."""
        return sum(1 for i in self.model.free if self.model.parameters[i].prior is not None)

    @property
    def excess(self) -> float:
        """(χ² − dof) / √(2 dof): how many standard deviations χ² lies above its expectation."""
        return (self.chi2 - self.dof) / np.sqrt(2.0 * max(self.dof, 1))

    @property
    def converged(self) -> bool:
        """Whether the minimum was reached and is well conditioned."""
        return self.minimum.converged

    @property
    def noise_scale(self) -> float:
        """Factor on the errors of the data under which the minimum was sought; 1 unless the model is far off."""
        return self.posterior.noise_scale

    @property
    def explains_data(self) -> bool:
        """Whether χ² is what noise alone would give."""
        return self.dof > 0 and bool(self.excess < SUSPECT_SIGMA)

    @property
    def trusted(self) -> bool:
        """Whether the result may be used without a second thought."""
        return self.converged and self.explains_data

    def value(self, name: str) -> tuple[float, float]:
        """Value and standard error of a parameter."""
        i = self.model.index(name)
        return float(self.values[i]), float(self.sigma[i])


def check_identifiable(problem: Problem) -> None:
    """Raise ValueError when the exposures cannot determine an instrument at all."""
    e = problem.calset.exposures
    through = e.clp_in & (problem.rows_used > 0)
    angles = np.unique(np.round(np.mod(e.clp_angle[through], 180.0), 3))
    if len(angles) < 3:
        raise ValueError(
            f"{len(angles)} distinct polariser angle(s) modulo 180° with usable data: a fit of the instrument needs "
            "at least 3, better 8 or more spread over 360°"
        )
    if len(problem.calset.points) < 2:
        raise ValueError("a single field point: the joint fit over the field needs several points")


def check_constrained(problem: Problem, posterior: Posterior) -> None:
    """Raise ValueError for a free parameter that neither data nor a prior know anything of."""
    idle = [problem.model.parameters[i].name for i in problem.model.free[np.diag(posterior.matrix) == 0.0]]
    if idle:
        raise ValueError(
            f"nothing in the data depends on {', '.join(idle)}, free and without a prior: freeze "
            f"{'it' if len(idle) == 1 else 'them'} or set a prior in the model file"
        )


def covariance(problem: Problem, posterior: Posterior) -> Matrix:
    """Covariance of all parameters: the inverse of JᵀJ, priors included, ties expanded."""
    scale = _scale(problem.model)
    scaled = posterior.matrix * np.outer(scale, scale)
    value, vector = np.linalg.eigh(scaled)
    keep = value > value.max(initial=0.0) * 1e-15
    inverse = (vector[:, keep] / value[keep]) @ vector[:, keep].T
    select = problem.model.selection() * scale
    return select @ inverse @ select.T


def _scale(model: Model) -> Vector:
    return np.array([model.parameters[i].scale for i in model.free])


def _order_starts(problem: Problem) -> Iterator[tuple[str, Vector]]:
    """Start values one order of retardance away: first-order plates wrap every 2π."""
    wavelength = np.asarray(problem.plan.wavelength).mean()
    birefringence = float(
        materials.MGF2_E.refractive_index(wavelength) - materials.MGF2_O.refractive_index(wavelength)
    )
    one_wave = wavelength / birefringence
    for name in ("half2.plate.mgf2", "half1.plate.mgf2"):
        for sign in (-1, 1):
            start = problem.model.start.copy()
            start[problem.model.index(name)] += sign * one_wave
            yield f"{name} {sign:+d} wave", start


def _search(
    problem: Problem,
    label: str,
    first: Vector,
    noise_scale: float,
    progress: Progress | None,
    steps: int = MAXIMUM_STEPS,
) -> _Found:
    model = problem.model
    select, origin = model.selection(), first[model.free]
    report = None if progress is None else lambda step, chi2: progress(label, step, chi2)

    def expand(x: Vector) -> Posterior:
        return problem.expand(first + select @ (x - origin), noise_scale)

    minimum = minimise(expand, origin, _scale(model), maximum_steps=steps, progress=report)
    return _Found(minimum, first + select @ (minimum.x - origin))


def _near(
    problem: Problem, first: Vector, noise_scale: float | None, worth: float | None, progress: Progress | None
) -> tuple[Vector, float, int]:
    """The minimum of a sample of a large set, the factor on the errors, and from how many places it was sought.

    The sample of a very large set is large itself.
    """

    def make() -> Vector:
        points = max(SAMPLE, len(problem.calset.points) // FARTHEST)
        sample = Problem(thinned(problem.calset, points), problem.model)
        if sample.is_large:
            near, scale, starts = _near(sample, first, noise_scale, worth, progress)
            return np.append(_polished(sample, near, scale, progress).values, [scale, starts])
        found, starts = _sought(sample, first, noise_scale, worth, progress)
        return np.append(found.values, [_expansion(found).noise_scale, starts])

    journal = problem.passes.journal
    key = f"sample {first.tobytes().hex()} {noise_scale} {worth}"
    *values, scale, starts = make() if journal is None else journal.remembered(key, make)
    return np.array(values), float(scale), int(starts)


def _polished(problem: Problem, first: Vector, noise_scale: float, progress: Progress | None) -> _Found:
    """The minimum of a large set from a place near it."""
    model = problem.model
    select = model.selection()
    origin = first[model.free]

    def full(x: Vector) -> Float[np.ndarray, " all"]:
        return first + select @ (x - origin)

    minimum = polish(
        lambda x: problem.expand(full(x), noise_scale),
        lambda x, there: problem.slope(full(x), _posterior(there)),
        origin,
        _scale(model),
        tolerance=LARGE_TOLERANCE,
        progress=None if progress is None else lambda step, chi2: progress("fit of all points", step, chi2),
    )
    return _Found(minimum, full(minimum.x))


def fit(
    problem: Problem,
    *,
    start: Vector | None = None,
    noise_scale: float | None = None,
    worth: float | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """Fit the model of `problem` to its data, from the start values of the model or `start` (a full vector).

    A model whose χ²/dof stays above `FAR_OFF` would be bent out of all physical shape: priors mean nothing beside
    such residuals. The errors of the data are then scaled until χ²/dof is 1, the minimum is sought again, from plates
    one order of retardance away as well, and the result says so (`noise_scale`, `warnings`). A `noise_scale` that
    is given is kept, with no other start: so that fits can be compared; `worth` is the objective of the other fit,
    and a search that has not come below it when it should have converged is given up.
    The minimum of a large set (`Problem.is_large`) is sought on a sample of its points; a pass over all of them gives
    the step from there to its own, and another one shows that nothing is left to do.
    Raises ValueError when the exposures cannot determine the instrument.
    """
    began = time.perf_counter()
    first = problem.model.start if start is None else np.asarray(start, float)
    if problem.is_large:
        near, scale, starts = _near(problem, first, noise_scale, worth, progress)
        found = _polished(problem, near, scale, progress)
    else:
        found, starts = _sought(problem, first, noise_scale, worth, progress)
    posterior = _expansion(found)
    check_constrained(problem, posterior)
    result = FitResult(
        model=problem.model,
        values=found.values,
        covariance=covariance(problem, posterior),
        posterior=posterior,
        minimum=found.minimum,
        n_data=problem.n_data,
        dof=problem.dof,
        starts=starts,
        seconds=time.perf_counter() - began,
        warnings=(),
    )
    return dataclasses.replace(result, warnings=tuple(_warnings(result)))


def _sought(
    problem: Problem, first: Vector, noise_scale: float | None, worth: float | None, progress: Progress | None
) -> tuple[_Found, int]:
    """The minimum from start values that may be far away, and from how many places it was sought."""
    check_identifiable(problem)
    fixed = noise_scale is not None
    found, starts = _search(problem, "fit", first, noise_scale or 1.0, progress, FIRST_STEPS), 1
    promising = _expansion(found).objective < worth if worth is not None else _raw(found, problem) < FAR_OFF
    if not found.minimum.converged and promising:
        found = _search(problem, "fit, continued", found.values, noise_scale or 1.0, progress)
    for _ in range(0 if fixed else MAXIMUM_RESCALINGS):
        scale = float(np.sqrt(_raw(found, problem)))
        if scale**2 < FAR_OFF or abs(scale / _expansion(found).noise_scale - 1.0) < 0.1:
            break
        found = _search(problem, f"errors × {scale:.3g}", first, scale, progress)
    if not fixed and _raw(found, problem) > FAR_OFF:
        for label, other in _order_starts(problem):
            trial = _search(problem, label, other, _expansion(found).noise_scale, progress)
            starts += 1
            if trial.minimum.expansion.objective < found.minimum.expansion.objective:
                found = trial
    return found, starts


def _raw(found: _Found, problem: Problem) -> float:
    """χ² of the data with their errors as given, per degree of freedom."""
    return _expansion(found).data / max(problem.dof, 1)


def _expansion(found: _Found) -> Posterior:
    return _posterior(found.minimum.expansion)


def _posterior(expansion: Expansion) -> Posterior:
    if not isinstance(expansion, Posterior):
        raise TypeError("a fit needs a Posterior expansion")
    return expansion


def _warnings(result: FitResult) -> Iterator[str]:
    if not result.converged:
        yield result.minimum.message
    if result.dof <= 0:
        yield f"{result.n_data} intensities for {len(result.model.free)} free parameters: nothing is left to test"
    elif not result.explains_data:
        yield (
            f"χ²/dof = {result.chi2 / result.dof:.4g} lies {result.excess:.3g} standard deviations above 1: the model "
            "does not explain the data; do not trust the calibration (walop-jax diagnose looks for what is missing)"
        )
    elif result.excess < -SUSPECT_SIGMA:
        yield f"χ²/dof = {result.chi2 / result.dof:.4g}: the stated errors N_ERR are too large (gain or units?)"
    if result.noise_scale > 1.0:
        yield f"the errors of the data were multiplied by {result.noise_scale:.3g} to fit at all: the model is far off"
    for i in result.model.free:
        p = result.model.parameters[i]
        if p.prior is not None and abs(result.values[i] - p.prior[0]) > PRIOR_EDGE * p.prior[1]:
            pull = (result.values[i] - p.prior[0]) / p.prior[1]
            yield f"{p.name} = {result.values[i]:.6g} {p.unit} lies {pull:+.1f} prior widths from {p.prior[0]:g}"


def refit(
    calset: CalibrationSet, model: Model | None = None, *, progress: Progress | None = None
) -> FitResult:
    """Fit a calibration set with `model` (default: the base model)."""
    return fit(Problem(calset, model or base_model(calset)), progress=progress)

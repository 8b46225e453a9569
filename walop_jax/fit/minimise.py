"""Levenberg–Marquardt on normal equations: one minimiser for ten intensities or 10⁹.

A pass over the data hands over χ², Jᵀr and JᵀJ, so that residuals are neither seen nor stored here. The search runs on
the host, since a pass may read files, in parameters scaled to their prior width.

Step        δ = −(JᵀJ + λ)⁻¹ Jᵀr, λ following optimistix' classical trust region from `damping` on. A start that may be
            far away takes λ = 1; one near the minimum λ = 0, the Newton step, until a step leads upwards.
Curvature   Σ rᵢ ∇²rᵢ, which JᵀJ lacks, decides along directions that the data hardly see: a hundred steps to and fro.
            With `secant` it is S, made from the gradients of successive places, and steps are −(JᵀJ + S + λ)⁻¹ Jᵀr
            where S would have predicted the last change of the objective better than JᵀJ alone.
Stop        `TOLERANCE`: the scaled gradient d = ‖(JᵀJ)^(−½) Jᵀr‖, the distance to the minimum in standard errors. A
            Newton step is not looked at if d²/d₋₁, which steps that close in at a constant rate leave, is that small
            (d₋₁: the distance at the place before).
            `ROUGH`: a model that is far from the data (`far_off`) has errors made from its residuals anyway, and is
            near enough with d below this, at the second such place in a row if it may look at another.
            `ROUNDING`: a step that did not lower the objective is the last where the next could not be separated from
            it. `MAXIMUM_STEPS`: places looked at.
Source      `SOURCE`: the method and its trust region.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import scipy.linalg

from walop_jax.io.shapes import Matrix, Vector
from walop_jax.model.compiled import compiled

SOURCE = (
    "Moré 1978, Lecture Notes in Mathematics 630, 105; Conn, Gould & Toint 2000, Trust Region Methods; "
    "Dennis, Gay & Welsch 1981, ACM Trans. Math. Software 7, 348"
)

RESULTS = optx.RESULTS

MAXIMUM_STEPS = 200
"""Along a curved valley that only a prior closes (throughput and flux) there may be more than a hundred."""
TOLERANCE = 1e-4
ROUGH = 0.1
ROUNDING = 1e-12  # of an objective: near the end two of them differ by less
# Sums of many terms are good to some 10⁻¹⁵ of the largest eigenvalue: the smallest is then known to ten per cent.
LARGEST_CONDITION = 1e14
# Fractions of the predicted reduction below which λ grows and above which it falls. With 0.01 steps go to and fro
# across a valley that is bent twice as much as Gauss and Newton have it; with 0.99 a problem that is a little curved
# keeps its λ and with it a slow end: directions that the data hardly see then take forty steps.
BADLY_PREDICTED, WELL_PREDICTED = 0.25, 0.75


@runtime_checkable
class Quadratic(Protocol):
    """The objective at one place: its value, and half its gradient and Hessian there."""

    @property
    def objective(self) -> float:
        """The value to be minimised."""
        ...

    @property
    def gradient(self) -> Vector:
        """Half the gradient (n) of the objective."""
        ...

    @property
    def matrix(self) -> Matrix:
        """Half the Gauss–Newton Hessian (n, n) of the objective."""
        ...


AnyQuadratic = TypeVar("AnyQuadratic", bound=Quadratic)


@dataclasses.dataclass(frozen=True, repr=False)
class Minimum(Generic[AnyQuadratic]):
    """End of a search: `x` in the units it was given, the expansion there and the gates.

    `steps` counts the places looked at, `history` holds their objectives; `result` is a member of
    `optimistix.RESULTS`, and `message` says it in words. It was sought from so many `starts`.
    """

    x: Vector
    expansion: AnyQuadratic
    result: optx.RESULTS
    message: str
    steps: int
    scaled_gradient: float
    condition: float
    history: tuple[float, ...]
    starts: int = 1

    def __repr__(self) -> str:
        value = f"{self.expansion.objective:.7g}"
        return f"Minimum {value} in {len(self.x)} parameters after {self.steps} steps: {self.message}"

    @property
    def converged(self) -> bool:
        """True if the minimum was reached and is well conditioned."""
        return bool(self.result == RESULTS.successful)


def minimise(
    evaluate: Callable[[Vector], AnyQuadratic],
    start: Vector,
    scale: Vector,
    **how: Any,
) -> Minimum[AnyQuadratic]:
    """Minimise a sum of squares from `start`; `scale` is the unit of each parameter.

    `evaluate(x)` gives the objective and its expansion at x; `how` are the other arguments of `search_of`.
    """
    search: Generator[Vector, AnyQuadratic, Minimum[AnyQuadratic]] = search_of(start, scale, **how)
    place = next(search)
    while True:
        try:
            place = search.send(evaluate(place))
        except StopIteration as end:
            return end.value


def search_of(
    start: Vector,
    scale: Vector,
    *,
    damping: float = 1.0,
    maximum_steps: int = MAXIMUM_STEPS,
    tolerance: float = TOLERANCE,
    far_off: Callable[[AnyQuadratic], bool] = lambda _: False,
    secant: bool = False,
    progress: Callable[[int, AnyQuadratic], None] | None = None,
) -> Generator[Vector, AnyQuadratic, Minimum[AnyQuadratic]]:
    """The search for the minimum of a sum of squares, one place at a time: it asks for places, it is sent expansions.

    It yields the next place that it wants to know about, is sent the objective and its expansion there, and returns the
    minimum. Whoever drives it decides how a place is evaluated: `minimise` asks a function, `fit.many` evaluates the
    places of many searches in one program.

    `scale` is the unit of each parameter; `far_off` says whether the model of an expansion is hopelessly far from the
    data; `secant` is for searches that Gauss–Newton steps alone did not end; `progress(step, expansion)` is given the
    best one after each of at most `maximum_steps` places, the start among them. Where the last step is not looked at,
    `scaled_gradient` is the one to be expected, and the expansion that of the place before. Never raises for a
    numerical outcome: the gates, `result` and `message` say what happened.
    """
    x = trial = np.asarray(start, float)
    size = 1.0 / damping if damping > 0 else np.inf
    current, model, step, history = None, None, np.zeros(len(x)), []
    curvature, bent = np.zeros((len(x), len(x))), False
    distance, before, condition = np.inf, np.inf, np.inf
    result = RESULTS.nonlinear_max_steps_reached
    while len(history) < maximum_steps:
        candidate = yield trial
        history.append(candidate.objective)
        if current is None and not np.isfinite(candidate.objective):
            current, result = candidate, RESULTS.nonfinite
            break
        lowered = current is None or candidate.objective < current.objective
        size, accept = _accepted(step, model, candidate, size)
        if secant and current is not None:
            bent = _predicts_better(curvature, step, current, candidate)
            curvature = _secant(curvature, step, current, candidate)
        if current is None or accept:
            x, current, before = trial, candidate, distance
            distance, condition = distance_to_minimum(candidate)
        if progress is not None:
            progress(len(history), current)
        step, model = _step(current, curvature if bent else None, scale, 1.0 / size)
        remaining = distance**2 / before if accept and np.isinf(size) and np.isfinite(before) else np.inf
        rough = far_off(current) and distance < ROUGH and (before < ROUGH or len(history) == maximum_steps)
        smallest = ROUNDING * abs(current.objective)
        last = not lowered and -_change(step, model) < smallest
        if min(distance, remaining) < tolerance or rough or (last and distance**2 < smallest):
            if tolerance <= distance and remaining < tolerance:
                x, distance = x + step, remaining
            result = RESULTS.conlim if condition > LARGEST_CONDITION else RESULTS.successful
            break
        if last:
            result = RESULTS.stagnation
            break
        trial = x + step
    assert current is not None
    steps, reached = len(history), f"scaled gradient {distance:.1e}"
    messages = (
        (RESULTS.successful, f"converged: {reached}"),
        (RESULTS.conlim, f"parameters cannot be distinguished: condition number {condition:.1e}"),
        (RESULTS.stagnation, f"no step lowers χ² any more, {reached}"),
        (RESULTS.nonfinite, "the model is not finite at the start values"),
    )
    unfinished = f"not converged after {steps} steps, {reached}"
    message = next((text for outcome, text in messages if bool(result == outcome)), unfinished)
    return Minimum(x, current, result, message, steps, distance, condition, tuple(history))  # pyright: ignore[reportArgumentType]


def distance_to_minimum(expansion: Quadratic) -> tuple[float, float]:
    """‖(JᵀJ)^(−½) Jᵀr‖ in scaled parameters, and the condition number of JᵀJ with ones on its diagonal.

    The condition number should not depend on how well each parameter is known by itself, only on the correlations:
    scaling by the diagonal is the best choice up to a factor, the number of parameters (van der Sluis 1969, Numerische
    Mathematik 14, 14).
    """
    matrix, gradient = expansion.matrix, expansion.gradient
    if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
        return np.inf, np.inf
    # In units of the error of each: in others a parameter that the data hardly see would fall below the rounding.
    size = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    informed = size > 0
    if not informed.any():
        return 0.0, np.inf if len(gradient) else 1.0
    unit = size[informed]
    value, vector = np.linalg.eigh(matrix[np.ix_(informed, informed)] / np.outer(unit, unit))
    condition = float(value[-1] / value[0]) if informed.all() and value[0] > 0 else np.inf
    positive = value > value[-1] * 1e-15
    along = vector.T @ (gradient[informed] / unit)
    return float(np.sqrt(np.sum(along[positive] ** 2 / value[positive]))), condition


@dataclasses.dataclass(frozen=True)
class _Bent:
    """A quadratic whose matrix is not JᵀJ alone."""

    objective: float
    gradient: Vector
    matrix: Matrix


def _step(
    here: Quadratic, curvature: Matrix | None, scale: Vector, damping: float
) -> tuple[Vector, Quadratic]:
    """−(H + λ)⁻¹ Jᵀr, and the quadratic with H = JᵀJ + S; H = JᵀJ without S, or where that sum has no minimum.

    The step is not a number where the matrix is singular.
    """
    if not len(scale):  # SciPy before 1.14 fails on empty systems
        return np.zeros(0), here
    models = [here]
    if curvature is not None:
        models.insert(0, _Bent(here.objective, here.gradient, here.matrix + curvature))
    for model in models:
        try:
            factors = scipy.linalg.cho_factor(model.matrix + np.diag(damping / scale**2), check_finite=False)
        except np.linalg.LinAlgError:
            continue
        return -scipy.linalg.cho_solve(factors, model.gradient, check_finite=False), model
    return np.full(len(scale), np.nan), here


def _predicts_better(curvature: Matrix, step: Vector, here: Quadratic, there: Quadratic) -> bool:
    """True if, with S, the predicted change of the objective by a step would have been less wrong."""
    wrong = there.objective - here.objective - _change(step, here)
    return abs(wrong - float(step @ curvature @ step)) < abs(wrong)


def _secant(curvature: Matrix, step: Vector, here: Quadratic, there: Quadratic) -> Matrix:
    """S after a step s: the symmetric matrix nearest to the old one with S s = y − JᵀJ s, JᵀJ that of the new place.

    y is the change of the gradient. Nearest is meant in the metric of a matrix that maps s to y, so that the units of
    the parameters do not matter. Before that S is reduced to its size along s: without residuals it goes to 0. Source:
    Dennis, Gay & Welsch 1981; they have (J − J₀)ᵀr on the right, but the old J₀ is not kept here.
    """
    y = there.gradient - here.gradient
    wanted, along = y - there.matrix @ step, float(y @ step)
    if not along > 0.0:  # no positive matrix has this secant; or not a number
        return curvature
    before = abs(float(step @ curvature @ step))
    curvature = curvature * (min(1.0, abs(float(step @ wanted)) / before) if before > 0.0 else 1.0)
    off = wanted - curvature @ step
    outer = np.outer(off, y)
    return curvature + (outer + outer.T) / along - float(off @ step) / along**2 * np.outer(y, y)


def _change(step: Vector, here: Quadratic) -> float:
    """Change of the objective by a step, as predicted."""
    return float(2.0 * here.gradient @ step + step @ here.matrix @ step)


def _accepted(step: Vector, here: Quadratic | None, there: Quadratic, size: float) -> tuple[float, bool]:
    """Size of the trust region after a step from `here` to `there`, and whether the step is taken."""
    if here is None:
        return size, True
    objective = there.objective if np.isfinite(there.objective) else np.inf
    slopes = here.gradient @ step, step @ here.matrix @ step
    grown, predicted = map(np.asarray, _region(size, here.objective, objective, *slopes))
    # From no damping at all the first retreat is to λ = 1.
    grown = float(grown) if predicted or np.isfinite(grown) else 1.0
    return grown, objective - here.objective <= ROUNDING * abs(here.objective)


def _of_step(size: Any, here: Any, there: Any, slope: Any, bend: Any) -> Any:
    """The trust region of optimistix along one step: numbers, so that one program serves any number of parameters.

    Its objective is half of the sum of squares.
    """
    operator = lx.MatrixLinearOperator(bend[None, None], lx.positive_semidefinite_tag)
    along = optx.FunctionInfo.EvalGradHessian(0.5 * here, slope[None], operator)
    state = eqx.tree_at(lambda s: s.step_size, _REGION.init(jnp.zeros(1), None), size)  # pyright: ignore[reportArgumentType]
    grown, accept, *_ = _REGION.step(
        jnp.array(False), jnp.zeros(1), jnp.ones(1), along, optx.FunctionInfo.Eval(0.5 * there), state
    )
    return grown, accept


_REGION = optx.ClassicalTrustRegion(low_cutoff=BADLY_PREDICTED, high_cutoff=WELL_PREDICTED)
_region = compiled(_of_step, kept_as="region")

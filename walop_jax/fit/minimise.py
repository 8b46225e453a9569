"""Levenberg–Marquardt on normal equations: one minimiser for ten intensities or 10⁹.

A pass over the data hands over χ², Jᵀr and JᵀJ, so that residuals are neither seen nor stored here. The search runs on
the host, since a pass may read files, in parameters scaled to their prior width.

Step        δ = −(JᵀJ + λ)⁻¹ Jᵀr, λ following optimistix' classical trust region from `damping` on. A start that may be
            far away takes λ = 1; one near the minimum λ = 0, the Newton step, until a step leads upwards.
Stop        The scaled gradient d = ‖(JᵀJ)^(−½) Jᵀr‖ < `tolerance`: the distance to the minimum in standard errors.
            Without `look_at_end` a Newton step is not looked at if d²/d₋₁, which steps that close in at a constant rate
            leave, is that small (d₋₁: the distance at the place before). A model that is far from the data
            (`far_off`) is given up sooner: where d < `ROUGH` shrinks by less than a factor of `CLOSING_IN` a step, as
            its errors are made from what it leaves anyway; or where `PATIENCE` places in a row have lowered the
            objective by less than `LEAST_GAIN` of itself.
Source      `SOURCE`: the method and its trust region.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from walop_jax.model.compiled import array, compiled

SOURCE = "Moré 1978, Lecture Notes in Mathematics 630, 105; Conn, Gould & Toint 2000, Trust Region Methods"

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]
RESULTS = optx.RESULTS

MAXIMUM_STEPS = 200
"""Along a curved valley that only a prior closes (throughput and flux) there may be more than a hundred."""
TOLERANCE = 1e-4
ROUGH, CLOSING_IN = 0.1, 3.0
PATIENCE, LEAST_GAIN = 6, 1e-3
# Sums of many terms are good to some 10⁻¹⁵ of the largest eigenvalue: the smallest is then known to ten per cent.
LARGEST_CONDITION = 1e14
ROUNDING = 1e-12  # of an objective: near the end two of them differ by less
SMALLEST_STEP = 1e-14  # of the trust region
# Share of the predicted reduction above which λ falls. With 0.99 a problem that is a little curved keeps its λ and with
# it a slow end: directions that the data hardly see then take forty steps.
WELL_PREDICTED = 0.75


@runtime_checkable
class Expansion(Protocol):
    """Value, and half the gradient and Hessian, of what is minimised, at one place."""

    @property
    def objective(self) -> float:
        """Value to be minimised."""
        ...

    @property
    def gradient(self) -> Vector:
        """Half the gradient."""
        ...

    @property
    def matrix(self) -> Matrix:
        """Half the Gauss–Newton Hessian."""
        ...


@dataclasses.dataclass(frozen=True)
class Minimum:
    """End of a search: `x` in the units it was given, the expansion there and the gates.

    `steps` counts the places looked at, `history` holds their objectives; `result` is a member of
    `optimistix.RESULTS`, and `message` says it in words.
    """

    x: Vector
    expansion: Expansion
    result: optx.RESULTS
    message: str
    steps: int
    scaled_gradient: float
    condition: float
    history: tuple[float, ...]

    @property
    def converged(self) -> bool:
        """True if the minimum was reached and is well conditioned."""
        return bool(self.result == RESULTS.successful)


class _Information(NamedTuple):
    """An expansion in scaled parameters, as compiled code takes it."""

    objective: Any
    gradient: Any
    matrix: Any

    @classmethod
    def of(cls, given: Expansion, scale: Vector) -> _Information:
        objective = given.objective if np.isfinite(given.objective) else np.inf
        return cls(objective, given.gradient * scale, given.matrix * np.outer(scale, scale))

    def of_function(self) -> Any:
        """The same as optimistix takes it, whose objective is half of the sum of squares."""
        operator = lx.MatrixLinearOperator(self.matrix, lx.positive_semidefinite_tag)
        return optx.FunctionInfo.EvalGradHessian(0.5 * self.objective, self.gradient, operator)


def minimise(
    evaluate: Callable[[Vector], Expansion],
    start: Vector,
    scale: Vector,
    *,
    damping: float = 1.0,
    maximum_steps: int = MAXIMUM_STEPS,
    tolerance: float = TOLERANCE,
    look_at_end: bool = True,
    far_off: Callable[[Any], bool] = lambda _: False,
    progress: Callable[[int, Any], None] | None = None,
) -> Minimum:
    """Minimise a sum of squares from `start`; `scale` is the unit of each parameter.

    `evaluate(x)` gives the objective and its expansion at x, `far_off` says of an expansion whether the model is
    hopelessly far from the data there. No more than `maximum_steps` places are looked at, the start among them;
    `progress(step, expansion)` is told the best one after each. Without `look_at_end` the last step may be taken
    unseen: `scaled_gradient` is then the one to be expected, and the expansion that of the place before. Never raises
    for a numerical outcome: the gates, `result` and `message` say what happened.
    """
    x = trial = np.asarray(start, float)
    region = _REGION.init(array(np.zeros(len(x))), None)  # pyright: ignore[reportArgumentType]
    region = eqx.tree_at(lambda s: s.step_size, region, array(1.0 / damping if damping > 0 else np.inf))
    here, near, history, best = None, None, [], []
    distance, before, condition = np.inf, np.inf, np.inf
    result, why = RESULTS.nonlinear_max_steps_reached, ""
    while len(history) < maximum_steps:
        found = evaluate(trial)
        history.append(found.objective)
        there = _Information.of(found, scale)
        if here is None or near is None:
            here, near = found, there
            if not np.isfinite(found.objective):
                result = RESULTS.nonfinite
                break
        size, accept, region, step = _next(len(history) == 1, x / scale, trial / scale, near, there, region)
        if bool(accept):
            x, here, near, before = trial, found, there, distance
            distance, condition = distance_to_minimum(there)
        best.append(here.objective)
        if progress is not None:
            progress(len(history), here)
        hopeless = far_off(here)
        left = distance * distance / before if bool(accept) and not look_at_end and np.isinf(size) else 0.0
        rough = hopeless and distance < ROUGH and distance * CLOSING_IN > before
        if distance < tolerance or 0.0 < left < tolerance or rough:
            if distance >= tolerance and 0.0 < left < tolerance:
                x, distance = x + scale * np.asarray(step), left
            result = RESULTS.conlim if condition > LARGEST_CONDITION else RESULTS.successful
            break
        if hopeless and len(best) > PATIENCE and best[-1] > (1.0 - LEAST_GAIN) * best[-1 - PATIENCE]:
            result, why = (
                RESULTS.stagnation,
                f"{PATIENCE} more steps lowered χ² by less than {LEAST_GAIN:.1%}",
            )
            break
        if float(size) < SMALLEST_STEP:
            result, why = RESULTS.stagnation, "no step lowers χ² any more"
            break
        trial = x + scale * np.asarray(step)
    assert here is not None
    return Minimum(
        x=x,
        expansion=here,
        result=result,  # pyright: ignore[reportArgumentType]
        message=_in_words(result, why, len(history), distance, condition),  # pyright: ignore[reportArgumentType]
        steps=len(history),
        scaled_gradient=distance,
        condition=condition,
        history=tuple(history),
    )


def _in_words(result: optx.RESULTS, why: str, steps: int, distance: float, condition: float) -> str:
    if bool(result == RESULTS.successful):
        return f"converged: scaled gradient {distance:.1e}"
    if bool(result == RESULTS.conlim):
        return f"parameters cannot be distinguished: condition number {condition:.1e}"
    if bool(result == RESULTS.stagnation):
        return f"{why}, scaled gradient {distance:.1e}"
    if bool(result == RESULTS.nonfinite):
        return "the model is not finite at the start values"
    return f"not converged after {steps} steps, scaled gradient {distance:.1e}"


def distance_to_minimum(expansion: Expansion) -> tuple[float, float]:
    """‖(JᵀJ)^(−½) Jᵀr‖ in scaled parameters, and the condition number of JᵀJ with a diagonal of ones.

    How well each parameter is known by itself is no matter of telling them apart: the best scaling is by that, up to
    the number of parameters (van der Sluis 1969, Numerische Mathematik 14, 14).
    """
    matrix, gradient = expansion.matrix, expansion.gradient
    if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
        return np.inf, np.inf
    # In units of what each is known to: in others a parameter that the data hardly see would fall below the rounding.
    size = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    seen = size > 0
    if not seen.any():
        return 0.0, np.inf if len(gradient) else 1.0
    unit = size[seen]
    value, vector = np.linalg.eigh(matrix[np.ix_(seen, seen)] / np.outer(unit, unit))
    condition = float(value[-1] / value[0]) if seen.all() and value[0] > 0 else np.inf
    positive = value > value[-1] * 1e-15
    along = vector.T @ (gradient[seen] / unit)
    return float(np.sqrt(np.sum(along[positive] ** 2 / value[positive]))), condition


_REGION = optx.ClassicalTrustRegion(high_cutoff=WELL_PREDICTED)


def _after(
    first: Any, y: Any, trial: Any, here: _Information, there: _Information, region: Any
) -> tuple[Array, Array, Any, Array]:
    """Size of the trust region, whether the trial is accepted, the state of the region, and the next step."""
    size, accept, _, region = _REGION.step(first, y, trial, here.of_function(), there.of_function(), region)
    accept = accept | (there.objective - here.objective <= ROUNDING * jnp.abs(here.objective))
    # From no damping at all the first retreat is to λ = 1.
    size = jnp.where(accept | jnp.isfinite(size), size, 1.0)
    best = jax.tree.map(lambda new, old: jnp.where(accept, new, old), there, here).of_function()
    descent = optx.DampedNewtonDescent(linear_solver=lx.Cholesky())
    step = descent.step(size, descent.query(best.grad, best, descent.init(best.grad, best)))[0]
    return size, accept, eqx.tree_at(lambda s: s.step_size, region, size), step


# Compiled as a whole: operation by operation it would cost a tenth of a second at the first step.
_next = compiled(_after, kept_as="step")

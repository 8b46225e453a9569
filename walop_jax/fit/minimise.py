"""The search for a minimum on the host: the solver's steps, one after the other, in the units of each parameter."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import optimistix as optx
from jaxtyping import Float

from walop_jax.fit.solver import (
    LARGEST_CONDITION,
    RESULTS,
    AtEveryStep,
    Evaluate,
    Expansion,
    MatrixPolicy,
    NormalEquationsSolver,
    Request,
    TrustRegion,
    distance_to_minimum,
)

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

MAXIMUM_STEPS = 200
"""Along a curved valley that only a prior closes (throughput and flux) there may be more than a hundred."""
TOLERANCE = 1e-4


@dataclasses.dataclass(frozen=True)
class Minimum:
    """Where the search ended: `x` in the units it was given, the expansion there and the gates.

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
        """Whether the minimum was reached and is well conditioned."""
        return bool(self.result == RESULTS.successful)


@dataclasses.dataclass(frozen=True)
class _Scaled:
    """An expansion with the parameters in their units, and as it was given."""

    given: Expansion
    objective: float
    gradient: Vector
    matrix: Matrix

    @classmethod
    def of(cls, given: Expansion, scale: Vector) -> _Scaled:
        return cls(given, given.objective, given.gradient * scale, given.matrix * np.outer(scale, scale))


def minimise(
    evaluate: Evaluate,
    start: Vector,
    scale: Vector,
    *,
    matrix: MatrixPolicy | None = None,
    damping: float = 1.0,
    maximum_steps: int = MAXIMUM_STEPS,
    tolerance: float = TOLERANCE,
    progress: Callable[[int, float], None] | None = None,
) -> Minimum:
    """Minimise a sum of squares from `start`; `scale` is the unit of each parameter.

    `evaluate(x, request)` gives the objective and its expansion at x. `matrix` says when its matrix is computed
    (default: at every step), `damping` is the first λ: 0 means Newton steps, for a start near the minimum.
    `progress(step, objective)` is called after every step. Never raises for a numerical outcome: the gates, `result`
    and `message` say what happened.
    """
    origin = np.asarray(start, float)

    def function(y: Vector, request: Request) -> tuple[float, _Scaled]:
        near = None if request.near is None else request.near.given
        found = evaluate(origin + y * scale, Request(near, request.matrix))
        return 0.5 * found.objective, _Scaled.of(found, scale)

    region = TrustRegion(1.0 / damping if damping > 0 else np.inf)
    solver = NormalEquationsSolver(atol=tolerance, matrix=matrix or AtEveryStep(), search=region)
    y, history, tags = np.zeros(len(origin)), [], frozenset[object]()
    state = solver.init(function, y, None, {}, None, None, tags)
    stop, result = solver.terminate(function, y, None, {}, state, tags)
    while not stop and len(history) < maximum_steps:
        y, state, expansion = solver.step(function, y, None, {}, state, tags)
        history.append(state.looked_at)
        if progress is not None:
            progress(len(history), expansion.objective)
        stop, result = solver.terminate(function, y, None, {}, state, tags)
    if not stop:
        result = RESULTS.nonlinear_max_steps_reached
    y, expansion, gates = solver.postprocess(function, y, state.expansion, None, {}, state, tags, result)
    assert isinstance(expansion, _Scaled)
    return Minimum(
        x=origin + y * scale,
        expansion=expansion.given,
        result=result,
        message=_in_words(result, len(history), **gates),
        steps=len(history),
        scaled_gradient=gates["distance"],
        condition=gates["condition"],
        history=tuple(history),
    )


def newton(
    evaluate: Callable[[Vector], Expansion],
    start: Vector,
    scale: Vector,
    *,
    tolerance: float = TOLERANCE,
    progress: Callable[[int, float], None] | None = None,
) -> Minimum | None:
    """Newton steps from a start near the minimum, for objectives that take long: no place is looked at without need.

    The last step is taken without looking where it leads if what it leaves, by how much the one before it left, is less
    than `tolerance`: `scaled_gradient` is then what is expected, the expansion that of the place before. None where the
    steps do not close in on a minimum.
    """
    x, before, history = np.asarray(start, float), np.inf, []
    while len(history) < MAXIMUM_STEPS:
        found = evaluate(x)
        scaled = _Scaled.of(found, scale)
        distance, condition = distance_to_minimum(scaled)
        history.append(found.objective)
        if progress is not None:
            progress(len(history), found.objective)
        if not distance < before or not condition < LARGEST_CONDITION:
            return None
        left = distance * distance / before  # 0 at the first place, where nothing is known of it
        if distance > tolerance:
            x = x - scale * np.linalg.solve(scaled.matrix, scaled.gradient)
        if distance <= tolerance or 0.0 < left <= tolerance:
            gate = min(distance, left) if left > 0.0 else distance
            message = _in_words(RESULTS.successful, len(history), gate, condition)
            return Minimum(
                x, found, RESULTS.successful, message, len(history), gate, condition, tuple(history)
            )
        before = distance
    return None


def _in_words(result: optx.RESULTS, steps: int, distance: float, condition: float) -> str:
    if bool(result == RESULTS.successful):
        return f"converged: scaled gradient {distance:.1e}"
    if bool(result == RESULTS.conlim):
        return f"parameters cannot be told apart: condition number {condition:.1e}"
    if bool(result == RESULTS.stagnation):
        return f"no step lowers χ² any more, scaled gradient {distance:.1e}"
    if bool(result == RESULTS.nonfinite):
        return "the model is not finite at the start values"
    return f"not converged after {steps} steps, scaled gradient {distance:.1e}"

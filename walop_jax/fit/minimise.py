"""Levenberg–Marquardt on normal equations: one minimiser for ten intensities or 10⁹.

A pass over the data hands over χ², Jᵀr and JᵀJ, so that residuals are neither seen nor stored here.

Step        δ = −(JᵀJ + λ)⁻¹ Jᵀr in parameters scaled to their prior width. λ falls by `WIDER` after a step that was
            predicted well, and rises by `NARROWER` after one that was not, which is taken back. A start that may be far
            away begins with λ = 1; one near the minimum with λ = 0, the Newton step, until a step leads upwards.
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
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy import linalg

SOURCE = "Moré 1978, Lecture Notes in Mathematics 630, 105; Conn, Gould & Toint 2000, Trust Region Methods"

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

MAXIMUM_STEPS = 200
"""Along a curved valley that only a prior closes (throughput and flux) there may be more than a hundred."""
TOLERANCE = 1e-4
ROUGH, CLOSING_IN = 0.1, 3.0
PATIENCE, LEAST_GAIN = 6, 1e-3
# Sums of many terms are good to some 10⁻¹⁵ of the largest eigenvalue: the smallest is then known to ten per cent.
LARGEST_CONDITION = 1e14
ROUNDING = 1e-12  # of an objective: near the end two of them differ by less
SMALLEST_REGION = 1e-14  # 1/λ
WIDER, NARROWER = 3.5, 0.25  # factors on 1/λ
# Shares of the predicted reduction: below the first a step is taken back, above the second λ falls. With 0.99 a problem
# that is a little curved keeps its λ and with it a slow end: directions that the data hardly see then take forty steps.
TAKEN, WELL_PREDICTED = 0.01, 0.75


@runtime_checkable
class Expansion(Protocol):
    """What is minimised, and half its gradient and Hessian, at one place."""

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
    """Where the search ended: `x` in the units it was given, the expansion there and the gates.

    `converged` says whether the minimum was reached and is well conditioned, `message` how the search ended. `steps`
    counts the places looked at, `history` holds their objectives.
    """

    x: Vector
    expansion: Expansion
    converged: bool
    message: str
    scaled_gradient: float
    condition: float
    history: tuple[float, ...]

    @property
    def steps(self) -> int:
        """Number of places looked at."""
        return len(self.history)


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
    for a numerical outcome: the gates and `message` say what happened.
    """
    x = np.asarray(start, float)
    here = evaluate(x)
    history, best = [here.objective], [here.objective]
    before, (distance, condition) = np.inf, distance_to_minimum(here, scale)
    region, taken = 1.0 / damping if damping > 0 else np.inf, True
    message, converged = "", False
    while True:
        if progress is not None:
            progress(len(history), here)
        step, region = _step(here, scale, region)
        hopeless = far_off(here)
        left = distance**2 / before if taken and not look_at_end and np.isinf(region) else np.inf
        rough = hopeless and distance < ROUGH and distance * CLOSING_IN > before
        if not np.isfinite(history[0]):
            message = "the model is not finite at the start values"
        elif distance < tolerance or 0.0 < left < tolerance or rough:
            if distance >= tolerance and 0.0 < left < tolerance:
                x, distance = x + step, left
            converged = condition <= LARGEST_CONDITION
            message = (
                f"converged: scaled gradient {distance:.1e}"
                if converged
                else f"parameters cannot be told apart: condition number {condition:.1e}"
            )
        elif hopeless and len(best) > PATIENCE and best[-1] > (1.0 - LEAST_GAIN) * best[-1 - PATIENCE]:
            gain = f"{PATIENCE} more steps lowered χ² by less than {LEAST_GAIN:.1%}"
            message = f"{gain}, scaled gradient {distance:.1e}"
        elif region < SMALLEST_REGION:
            message = f"no step lowers χ² any more, scaled gradient {distance:.1e}"
        elif len(history) >= maximum_steps:
            message = f"not converged after {len(history)} steps, scaled gradient {distance:.1e}"
        if message:
            return Minimum(x, here, converged, message, distance, condition, tuple(history))
        there = evaluate(x + step)
        history.append(there.objective)
        gained = 0.5 * (there.objective - here.objective) if np.isfinite(there.objective) else np.inf
        predicted = step @ (here.gradient + 0.5 * here.matrix @ step)
        wanted = gained <= TAKEN * predicted
        if not wanted:
            region *= NARROWER
        elif gained < WELL_PREDICTED * predicted < 0.0:
            region *= WIDER
        taken = wanted or gained <= 0.5 * ROUNDING * abs(here.objective)
        if taken:
            x, here, before = x + step, there, distance
            distance, condition = distance_to_minimum(here, scale)
        elif np.isinf(region):
            region = 1.0
        best.append(here.objective)


def _step(here: Expansion, scale: Vector, region: float) -> tuple[Vector, float]:
    """The damped Newton step, and the 1/λ with which the matrix is positive definite."""
    matrix, gradient = here.matrix * np.outer(scale, scale), here.gradient * scale
    while region >= SMALLEST_REGION and np.isfinite(matrix).all() and np.isfinite(gradient).all():
        try:
            factor = linalg.cho_factor(matrix + np.eye(len(matrix)) / region, lower=True)
            return -scale * linalg.cho_solve(factor, gradient), region
        except linalg.LinAlgError:
            region = NARROWER * region if np.isfinite(region) else 1.0
    return np.zeros(len(scale)), 0.0


def distance_to_minimum(expansion: Expansion, scale: Vector | float = 1.0) -> tuple[float, float]:
    """‖(JᵀJ)^(−½) Jᵀr‖ in parameters in units of `scale`, and the condition number of JᵀJ with a diagonal of ones.

    How well each parameter is known by itself is no matter of telling them apart: the best scaling is by that, up to
    the number of parameters (van der Sluis 1969, Numerische Mathematik 14, 14).
    """
    gradient = expansion.gradient * scale
    matrix = expansion.matrix * np.outer(scale, scale)
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

"""Levenberg–Marquardt on normal equations, with optimistix' descent and trust region, and gates of our own.

The engine hands over χ², Jᵀr and JᵀJ, so the loop neither sees nor stores residuals: 10⁴ or 10⁹ of them cost it
the same. It runs on the host, one expansion per step, in parameters scaled to their prior width; λ starts at 1 and
follows optimistix' classical trust region.

Stop        scaled gradient ‖(JᵀJ)^(−½) Jᵀr‖ < `tolerance`: the distance to the minimum in units of the standard
            error. A solver's own "success" is not asked: it can be wrong on data that are not whitened, on NaN, or on
            a step of size zero.
Source      Moré 1978, Lecture Notes in Mathematics 630, 105 (method); Conn, Gould & Toint 2000 (trust region).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from walop_jax.model.compiled import compiled

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

MAXIMUM_STEPS = 60
TOLERANCE = 1e-4
# Sums of many terms are good to some 10⁻¹⁵ of the largest eigenvalue: the smallest is then known to ten per cent.
LARGEST_CONDITION = 1e14
STALE = 0.05  # of the distance left by a step
_SEARCH = optx.ClassicalTrustRegion()
_DESCENT = optx.DampedNewtonDescent(linear_solver=lx.Cholesky())


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
    """Where the search ended: `x` in the units it was given, the expansion there and the gates."""

    x: Vector
    expansion: Expansion
    converged: bool
    message: str
    steps: int
    scaled_gradient: float
    condition: float
    history: tuple[float, ...]


def _information(
    objective: Float[Array, ""], gradient: Float[Array, " n"], matrix: Float[Array, "n n"]
) -> Any:
    return optx.FunctionInfo.EvalGradHessian(
        objective, gradient, lx.MatrixLinearOperator(matrix, lx.positive_semidefinite_tag)
    )


def _propose(
    step_size: Float[Array, ""],
    objective: Float[Array, ""],
    gradient: Float[Array, " n"],
    matrix: Float[Array, "n n"],
) -> Float[Array, " n"]:
    info = _information(objective, gradient, matrix)
    state = _DESCENT.query(gradient, info, _DESCENT.init(gradient, info))
    step, _ = _DESCENT.step(step_size, state)
    return step


_propose_step = compiled(_propose)


def scaled_gradient(expansion: Expansion, scale: Vector) -> tuple[float, float]:
    """‖(JᵀJ)^(−½) Jᵀr‖ and the condition number of JᵀJ, both in scaled parameters."""
    if len(scale) == 0:
        return 0.0, 1.0
    matrix = expansion.matrix * np.outer(scale, scale)
    gradient = expansion.gradient * scale
    if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
        return np.inf, np.inf
    value, vector = np.linalg.eigh(matrix)
    condition = float(value[-1] / value[0]) if value[0] > 0 else np.inf
    positive = value > value[-1] * 1e-15
    along = vector.T @ gradient
    return float(np.sqrt(np.sum(along[positive] ** 2 / value[positive]))), condition


def minimise(
    expand: Callable[[Vector], Expansion],
    start: Vector,
    scale: Vector,
    *,
    maximum_steps: int = MAXIMUM_STEPS,
    tolerance: float = TOLERANCE,
    progress: Callable[[int, float], None] | None = None,
) -> Minimum:
    """Minimise a sum of squares from `start`; `scale` is the unit of each parameter.

    `expand(x)` gives the objective and its expansion at x. `progress(step, objective)` is called after every
    expansion. Never raises for a numerical outcome: the gates and `message` say what happened.
    """
    here, expansion = np.asarray(start, float), expand(np.asarray(start, float))
    history = [expansion.objective]
    if not np.isfinite(expansion.objective):
        return Minimum(
            here,
            expansion,
            False,
            "the model is not finite at the start values",
            0,
            np.inf,
            np.inf,
            (np.nan,),
        )
    state = _SEARCH.init(jnp.zeros_like(jnp.asarray(here)), _arrays(expansion, scale))
    there, trial, first = here, expansion, True
    decrement, condition = scaled_gradient(expansion, scale)
    message, steps = "stopped before the first step", 0
    for steps in range(1, maximum_steps + 1):
        step_size, accept, _, state = _SEARCH.step(
            jnp.asarray(first),
            jnp.asarray(here / scale),
            jnp.asarray(there / scale),
            _arrays(expansion, scale),
            _arrays(trial, scale),
            state,
        )
        if bool(accept):
            here, expansion = there, trial
            decrement, condition = scaled_gradient(expansion, scale)
            if decrement < tolerance:
                message = f"converged: scaled gradient {decrement:.1e}"
                break
        if float(step_size) < 1e-14:
            message = f"no step lowers χ² any more, scaled gradient {decrement:.1e}"
            break
        first = False
        half = 0.5 * expansion.objective
        proposal = _propose_step(
            step_size,
            jnp.asarray(half),
            jnp.asarray(expansion.gradient * scale),
            jnp.asarray(expansion.matrix * np.outer(scale, scale)),
        )
        there = here + np.asarray(proposal) * scale
        trial = expand(there)
        history.append(trial.objective)
        if progress is not None:
            progress(steps, min(trial.objective, expansion.objective))
    else:
        message = f"not converged after {maximum_steps} steps, scaled gradient {decrement:.1e}"
    converged = bool(decrement < tolerance and np.isfinite(expansion.objective))
    if converged and condition > LARGEST_CONDITION:
        converged, message = False, f"parameters cannot be told apart: condition number {condition:.1e}"
    return Minimum(here, expansion, converged, message, steps, decrement, condition, tuple(history))


def polish(
    expand: Callable[[Vector], Expansion],
    slope: Callable[[Vector, Expansion], Expansion],
    start: Vector,
    scale: Vector,
    *,
    maximum_steps: int = MAXIMUM_STEPS,
    tolerance: float = TOLERANCE,
    progress: Callable[[int, float], None] | None = None,
) -> Minimum:
    """Newton steps from near the minimum, with a matrix that is computed anew only when it no longer serves.

    `slope(x, near)` is an expansion at x with the matrix of `near`, at a fraction of the cost of `expand(x)`. A step
    leaves as much of the distance as the matrix changes on the way there, relatively; where more than `STALE` is left,
    the matrix is stale. Where a step leads upwards, `minimise` takes over. Never raises for a numerical outcome.
    """
    here = np.asarray(start, float)
    expansion = expand(here)
    history = [expansion.objective]
    decrement, condition = scaled_gradient(expansion, scale)
    first, steps, message = decrement, 0, ""
    while decrement >= tolerance and np.isfinite(decrement) and steps < maximum_steps:
        steps += 1
        there = here + _newton_step(expansion, scale)
        trial = slope(there, expansion)
        history.append(trial.objective)
        # Near the end two objectives differ by less than their rounding.
        if not trial.objective <= expansion.objective * (1.0 + 1e-12):
            return minimise(expand, here, scale, tolerance=tolerance, progress=progress)
        left, condition = scaled_gradient(trial, scale)
        stale = left > max(STALE * decrement, tolerance)
        here, expansion, decrement = there, expand(there) if stale else trial, left
        if progress is not None:
            progress(steps, expansion.objective)
    converged = decrement < tolerance and condition <= LARGEST_CONDITION
    message = f"converged: scaled gradient {decrement:.1e}, at first {first:.1e}"
    if not converged:
        message = f"not converged: scaled gradient {decrement:.1e}, condition number {condition:.1e}"
    return Minimum(here, expansion, bool(converged), message, steps, decrement, condition, tuple(history))


def _newton_step(expansion: Expansion, scale: Vector) -> Vector:
    matrix, gradient = expansion.matrix * np.outer(scale, scale), expansion.gradient * scale
    value, vector = np.linalg.eigh(matrix)
    known = value > value[-1] * 1e-15
    return -scale * (vector[:, known] @ ((vector.T @ gradient)[known] / value[known]))


def _arrays(expansion: Expansion, scale: Vector) -> Any:
    objective = expansion.objective if np.isfinite(expansion.objective) else np.inf
    return _information(
        jnp.asarray(0.5 * objective),
        jnp.asarray(expansion.gradient * scale),
        jnp.asarray(expansion.matrix * np.outer(scale, scale)),
    )

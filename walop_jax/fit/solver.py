"""Levenberg–Marquardt on normal equations: a minimiser of optimistix' family whose function is a pass over the data.

The engine hands over χ², Jᵀr and JᵀJ, so the solver neither sees nor stores residuals: 10⁴ or 10⁹ of them cost it
the same. It runs on the host, since the function reads files, in parameters scaled to their prior width.

Step        (JᵀJ + λ)⁻¹ Jᵀr with λ following optimistix' classical trust region from `damping` on. A start that may be
            far away takes λ = 1; one near the minimum λ = 0, the Newton step, until a step leads upwards.
Matrix      is most of the work of a pass. A policy says when it is computed: `AtEveryStep`, or `WhenStale`: a step
            leaves as much of the distance as the matrix changes on the way there, relatively; where more than a share
            of it is left, or a step led upwards, the matrix serves no more.
Stop        scaled gradient ‖(JᵀJ)^(−½) Jᵀr‖ < `atol`: the distance to the minimum in units of the standard
            error. A solver's own "success" is not asked: it can be wrong on data that are not whitened, on NaN, or on
            a step of size zero.
Source      `SOURCE`: the method and its trust region.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from walop_jax.model.compiled import compiled

SOURCE = "Moré 1978, Lecture Notes in Mathematics 630, 105; Conn, Gould & Toint 2000, Trust Region Methods"

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]
RESULTS = optx.RESULTS

# Sums of many terms are good to some 10⁻¹⁵ of the largest eigenvalue: the smallest is then known to ten per cent.
LARGEST_CONDITION = 1e14
ROUNDING = 1e-12  # of an objective: near the end two of them differ by less
STALE = 0.05  # of the distance left by a step
SMALLEST_STEP = 1e-14  # of the trust region
# Share of the predicted reduction above which λ falls. With 0.99 a problem that is a little curved keeps its λ and with
# it a slow end: directions that the data hardly see then take forty steps.
WELL_PREDICTED = 0.75


# --------------------------------------------------------------------------------------- what is minimised


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


class Request(NamedTuple):
    """What is asked for at a place: with `matrix` all of the expansion, without it the matrix of `near` will do.

    `near` is the last expansion that a step was taken from, None at the start.
    """

    near: Any
    matrix: bool


Evaluate = Callable[[Vector, Request], Expansion]


# ------------------------------------------------------------------------------- when the matrix is computed


@runtime_checkable
class MatrixPolicy(Protocol):
    """When the matrix is computed anew."""

    @property
    def at_trials(self) -> bool:
        """Whether it is computed wherever a step leads, before it is known to be accepted."""
        ...

    def stale(self, before: float, left: float) -> bool:
        """Whether it serves no more after a step that left `left` of a distance to the minimum of `before`."""
        ...


@dataclasses.dataclass(frozen=True)
class AtEveryStep:
    """At every step: the fewest steps."""

    at_trials: bool = True

    def stale(self, before: float, left: float) -> bool:
        """Never: it is new."""
        return False


@dataclasses.dataclass(frozen=True)
class WhenStale:
    """When a step has left more than a share of the distance: the fewest matrices."""

    share: float = STALE
    at_trials: bool = False

    def stale(self, before: float, left: float) -> bool:
        """Whether too much is left."""
        return left > self.share * before


# ------------------------------------------------------------------------------------------------ the solver


class TrustRegion(optx.AbstractSearch):
    """optimistix' classical trust region with any first step size (1/λ), for objectives that are rounded."""

    first: float
    region: optx.ClassicalTrustRegion = eqx.field(
        default_factory=lambda: optx.ClassicalTrustRegion(high_cutoff=WELL_PREDICTED)
    )

    def init(self, y: Any, f_info_struct: Any) -> Any:
        """The region before the first step."""
        state = self.region.init(y, f_info_struct)
        return eqx.tree_at(lambda s: s.step_size, state, jnp.asarray(self.first))

    def step(
        self, first_step: Any, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, state: Any
    ) -> tuple[Array, Bool[Array, ""], optx.RESULTS, Any]:
        """Step size, whether the last step is accepted, and the region after it."""
        size, accept, result, state = self.region.step(first_step, y, y_eval, f_info, f_eval_info, state)
        here, there = f_info.as_min(), f_eval_info.as_min()
        accept = accept | (there - here <= ROUNDING * jnp.abs(here))
        # From no damping at all the first retreat is to λ = 1.
        size = jnp.where(accept | jnp.isfinite(size), size, 1.0)
        return size, accept, result, eqx.tree_at(lambda s: s.step_size, state, size)


class _State(NamedTuple):
    """Between two steps: the expansion at the best place so far, and the next place to look at."""

    first: bool
    trial: Vector
    looked_at: float  # objective of the last one
    expansion: Any
    own_matrix: bool  # whether the matrix of the expansion was computed there
    every_matrix: bool  # whether all further ones are
    region: Any
    distance: float
    condition: float
    terminate: bool
    result: optx.RESULTS


class NormalEquationsSolver(optx.AbstractMinimiser[Vector, Expansion, _State]):
    """Minimises what is known by its value, gradient and Gauss–Newton matrix, driven step by step by `minimise`.

    The function is `fn(y, request) -> (value, expansion)`; `atol` is the distance to the minimum (standard errors)
    at which to stop. `rtol` and `norm` are part of the interface and play no role.
    """

    atol: float
    matrix: MatrixPolicy
    search: TrustRegion
    rtol: float = 0.0
    norm: Callable[[Any], Any] = optx.two_norm

    def init(
        self, fn: Any, y: Vector, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _State:
        """Nothing is known yet: the first step looks at `y` itself."""
        region = self.search.init(jnp.zeros(len(y)), None)
        return _State(
            first=True, trial=y, looked_at=np.nan, expansion=None, own_matrix=True,
            every_matrix=self.matrix.at_trials, region=region, distance=np.inf, condition=np.inf,
            terminate=False, result=RESULTS.successful,
        )  # fmt: skip

    def step(
        self, fn: Any, y: Vector, args: Any, options: Any, state: _State, tags: Any
    ) -> tuple[Vector, _State, Expansion]:
        """Look at the trial place, go there if it is better, and choose the next one."""
        with_matrix = state.first or state.every_matrix
        _, trial = fn(state.trial, Request(state.expansion, with_matrix))
        state = state._replace(looked_at=trial.objective)
        if state.first and not np.isfinite(trial.objective):
            return y, state._replace(expansion=trial, terminate=True, result=RESULTS.nonfinite), trial
        here = trial if state.expansion is None else state.expansion
        size, accept, region = _next_region(
            self.search, state.first, y, state.trial, _information(here), _information(trial), state.region
        )
        state = state._replace(first=False, region=region, expansion=here)
        if bool(accept):
            state, y = self._moved(fn, state, trial, with_matrix), state.trial
        elif not with_matrix:
            # A matrix that leads upwards serves no more.
            if not state.own_matrix:
                _, here = fn(y, Request(here, True))
            state = state._replace(expansion=here, own_matrix=True, every_matrix=True)
        if not state.terminate:
            if float(size) < SMALLEST_STEP:
                state = state._replace(terminate=True, result=RESULTS.stagnation)
            else:
                step = _next_step(size, _information(state.expansion))
                state = state._replace(trial=y + np.asarray(step))
        return y, state, state.expansion

    def _moved(self, fn: Any, state: _State, trial: Expansion, with_matrix: bool) -> _State:
        """The state after a step that was accepted."""
        distance, condition = distance_to_minimum(trial)
        if not with_matrix and distance >= self.atol and self.matrix.stale(state.distance, distance):
            _, trial = fn(state.trial, Request(trial, True))
            with_matrix, (distance, condition) = True, distance_to_minimum(trial)
        done = distance < self.atol
        return state._replace(
            expansion=trial,
            own_matrix=with_matrix,
            distance=distance,
            condition=condition,
            terminate=done,
            result=RESULTS.conlim if done and condition > LARGEST_CONDITION else RESULTS.successful,
        )

    def terminate(
        self, fn: Any, y: Vector, args: Any, options: Any, state: _State, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether to stop, and what came of it."""
        return jnp.asarray(state.terminate), state.result

    def postprocess(
        self,
        fn: Any,
        y: Vector,
        aux: Expansion,
        args: Any,
        options: Any,
        state: _State,
        tags: Any,
        result: Any,
    ) -> tuple[Vector, Expansion, dict[str, Any]]:
        """The place, its expansion, and the gates."""
        return y, aux, {"distance": state.distance, "condition": state.condition}


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


class _Information(NamedTuple):
    """An expansion as compiled code takes it."""

    objective: Any
    gradient: Any
    matrix: Any

    def of_function(self) -> Any:
        """The same as optimistix takes it, whose objective is half of the sum of squares."""
        operator = lx.MatrixLinearOperator(self.matrix, lx.positive_semidefinite_tag)
        return optx.FunctionInfo.EvalGradHessian(0.5 * self.objective, self.gradient, operator)


def _information(expansion: Expansion) -> _Information:
    objective = expansion.objective if np.isfinite(expansion.objective) else np.inf
    return _Information(objective, expansion.gradient, expansion.matrix)


def _region(
    search: TrustRegion, first: Any, y: Any, trial: Any, here: _Information, there: _Information, state: Any
) -> tuple[Array, Array, Any]:
    size, accept, _, state = search.step(first, y, trial, here.of_function(), there.of_function(), state)
    return size, accept, state


def _step(size: Any, here: _Information) -> Float[Array, " n"]:
    info, descent = here.of_function(), optx.DampedNewtonDescent(linear_solver=lx.Cholesky())
    state = descent.query(info.grad, info, descent.init(info.grad, info))
    return descent.step(size, state)[0]


# Compiled as a whole: operation by operation they would cost a tenth of a second at the first step.
_next_region, _next_step = compiled(_region, kept_as="region"), compiled(_step, kept_as="step")

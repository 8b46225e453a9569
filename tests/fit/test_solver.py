"""The solver on functions whose minimum is known, with its matrix computed at every step and when it is stale."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from walop_jax.fit.minimise import minimise
from walop_jax.fit.solver import (
    WELL_PREDICTED,
    AtEveryStep,
    NormalEquationsSolver,
    TrustRegion,
    WhenStale,
    distance_to_minimum,
)

RESULTS = optx.RESULTS


@dataclasses.dataclass(frozen=True)
class Expansion:
    objective: float
    gradient: np.ndarray
    matrix: np.ndarray


class Squares:
    """A sum of squares of residuals with a known Jacobian, counting what is asked of it."""

    def __init__(self, residuals, jacobian):
        self.residuals, self.jacobian = residuals, jacobian
        self.full = self.cheap = 0

    def __call__(self, x, request):
        self.full += request.matrix
        self.cheap += not request.matrix
        r, j = self.residuals(x), self.jacobian(x)
        return Expansion(float(r @ r), j.T @ r, j.T @ j if request.matrix else request.near.matrix)


def rosenbrock():
    """Rosenbrock 1960: minimum 0 at (1, 1)."""
    return Squares(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
    )


def exponential():
    """exp(x) = 3 at x = log 3."""
    return Squares(lambda x: np.exp(x) - 3.0, lambda x: np.diag(np.exp(x)))


def from_nearby(squares, start, scale=None, **options):
    scale = np.ones(len(start)) if scale is None else scale
    return minimise(squares, np.asarray(start), scale, matrix=WhenStale(), damping=0.0, **options)


# ------------------------------------------------------------------------------ the matrix when it is stale


def test_near_the_minimum_the_matrix_is_computed_once():
    squares = rosenbrock()
    found = from_nearby(squares, [1.001, 1.001], tolerance=1e-6)
    assert found.converged
    np.testing.assert_allclose(found.x, 1.0, atol=1e-6)
    assert squares.full == 1
    assert squares.cheap <= 3


def test_a_linear_problem_takes_one_step():
    design = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    y = np.array([1.0, 2.0, 4.0])
    squares = Squares(lambda x: y - design @ x, lambda _: -design)
    found = from_nearby(squares, [50.0, -30.0], np.array([10.0, 0.1]))
    # The straight line through (0, 1), (1, 2), (2, 4) by hand: 5/6 + 3/2 t.
    np.testing.assert_allclose(found.x, [5 / 6, 1.5], rtol=1e-12)
    assert (found.steps, squares.full, squares.cheap) == (2, 1, 1)


def test_a_matrix_that_no_longer_serves_is_computed_anew():
    # From afar each step changes the slope by much.
    squares = exponential()
    found = from_nearby(squares, [1.6], tolerance=1e-9)
    assert found.converged
    assert 1 < squares.full < found.steps + 1
    assert found.x[0] == pytest.approx(np.log(3.0), abs=1e-9)


def test_after_a_step_upwards_steps_are_damped_and_matrices_new():
    # Far below log 3 the Newton step overshoots by far: to −3 + (3 − e⁻³) e³, where the objective is exp(113).
    squares, seen = exponential(), []
    found = from_nearby(squares, [-3.0], tolerance=1e-9, progress=lambda step, value: seen.append(value))
    assert found.converged
    assert found.x[0] == pytest.approx(np.log(3.0), abs=1e-8)
    assert found.history[1] > 1e20
    assert squares.cheap == 1
    assert seen == sorted(seen, reverse=True)


def test_a_better_place_of_a_stale_matrix_gets_its_own_before_it_is_damped():
    """A step with a kept matrix is accepted, the next one leads upwards: then the matrix is that of the place."""
    # r = arctan(x): the Newton step of the true slope oscillates and diverges beyond |x| = 1.39 (Dennis & Schnabel).
    asked = []

    def evaluate(x, request):
        asked.append((float(x[0]), request.matrix))
        r, slope = np.arctan(x), 1.0 / (1.0 + x**2)
        return Expansion(
            float(r @ r), slope * r, np.diag(slope**2) if request.matrix else request.near.matrix
        )

    found = minimise(
        evaluate, np.array([1.3]), np.ones(1), matrix=WhenStale(share=np.inf), damping=0.0, tolerance=1e-9
    )
    assert found.converged
    assert abs(found.x[0]) < 1e-8
    upwards = next(i for i, (_, matrix) in enumerate(asked) if matrix and i > 0)
    places = [x for x, _ in asked[:upwards]]
    assert asked[upwards][0] in places


# ------------------------------------------------------------------------- what holds whenever it is computed


@pytest.mark.parametrize("policy", [AtEveryStep(), WhenStale()])
def test_rosenbrock_from_the_usual_start(policy):
    found = minimise(rosenbrock(), np.array([-1.2, 1.0]), np.ones(2), matrix=policy, tolerance=1e-8)
    assert found.converged
    np.testing.assert_allclose(found.x, 1.0, atol=1e-7)


def test_a_curved_valley_that_a_prior_closes_is_gone_along():
    """Of flux × throughput only the product is seen: steps close in by a tenth each, and there must be enough of them.

    By symmetry both end at the root of k² x (x² − 1) + (x − m) = 0.
    """
    k, m = 30.0, 1.9
    valley = Squares(
        lambda x: np.array([k * (x[0] * x[1] - 1.0), x[0] - m, x[1] - m]),
        lambda x: np.array([[k * x[1], k * x[0]], [1.0, 0.0], [0.0, 1.0]]),
    )
    (root,) = (z.real for z in np.roots([k**2, 0.0, 1.0 - k**2, -m]) if z.real > 0.5)
    found = minimise(valley, np.array([2.0, 0.5]), np.ones(2), tolerance=1e-8)
    assert found.converged
    np.testing.assert_allclose(found.x, root, atol=1e-7)


def test_the_steps_are_those_of_optimistix():
    """Its Levenberg–Marquardt on the residuals themselves, with the same region, for as many steps: the same place."""

    def residuals(x, _):
        return jnp.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    region = optx.ClassicalTrustRegion(high_cutoff=WELL_PREDICTED)
    solver = eqx.tree_at(lambda s: s.search, optx.LevenbergMarquardt(rtol=0.0, atol=0.0), region)
    start = np.array([-1.2, 1.0])
    for steps in (2, 5, 9):
        ours = minimise(rosenbrock(), start, np.ones(2), maximum_steps=steps)
        theirs = optx.least_squares(
            residuals,
            solver,
            jnp.asarray(start),
            max_steps=steps,
            throw=False,
        )
        assert bool(ours.result == theirs.result)
        assert bool(ours.result == RESULTS.nonlinear_max_steps_reached)
        np.testing.assert_allclose(ours.x, theirs.value, rtol=1e-10)


def test_the_solver_is_one_of_optimistix():
    solver = NormalEquationsSolver(atol=1e-4, matrix=AtEveryStep(), search=TrustRegion(1.0))
    assert isinstance(solver, optx.AbstractMinimiser)


@pytest.mark.parametrize("policy", [AtEveryStep(), WhenStale()])
def test_numbers_that_are_not_finite_never_pass(policy):
    squares = Squares(lambda x: x * np.nan, np.diag)
    found = minimise(squares, np.ones(2), np.ones(2), matrix=policy)
    assert not found.converged
    assert bool(found.result == RESULTS.nonfinite)


@pytest.mark.parametrize("damping", [1.0, 0.0])
def test_parameters_that_cannot_be_told_apart_never_pass(damping):
    design = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-8]])
    squares = Squares(lambda x: design @ x - 1.0, lambda _: design)
    found = minimise(squares, np.zeros(2), np.ones(2), matrix=WhenStale(), damping=damping)
    assert not found.converged
    assert bool(found.result == RESULTS.conlim)
    assert "condition number" in found.message


def test_a_function_that_cannot_be_lowered_is_given_up():
    """Its gradient is that of another function: no step leads down."""
    found = minimise(
        lambda x, request: Expansion(1.0 + float(x @ x), np.ones(1) - x, np.eye(1)), np.zeros(1), np.ones(1)
    )
    assert bool(found.result == RESULTS.stagnation)
    assert not found.converged
    assert abs(found.x[0]) < 1e-5  # as far as rounding hides that it leads upwards


def test_nothing_to_vary_is_a_minimum():
    found = minimise(
        lambda x, request: Expansion(2.0, np.zeros(0), np.zeros((0, 0))), np.zeros(0), np.zeros(0)
    )
    assert found.converged
    assert found.steps == 1


def test_the_unit_of_a_parameter_does_not_move_the_minimum_closer():
    """A residual that hangs on one parameter by 10⁻⁹ is as far from the minimum as one that hangs on it by 1."""
    jacobian, residuals = np.array([[1.0, 0.0], [1.0, 1.0]]), np.array([0.0, 3.0])
    for unit in (1.0, 1e-9):
        j = jacobian * [1.0, unit]
        distance, condition = distance_to_minimum(Expansion(9.0, j.T @ residuals, j.T @ j))
        # r lies in the plane of both columns: the distance is all of |r| = 3.
        assert distance == pytest.approx(3.0, rel=1e-6)
        assert condition == pytest.approx((1.0 + 0.5**0.5) / (1.0 - 0.5**0.5), rel=1e-6)

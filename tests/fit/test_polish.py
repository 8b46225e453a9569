"""Newton steps with a matrix that is kept: on functions whose minimum is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from walop_jax.fit.levenberg import polish


@dataclasses.dataclass(frozen=True)
class Expansion:
    objective: float
    gradient: np.ndarray
    matrix: np.ndarray


class Squares:
    """Half of the sum of squares of residuals with a known Jacobian, counting what is asked of it."""

    def __init__(self, residuals, jacobian):
        self.residuals, self.jacobian = residuals, jacobian
        self.full = self.cheap = 0

    def expand(self, x):
        self.full += 1
        r, j = self.residuals(x), self.jacobian(x)
        return Expansion(float(r @ r), j.T @ r, j.T @ j)

    def slope(self, x, near):
        self.cheap += 1
        r, j = self.residuals(x), self.jacobian(x)
        return Expansion(float(r @ r), j.T @ r, near.matrix)


def rosenbrock():
    """Rosenbrock 1960: minimum 0 at (1, 1)."""
    return Squares(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
    )


def test_near_the_minimum_the_matrix_is_computed_once():
    squares = rosenbrock()
    found = polish(squares.expand, squares.slope, np.array([1.001, 1.001]), np.ones(2), tolerance=1e-6)
    assert found.converged
    np.testing.assert_allclose(found.x, 1.0, atol=1e-6)
    assert squares.full == 1
    assert squares.cheap <= 3


def test_a_linear_problem_takes_one_step():
    design = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    y = np.array([1.0, 2.0, 4.0])
    squares = Squares(lambda x: y - design @ x, lambda _: -design)
    found = polish(squares.expand, squares.slope, np.array([50.0, -30.0]), np.array([10.0, 0.1]))
    # The straight line through (0, 1), (1, 2), (2, 4) by hand: 5/6 + 3/2 t.
    np.testing.assert_allclose(found.x, [5 / 6, 1.5], rtol=1e-12)
    assert (found.steps, squares.full, squares.cheap) == (1, 1, 1)


def test_a_matrix_that_no_longer_serves_is_computed_anew():
    # exp(x) = 3 and x = log 3 exactly: from afar each step changes the slope by much.
    squares = Squares(lambda x: np.exp(x) - 3.0, lambda x: np.diag(np.exp(x)))
    found = polish(squares.expand, squares.slope, np.array([1.6]), np.ones(1), tolerance=1e-9)
    assert found.converged
    assert squares.full > 1
    assert found.x[0] == pytest.approx(np.log(3.0), abs=1e-9)


def test_a_step_upwards_is_left_to_the_usual_search():
    # Far below log 3 the first Newton step overshoots by far.
    squares = Squares(lambda x: np.exp(x) - 3.0, lambda x: np.diag(np.exp(x)))
    found = polish(squares.expand, squares.slope, np.array([-3.0]), np.ones(1), tolerance=1e-9)
    assert found.converged
    assert found.x[0] == pytest.approx(np.log(3.0), abs=1e-8)


def test_numbers_that_are_not_finite_never_pass():
    squares = Squares(lambda x: x * np.nan, np.diag)
    assert not polish(squares.expand, squares.slope, np.ones(2), np.ones(2)).converged


def test_parameters_that_cannot_be_told_apart_never_pass():
    design = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-8]])
    squares = Squares(lambda x: design @ x - 1.0, lambda _: design)
    found = polish(squares.expand, squares.slope, np.zeros(2), np.ones(2))
    assert not found.converged
    assert "condition number" in found.message

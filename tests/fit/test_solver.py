"""The minimiser on functions whose minimum is known, from afar and near the end."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from walop_jax.fit.minimise import ROUGH, ROUNDING, WELL_PREDICTED, distance_to_minimum, minimise


@dataclasses.dataclass(frozen=True)
class Expansion:
    objective: float
    gradient: np.ndarray
    matrix: np.ndarray


class Squares:
    """A sum of squares of residuals with a known Jacobian, counting what is asked of it."""

    def __init__(self, residuals, jacobian):
        self.residuals, self.jacobian = residuals, jacobian
        self.looked = 0

    def __call__(self, x):
        self.looked += 1
        r, j = self.residuals(x), self.jacobian(x)
        return Expansion(float(r @ r), j.T @ r, j.T @ j)


def rosenbrock():
    """Rosenbrock 1960: minimum 0 at (1, 1)."""
    return Squares(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
    )


def exponential():
    """exp(x) = 3 at x = log 3."""
    return Squares(lambda x: np.exp(x) - 3.0, lambda x: np.diag(np.exp(x)))


# ------------------------------------------------------------------------------------------ near the end


def test_a_linear_problem_takes_one_step():
    design = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    y = np.array([1.0, 2.0, 4.0])
    squares = Squares(lambda x: y - design @ x, lambda _: -design)
    found = minimise(squares, np.array([50.0, -30.0]), np.array([10.0, 0.1]), damping=0.0)
    # The straight line through (0, 1), (1, 2), (2, 4) by hand: 5/6 + 3/2 t.
    np.testing.assert_allclose(found.x, [5 / 6, 1.5], rtol=1e-12)
    assert (found.steps, squares.looked) == (2, 2)


def test_the_last_step_need_not_be_looked_at():
    """Newton steps square what is left: what the last one leaves is known before.

    Of exp(x) = 3 an error e leaves e²/2, so that 2.4·10⁻³, 2.9·10⁻⁶ and 4·10⁻¹² follow: the last of them unseen.
    """
    squares = exponential()
    found = minimise(squares, np.array([1.101]), np.ones(1), damping=0.0, tolerance=1e-7)
    assert found.converged
    assert squares.looked == 2
    assert found.x[0] == pytest.approx(np.log(3.0), abs=1e-8)
    assert found.scaled_gradient < 1e-7


def test_after_a_step_upwards_steps_are_damped():
    # Far below log 3 the Newton step overshoots by far: to −3 + (3 − e⁻³) e³, where the objective is exp(113).
    squares, seen = exponential(), []
    found = minimise(
        squares,
        np.array([-3.0]),
        np.ones(1),
        damping=0.0,
        tolerance=1e-9,
        progress=lambda step, best: seen.append(best.objective),
    )
    assert found.converged
    assert found.x[0] == pytest.approx(np.log(3.0), abs=1e-8)
    assert found.history[1] > 1e20
    assert seen == sorted(seen, reverse=True)


# ------------------------------------------------------------------------------------- far from the data


def test_a_model_that_is_far_off_is_found_to_a_tenth_of_its_error_where_steps_close_in_slowly():
    """Large residuals that bend make Gauss–Newton steps close in by a constant factor: r = (x, 5 + x²/12)."""
    bent = Squares(
        lambda x: np.array([x[0], 5.0 + x[0] ** 2 / 12.0]), lambda x: np.array([[1.0], [x[0] / 6.0]])
    )
    start = np.array([0.9])
    close = minimise(bent, start, np.ones(1), damping=0.0)
    rough = minimise(bent, start, np.ones(1), damping=0.0, far_off=lambda _: True)
    assert close.converged
    assert rough.converged
    assert rough.steps < close.steps
    assert 1e-4 < rough.scaled_gradient < ROUGH
    assert abs(rough.x[0]) < 0.1 * 2.0


def test_a_model_that_is_far_off_is_found_exactly_where_steps_close_in_fast():
    found = minimise(exponential(), np.array([1.15]), np.ones(1), far_off=lambda _: True)
    assert found.converged
    assert found.x[0] == pytest.approx(np.log(3.0), abs=2e-3)


def test_work_is_bounded_and_the_best_place_so_far_comes_back():
    squares = rosenbrock()
    found = minimise(squares, np.array([-1.2, 1.0]), np.ones(2), maximum_steps=5)
    assert (found.steps, squares.looked) == (5, 5)
    assert not found.converged
    assert "not converged after 5 steps" in found.message
    assert found.expansion.objective == min(found.history) == squares(found.x).objective


def test_steps_to_and_fro_across_a_valley_are_damped():
    """r = (x, 5 + k x²) is bent by 1 + 10 k = 1.91 where Gauss and Newton have 1: each step leaves −0.91 of the way.

    Undamped, 0.9 takes a hundred of them to 10⁻⁴.
    """
    k = 0.091
    bent = Squares(
        lambda x: np.array([x[0], 5.0 + k * x[0] ** 2]), lambda x: np.array([[1.0], [2.0 * k * x[0]]])
    )
    found = minimise(bent, np.array([0.9]), np.ones(1), damping=0.0)
    assert found.converged
    assert found.steps < 15
    assert abs(found.x[0]) < 1e-3


# -------------------------------------------------------------------------------------- what holds always


def test_rosenbrock_from_the_usual_start():
    found = minimise(rosenbrock(), np.array([-1.2, 1.0]), np.ones(2), tolerance=1e-8)
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


def brown_and_dennis():
    """Problem 16 of Moré, Garbow & Hillstrom 1981 (ACM TOMS 7, 17), from its start: minimum 85822.2."""
    t = np.arange(1, 21) / 5.0

    def parts(x):
        return x[0] + t * x[1] - np.exp(t), x[2] + x[3] * np.sin(t) - np.cos(t)

    def jacobian(x):
        a, b = parts(x)
        return 2.0 * np.stack([a, a * t, b, b * np.sin(t)], axis=1)

    return Squares(lambda x: sum(part**2 for part in parts(x)), jacobian), np.array([25.0, 5.0, -5.0, -1.0])


def test_the_curvature_of_large_residuals_is_learnt_from_gradients():
    looked = []
    for secant in (False, True):
        squares, start = brown_and_dennis()
        found = minimise(squares, start, np.ones(4), secant=secant)
        assert found.converged
        assert found.expansion.objective == pytest.approx(85822.2, abs=0.05)
        looked.append(squares.looked)
    assert looked[1] < 0.7 * looked[0]


@pytest.mark.parametrize("bend", [0.5, -0.5, -4.0])
def test_gauss_newton_alone_closes_in_slowly_where_residuals_stay(bend):
    """Dennis & Schnabel 1983, example 10.2.4: x + 1 and bend x² + x − 1, minimum at 0, there JᵀJ = 2, S = −2 bend."""
    looked = []
    for secant in (False, True):
        squares = Squares(
            lambda x: np.array([x[0] + 1.0, bend * x[0] ** 2 + x[0] - 1.0]),
            lambda x: np.array([[1.0], [2.0 * bend * x[0] + 1.0]]),
        )
        found = minimise(squares, np.array([0.1]), np.ones(1), damping=0.0, secant=secant)
        np.testing.assert_allclose(found.x, 0.0, atol=1e-4)
        looked.append(squares.looked)
    assert looked[1] <= 0.6 * looked[0]


def test_without_residuals_the_secant_changes_little():
    looked = []
    for secant in (False, True):
        squares = rosenbrock()
        found = minimise(squares, np.array([-1.2, 1.0]), np.ones(2), secant=secant)
        np.testing.assert_allclose(found.x, 1.0, atol=1e-4)
        looked.append(squares.looked)
    assert looked[1] <= 1.2 * looked[0]


def test_the_secant_does_not_depend_on_units():
    """The same problem in other units: the same steps, as far as λ = 0 goes."""
    unit, places = np.array([1e-3, 1.0, 1e4, 10.0]), []
    for scale in (np.ones(4), unit):
        squares, start = brown_and_dennis()
        scaled = Squares(
            lambda x, s=squares, u=scale: s.residuals(x / u),
            lambda x, s=squares, u=scale: s.jacobian(x / u) / u,
        )
        found = minimise(scaled, start * scale, scale, damping=0.0, secant=True)
        places.append(found.history)
    np.testing.assert_allclose(places[1], places[0], rtol=1e-6)


def test_the_steps_are_those_of_optimistix():
    """Its Levenberg–Marquardt on the residuals themselves, with the same region, for as many steps: the same place."""

    def residuals(x, _):
        return jnp.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    region = optx.ClassicalTrustRegion(high_cutoff=WELL_PREDICTED)
    solver = eqx.tree_at(lambda s: s.search, optx.LevenbergMarquardt(rtol=0.0, atol=0.0), region)
    start = np.array([-1.2, 1.0])
    for steps in (2, 5, 9):
        ours = minimise(rosenbrock(), start, np.ones(2), maximum_steps=steps)
        theirs = optx.least_squares(residuals, solver, jnp.asarray(start), max_steps=steps, throw=False)
        assert bool(theirs.result == optx.RESULTS.nonlinear_max_steps_reached)
        assert ours.steps == steps
        np.testing.assert_allclose(ours.x, theirs.value, rtol=1e-10)


def test_numbers_that_are_not_finite_never_pass():
    found = minimise(Squares(lambda x: x * np.nan, np.diag), np.ones(2), np.ones(2))
    assert not found.converged
    assert "not finite" in found.message


@pytest.mark.parametrize("damping", [1.0, 0.0])
def test_parameters_that_cannot_be_told_apart_never_pass(damping):
    design = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-8]])
    squares = Squares(lambda x: design @ x - 1.0, lambda _: design)
    found = minimise(squares, np.zeros(2), np.ones(2), damping=damping)
    assert not found.converged
    assert "condition number" in found.message


def test_a_function_that_cannot_be_lowered_is_given_up():
    """Its gradient is that of another function: no step leads down."""
    found = minimise(
        lambda x: Expansion(1.0 + float(x @ x), np.ones(1) - x, np.eye(1)), np.zeros(1), np.ones(1)
    )
    assert "no step lowers" in found.message
    assert not found.converged
    assert abs(found.x[0]) < 1e-5  # as far as rounding hides that it leads upwards


def test_an_end_within_rounding_is_a_minimum():
    """The gradient is off by 5·10⁻⁷ of the square root of the objective, as that of interpolated optics may be."""
    off = 0.5 * ROUNDING**0.5 * 1e3
    found = minimise(
        lambda x: Expansion(1e6 + float(x @ x), x + off, np.eye(1)), np.zeros(1), np.ones(1), tolerance=1e-5
    )
    assert found.converged
    assert 1e-5 < found.scaled_gradient <= off * (1.0 + 1e-9)


def test_nothing_to_vary_is_a_minimum():
    found = minimise(lambda x: Expansion(2.0, np.zeros(0), np.zeros((0, 0))), np.zeros(0), np.zeros(0))
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

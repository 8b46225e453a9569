"""Optimal experiments: textbook designs, semidefinite programs, and the proof held against every other plan."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.plans.optimal import (
    Experiment,
    Listed,
    NotEstimableError,
    least_budget,
    lower_bound,
    optimise,
)
from walop_jax.plans.rounding import rounded


def regression(rows: np.ndarray) -> Listed:
    """Candidates that each measure one row of a linear regression with unit error."""
    return Listed.of(np.einsum("ia,ib->iab", rows, rows)[None])


def experiment(family, targets, *, known=0.0, budget=1.0) -> Experiment:
    n = targets.shape[-2]
    return Experiment(known * np.eye(n)[None], targets, (family,), budget)


GRID = np.linspace(-1.0, 1.0, 201)
QUADRATIC = np.stack([np.ones_like(GRID), GRID, GRID**2], axis=1)


def weights_at(plan, values: np.ndarray, near: float) -> float:
    """Weight of a plan within 0.05 of a place."""
    return sum(weight for (_, i), weight in plan.weights.items() if abs(values[i] - near) < 0.05)


def test_a_optimal_quadratic_regression():
    """On [−1, 1]: weights 1/4, 1/2, 1/4 at −1, 0, 1, trace of the inverse 8 (Pukelsheim 2006, Optimal Design, 9.5)."""
    plan = optimise(experiment(regression(QUADRATIC), np.eye(3)[None, None]), gap=1e-5)
    assert plan.value == pytest.approx(8.0, rel=1e-5)
    assert plan.bound <= 8.0 <= plan.value * (1 + 1e-8)
    assert [weights_at(plan, GRID, x) for x in (-1, 0, 1)] == pytest.approx([0.25, 0.5, 0.25], abs=2e-3)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_the_worst_variance_of_a_polynomial_is_its_number_of_coefficients(degree):
    """Kiefer & Wolfowitz 1960: the least possible largest variance of a fitted curve is n, with weights 1/n.

    The places are the zeros of (1 − x²) P'_degree (Guest 1958, Ann. Math. Stat. 29, 294).
    """
    rows = np.polynomial.legendre.legvander(GRID, degree)
    plan = optimise(experiment(regression(rows), rows[None, :, :, None]), gap=1e-3)
    # Their places lie between those of the grid, by up to 0.005.
    assert plan.value == pytest.approx(degree + 1, rel=2e-3)
    inner = np.polynomial.legendre.Legendre.basis(degree).deriv().roots()
    for x in (-1.0, *inner, 1.0):
        assert weights_at(plan, GRID, x) == pytest.approx(1 / (degree + 1), abs=0.02)


def test_c_optimal_extrapolation():
    """The line 1 + x seen on [−1, 1] and wanted at x = 2: weights 3/4 at 1, 1/4 at −1, variance 4 (Elfving 1952)."""
    rows = QUADRATIC[:, :2]
    wanted = np.array([1.0, 2.0])[None, None, :, None]
    plan = optimise(experiment(regression(rows), wanted), gap=1e-4)
    assert plan.value == pytest.approx(4.0, rel=1e-4)
    assert weights_at(plan, GRID, 1.0) == pytest.approx(0.75, abs=5e-3)


PARTIAL_CIRCLE = np.linspace(-np.pi / 2, np.pi / 2, 200)
TWO = np.stack([a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21))], axis=1)
DOSE = np.exp(-10 + 0.2 * np.arange(1, 151))
PUBLISHED = {
    "trigonometric": (
        np.hstack([np.ones((200, 1)), *(f(k * PARTIAL_CIRCLE)[:, None] for k in (1, 2, 3) for f in (np.cos, np.sin))]),
        3152.49145979,
        1182.60662887,
    ),
    "cubic": (np.vander(np.linspace(0, 2, 101), 4), 256.070354482, 305.503237198),
    "two factors": (
        np.stack([np.ones(441), *TWO.T, *(TWO.T**2), TWO.prod(axis=1)], axis=1), 17.8921718391, 1690.65172159
    ),
    "dose": (np.sqrt(DOSE)[:, None] / (1 + DOSE)[:, None] * np.stack([np.ones(150), np.arange(1, 151)], axis=1),
             227.768409005, 81.6616339845),
}  # fmt: skip
"""Models of the help pages of the R package OptimalDesign (od.AA, Fx_cube, od.MISOCP), and the optimal values of
tr M⁻¹ and tr M⁻¹ ΣffT that its `od_REX` finds (version 1.0.1, efficiency 0.99999999, run with R 4.2.2)."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_designs_of_the_package_optimaldesign(name):
    rows, a_optimal, i_optimal = PUBLISHED[name]
    n = rows.shape[1]
    factor = np.linalg.cholesky(rows.T @ rows)
    for targets, expected in ((np.eye(n), a_optimal), (factor, i_optimal)):
        plan = optimise(experiment(regression(rows), targets[None, None]), gap=2e-5)
        assert plan.value == pytest.approx(expected, rel=1e-4)
        assert plan.bound <= expected * (1 + 1e-8)


def test_the_least_budget_of_a_criterion():
    """Without what is known the criterion goes as 1 / budget: 8 for a budget of 1 is 2 for 4 (quadratic regression)."""
    plan, least = least_budget(experiment(regression(QUADRATIC), np.eye(3)[None, None]), 2.0, gap=1e-3)
    assert sum(plan.weights.values()) == pytest.approx(4.0, rel=2e-3)
    assert 4.0 * (1 - 2e-3) <= least <= 4.0 * (1 + 1e-6)
    # One observation of each coefficient known beforehand is worth some of the budget, never more than it says.
    known, less = least_budget(
        experiment(regression(QUADRATIC), np.eye(3)[None, None], known=1.0), 2.0, gap=1e-3
    )
    assert sum(known.weights.values()) < sum(plan.weights.values())
    assert less <= sum(known.weights.values()) * (1 + 1e-3)  # its criterion is that asked for to the gap
    assert known.value == pytest.approx(2.0, rel=2e-3)


def lists(problem: Experiment) -> list[Listed]:
    """Its families, which are lists."""
    return [family for family in problem.families if isinstance(family, Listed)]


def random_experiment(seed: int, *, draws: int = 1, count: int = 60, budget: float = 7.0) -> Experiment:
    """A few parameters seen by candidates of several rows each, some known before, wanted in several combinations."""
    rng = np.random.default_rng(seed)
    n = 5
    rows = rng.standard_normal((draws, count, 2, n)) * np.geomspace(1.0, 30.0, n)
    information = np.einsum("rsqa,rsqb->rsab", rows, rows)
    targets = rng.standard_normal((draws, 6, n, 2)) / np.geomspace(1.0, 30.0, n)[:, None]
    known = np.broadcast_to(np.diag([0.0, 0.0, 1.0, 4.0, 9.0]), (draws, n, n)).copy()
    half = count // 2
    families = (
        Listed.of(information[:, :half], rng.uniform(0.5, 2.0, half)),
        Listed.of(information[:, half:], rng.uniform(0.5, 2.0, count - half)),
    )
    return Experiment(known, targets, families, budget)


@pytest.mark.parametrize(("seed", "draws", "count"), [(1, 1, 60), (2, 3, 40), (3, 1, 300)])
def test_against_a_semidefinite_program(seed, draws, count):
    """The same by cvxpy and Clarabel: least mean of t with the Schur complement [[M, A], [Aᵀ, X]] ⪰ 0, tr X ≤ t."""
    cvxpy = pytest.importorskip("cvxpy")
    problem = random_experiment(seed, draws=draws, count=count)
    weight = cvxpy.Variable(count, nonneg=True)
    cost = np.concatenate([f.cost for f in lists(problem)])
    constraints, levels = [cost @ weight <= problem.budget], cvxpy.Variable(draws)
    for r in range(draws):
        matrices = np.concatenate([f.matrices[r] for f in lists(problem)])
        total = problem.known[r] + cvxpy.sum([weight[i] * matrices[i] for i in range(count)])
        for a in problem.targets[r]:
            corner = cvxpy.Variable((2, 2), symmetric=True)
            constraints += [cvxpy.bmat([[total, a], [a.T, corner]]) >> 0, cvxpy.trace(corner) <= levels[r]]
    program = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum(levels) / draws), constraints)
    program.solve(solver="CLARABEL")
    plan = optimise(problem, gap=3e-5)
    assert plan.value == pytest.approx(program.value, rel=1e-4)
    assert plan.bound <= program.value * (1 + 1e-6)


def test_no_plan_is_better_than_the_bound():
    """A thousand plans of the same budget, those of few candidates among them; the bound holds for any multipliers."""
    problem, rng = random_experiment(4).reduced(), np.random.default_rng(6)
    plan = optimise(problem)
    cost = np.concatenate([f.cost for f in lists(problem)])
    keys = [(f, i) for f, family in enumerate(problem.families) for i in range(len(family.cost))]
    matrices = problem.information(keys)[0]

    def variances(weight):
        covariance = np.linalg.inv(problem.known[0] + np.tensordot(weight, matrices, 1))
        return covariance, np.einsum("knq,nm,kmq->k", problem.targets[0], covariance, problem.targets[0])

    for _ in range(1000):
        weight = rng.dirichlet(np.full(len(cost), rng.choice([0.02, 0.1, 1.0]))) * problem.budget / cost
        covariance, phi = variances(weight)
        assert phi.max() >= plan.bound
        shares = rng.dirichlet(np.ones(len(phi)))
        assert lower_bound(problem, covariance[None], shares[None]).value(problem.budget) <= plan.value


def test_whole_numbers_are_within_three_per_cent_of_any_weights():
    for seed in range(5):
        problem = random_experiment(seed, budget=30.0)
        plan = optimise(problem, gap=1e-3)
        whole = rounded(problem, plan)
        count = np.array(list(whole.weights.values()))
        assert problem.cost(whole.weights) <= problem.budget * (1 + 1e-9)
        assert np.all(count == np.round(count))
        assert count.sum() >= 15
        assert 0.0 <= whole.gap <= 0.03


def test_what_nobody_sees_is_not_estimable():
    rows = QUADRATIC * np.array([1.0, 1.0, 0.0])
    with pytest.raises(NotEstimableError, match="targets 0"):
        optimise(experiment(regression(rows), np.eye(3)[None, None]))
    # A gauge that no target asks for is left out.
    wanted = np.eye(3)[None, None, :, :2]
    assert optimise(experiment(regression(rows), wanted), gap=1e-4).value == pytest.approx(2.0, rel=1e-3)


def test_scales_of_parameters_do_not_matter():
    problem = random_experiment(7)
    turn = np.diag(10.0 ** np.arange(-6, 9, 3.0))
    other = Experiment(
        turn @ problem.known @ turn,
        np.einsum("an,rknq->rkaq", turn, problem.targets),
        tuple(Listed.of(turn @ f.matrices @ turn, f.cost) for f in lists(problem)),
        problem.budget,
    )
    assert optimise(other, gap=1e-4).value == pytest.approx(optimise(problem, gap=1e-4).value, rel=1e-4)


@pytest.mark.parametrize("budget", [0.0, -3.0, float("nan")])
def test_a_budget_must_be_positive(budget):
    with pytest.raises(ValueError, match="nothing can be done with it"):
        optimise(random_experiment(1, budget=budget))


def test_a_budget_below_every_cost_pays_for_nothing():
    problem = random_experiment(1, budget=0.1)
    with pytest.raises(ValueError, match="cheapest"):
        rounded(problem, optimise(problem))


def test_two_experiments_share_their_largest_variance():
    """Half the weight p at each of ±1, the rest at 0: the coefficient of x² has the variance 1 / p (1 − p), three times
    that of the slope of a line 3 / p; at best both are 9 / 2, p = 2 / 3. The line's third parameter is known."""
    blocks = np.stack([np.eye(3), np.diag([1.0, 1.0, 0.0])])
    targets = np.zeros((2, 1, 3, 1))
    targets[0, 0, 2], targets[1, 0, 1] = 1.0, np.sqrt(3.0)
    known = np.stack([np.zeros((3, 3)), np.diag([0.0, 0.0, 1.0])])
    plan = optimise(Experiment(known, targets, (regression(QUADRATIC),), 1.0, blocks), gap=1e-3)
    assert plan.bound <= 4.5 * (1 + 1e-6)
    assert plan.value == pytest.approx(4.5, rel=1e-3)
    assert weights_at(plan, GRID, 0.0) == pytest.approx(1 / 3, abs=0.02)


def test_a_value_that_no_budget_reaches_is_said():
    """Candidates inform about the sum of two parameters only: one of them stays as well known as before."""
    problem = Experiment(
        np.diag([1.0, 4.0])[None], np.array([[[[1.0], [0.0]]]]), (regression(np.ones((1, 2))),), 1.0
    )
    floor = 1.0 / (1.0 + 4.0)  # x₁ + x₂ known exactly: the information of the second counts for the first
    plan, _ = least_budget(problem, 2.0 * floor)
    assert plan.value == pytest.approx(2.0 * floor, rel=1e-2)
    with pytest.raises(NotEstimableError, match=f"below {floor:.3g}"):
        least_budget(problem, 0.9 * floor)

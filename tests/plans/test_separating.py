"""What separates the members of a class: angles between columns, in closed form and by least squares."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, refit
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.plans import criteria, separating
from walop_jax.plans.available import Available
from walop_jax.plans.exposures import Candidates
from walop_jax.plans.optimal import Experiment, Listed
from walop_jax.plans.plan import plan_exposures
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import effect_from_text, simulate

NAMES = ("base.t", "one.size", "two.size", "three.size")


def candidates_of(names: tuple[str, ...]) -> Candidates:
    """Candidates without exposures: their parameters are enough."""
    found = object.__new__(Candidates)
    object.__setattr__(found, "names", names)
    object.__setattr__(found, "values", np.zeros((1, len(names))))
    return found


def experiment_of(
    columns: list[np.ndarray], had: np.ndarray, *, cost: float = 1.0, budget: float = 10.0
) -> tuple[Experiment, list[tuple[str, str]]]:
    """Exposures by the derivatives (row, parameter) of their residuals, beside those of data that were taken."""
    found = candidates_of(NAMES[: had.shape[1]])
    information = had.T @ had
    of = criteria.amplitudes_of(found, [name.split(".")[0] for name in found.names[1:]])
    size = separating.sizes(information, of, np.eye(had.shape[1])[1])
    criterion = criteria.apart(found, of, size)
    pairs, blocks = separating.pairs_of(of), criterion.blocks
    assert blocks is not None
    idle = np.stack([np.diag(1.0 * ~block.any(axis=0)) for block in blocks])
    family = Listed.of(np.stack([c.T @ c for c in columns])[None], cost)
    known = blocks.swapaxes(1, 2) @ information @ blocks + idle
    return Experiment(known, criterion.targets, (family,), budget, blocks), pairs


def test_two_columns_and_the_angle_between_them():
    """Δχ² = a² |A|² sin² ϑ, by hand: A of length 3, B at 30° of it, four exposures, a = 1 beside data that see little.

    In those data the columns are parallel, B twice as long: half its size is fitted in place of A, and stands for it.
    """
    weak = 1e-3
    had = weak * np.array([[0.0, 1.0, 2.0], [1.0, 0.0, 0.0]])
    new = np.zeros((4, 3))
    new[:2, 1] = 3.0, 0.0
    new[:2, 2] = 5.0 * np.cos(np.pi / 6), 5.0 * np.sin(np.pi / 6)
    new[2, 0] = 1.0  # the base parameter is seen in a row of its own
    problem, pairs = experiment_of([new], had)
    assert pairs == [("one", "two"), ("two", "one")]
    assert separating.distances(problem, {(0, 0): 4.0}) == pytest.approx(
        [4 * 3.0**2 * 0.25, 4 * (0.5 * 5.0) ** 2 * 0.25], rel=1e-4
    )
    assert max(separating.distances(problem, {})) < 1e-4


def test_distances_are_those_of_least_squares():
    """Rows of the data and of the exposures, A at its size; B and the base parameter are fitted by numpy."""
    rng = np.random.default_rng(4)
    had, new = rng.normal(size=(7, 4)), rng.normal(size=(5, 4))
    problem, pairs = experiment_of([new], had)
    found = candidates_of(NAMES)
    of = criteria.amplitudes_of(found, ["one", "two", "three"])
    size = separating.sizes(had.T @ had, of, np.eye(4)[1])
    for times in (0, 3):
        rows = np.concatenate([had, *[new] * times])
        for (truth, rival), told in zip(
            pairs, separating.distances(problem, {(0, 0): float(times)}), strict=True
        ):
            signal = rows @ size[truth]
            fitted = rows[:, [0, *of[rival]]]
            left = signal - fitted @ np.linalg.lstsq(fitted, signal, rcond=None)[0]
            assert told == pytest.approx(left @ left, rel=1e-6)
    fitted = had[:, [0, 2]]
    assert size["two"][2] == pytest.approx(np.linalg.lstsq(fitted, had[:, 1], rcond=None)[0][1], rel=1e-9)


def seen(one: float, two: float, three: float) -> np.ndarray:
    """An exposure that measures the sum of three amplitudes with these weights, and the base parameter by itself."""
    return np.array([[0.0, one, two, three], [1.0, 0.0, 0.0, 0.0]])


def test_two_exposures_where_one_leaves_a_pair():
    """Data see the sum of three amplitudes. Each exposure shows but one of them; two such separate all three pairs.

    Where the third is true the first, of an amplitude b in its place, misses data by 10 (1 - b) and five exposures by
    10 b each: the least Δχ² is 100 · 500 / 600, by hand.
    """
    had = 10.0 * seen(1.0, 1.0, 1.0)
    first, second, poor = seen(10.0, 0.0, 0.0), seen(0.0, 10.0, 0.0), seen(1.0, 1.0, 1.001)
    problem, _ = experiment_of([poor, first, poor, second], had)
    plan = separating.few_exposures(problem, problem.cost, lambda family: 1)
    assert set(plan) == {(0, 1), (0, 3)}
    assert sum(plan.values()) <= 10
    assert min(separating.distances(problem, plan)) == pytest.approx(100.0 * 500.0 / 600.0, rel=1e-6)
    # Of two members that one exposure separates, it is repeated for all of the time.
    problem, _ = experiment_of([poor[:, :3], first[:, :3]], had[:, :3])
    assert separating.few_exposures(problem, problem.cost, lambda family: 1) == {(0, 1): 10.0}


def test_the_best_exposure_is_that_of_the_largest_distance_in_the_time():
    """By hand: a² |A|² sin² is 0.36 in an exposure of 1 s and 1.44 in one of 6 s; ten of the first in 10 s are more."""
    had = 1e-3 * np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    short, long = (np.array([[0.0, a, 0.0], [0.0, 0.0, 0.0]]) for a in (0.6, 1.2))
    problem, _ = experiment_of([short, long], had)
    family = Listed.of(np.stack([c.T @ c for c in (short, long)])[None], np.array([1.0, 6.0]))
    problem = Experiment(problem.known, problem.targets, (family,), 10.0, problem.blocks)
    plan = separating.few_exposures(problem, problem.cost, lambda family: 1)
    assert plan == {(0, 0): 10.0}


def test_a_time_that_pays_for_nothing():
    problem, _ = experiment_of([seen(1.0, 0.0, 0.0)], 1e-2 * seen(1.0, 1.0, 1.0), cost=60.0, budget=30.0)
    with pytest.raises(ValueError, match=r"0\.5 minutes do not pay for a single exposure"):
        separating.few_exposures(problem, problem.cost, lambda family: 1)


SMALL = ObservingPlan(
    grid=3, standard_grid=2, moon_patches=2, standards=2, unpolarised=1, throughput_degree=1
)
TRUTH, RIVAL = "hwp2_axis", "hwp2_crossing"


def fitted(calset: CalibrationSet, name: str) -> FitResult:
    """A fit of the base model with one effect."""
    return refit(calset, with_effects(base_model(calset, throughput_degree=1), [name], calset))


def test_the_distance_promised_is_that_of_fits_to_both_sets():
    """Noiseless: χ² of the rival above that of the truth, before the planned exposures were taken, and with them."""
    instrument = dataclasses.replace(simulate(SMALL, seed=1).truth, effects=())
    effect = effect_from_text(f"{TRUTH}=0.02", effect_context(instrument, SMALL.exposures()))

    def taken(plan: ObservingPlan) -> CalibrationSet:
        return simulate(
            plan, seed=1, instrument=instrument, effects=(effect,), noiseless=True, steady=True
        ).calset

    first = taken(SMALL)
    fits = {name: fitted(first, name) for name in (TRUTH, RIVAL)}
    known = Calibration.from_fit(examined(fits[TRUTH]))
    (found,) = known.model.instrument(known.values).effects
    given = separating.ClassOfRun((TRUTH, RIVAL), (found, RIVAL), first, known)
    planned = plan_exposures(Available(SMALL), 10.0, separate=given)
    assert [(pair.truth, pair.rival) for pair in planned.pairs] == [(TRUTH, RIVAL), (RIVAL, TRUTH)]
    assert 1 <= len(planned.lines) <= 2
    assert planned.seconds <= 600.0
    assert planned.value <= planned.bound
    assert f"if {TRUTH} is true, {RIVAL} is" in repr(planned)
    pair = planned.pairs[0]
    apart = fits[RIVAL].expansion.objective - fits[TRUTH].expansion.objective
    assert pair.before == pytest.approx(apart, rel=0.1)
    both = merge_calibration_sets(first, taken(planned.observing_plan))
    objective = {name: fitted(both, name).expansion.objective for name in (TRUTH, RIVAL)}
    assert pair.after == pytest.approx(objective[RIVAL] - objective[TRUTH], rel=0.1)
    assert pair.after > pair.before + 1.0

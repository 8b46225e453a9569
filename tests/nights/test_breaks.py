"""Breaks in series of linear equations with a known truth: chances, dates, names, and nights that took no part."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from walop_jax.model.effects.change import Change
from walop_jax.model.laws import Law
from walop_jax.model.parameters import Parameter
from walop_jax.nights import breaks
from walop_jax.nights.algebra import Equations
from walop_jax.nights.equations import EffectAmplitude, Night, Together

N, NIGHTS, RATE = 6, 60, 0.05
LAWS = (Law(("walk",), rate=RATE), Law(), Law(), Law(), Law(("night",), spread=0.2), None)


def series(seed, change=None):
    """Nights of `N` parameters: one walks, one has a value each night, the last is a candidate; `change` (night, n)."""
    rng = np.random.default_rng(seed)
    mjd = 61000.9 + np.cumsum(rng.integers(1, 4, NIGHTS))
    rows = np.random.default_rng(1).normal(size=(20, N)) * np.array([3.0, 5.0, 1.0, 2.0, 4.0, 1.0])
    rows[:, 2] = rows[:, 3] * 0.3 + 1e-3 * rows[:, 2]  # two that hardly differ
    truth = np.zeros((NIGHTS, N)) if change is None else change.copy()
    truth[:, 0] += np.cumsum(RATE * np.sqrt(np.diff(mjd, prepend=mjd[0])) * rng.normal(size=NIGHTS))
    truth[:, 4] += 0.2 * rng.normal(size=NIGHTS)
    data = truth @ rows.T + rng.normal(size=(NIGHTS, 20))
    matrix, names = rows.T @ rows, [f"p{k}.x" for k in range(N)]
    parameters = tuple(Parameter(name, "deg", "", "", 0.0) for name in names)
    nights = tuple(
        Night("A", "m", int(day), day - 0.05, day + 0.05, day, ("r",), f"{k}", f"{k}", 20, 20, float(y @ y), parameters,
              1, np.zeros(N), -rows.T @ y, matrix)
        for k, (day, y) in enumerate(zip(mjd, data, strict=True))
    )  # fmt: skip
    scale = 1.0 / np.sqrt(NIGHTS * np.diag(matrix))
    every = np.arange(NIGHTS)
    equations = Equations(
        mjd, every, every, np.sum(data**2, axis=1), -(data @ rows) * scale,
        np.tile(matrix * np.outer(scale, scale), (NIGHTS, 1, 1)), scale,
    )  # fmt: skip
    return Together(nights, parameters, 1, np.zeros(N), np.zeros(N), np.full(N, np.inf), equations)


@pytest.mark.parametrize(("u", "rho"), [(2.0, 0.0), (2.0, 0.9), (4.0, 0.6), (5.0, 0.99), (3.0, -0.8)])
def test_two_deviates_beyond(u, rho):
    """Against scipy's bivariate normal distribution."""

    def corner(r):
        at, matrix = [-u, -u], [[1.0, r], [r, 1.0]]
        return stats.multivariate_normal.cdf(at, [0.0, 0.0], matrix, abseps=1e-15, releps=1e-9)

    wanted = 2.0 * (corner(rho) + corner(-rho))
    assert breaks.both_beyond(u, np.array([rho]))[0] == pytest.approx(wanted, rel=1e-4)


def test_the_largest_of_quiet_series_is_as_the_bound_says():
    """A hundred series in which things walk: never more than the bound by more than chance, and not far below it."""
    largest = []
    for seed in range(100):
        tried = breaks.Tried.of(breaks.solved(series(seed), LAWS))
        largest.append(max(np.abs(tried.z(kind)).max() for kind in range(3)))
    for u in (3.4, 3.8):
        beyond, most = np.sum(np.array(largest) > u), tried.chance(u)
        assert stats.binom.sf(beyond - 1, 100, most) > 1e-3
        assert stats.binom.cdf(beyond, 100, 0.4 * most) > 1e-3


def test_a_step_a_bad_night_and_a_drift():
    """All three at once: kinds, dates, sizes within their errors, and laws that leave nothing."""
    change = np.zeros((NIGHTS, N))
    change[40:, 5], change[20, 1] = 1.2, 2.0
    change[:, 3] = 12.0 * np.linspace(-0.15, 0.15, NIGHTS)
    data = series(7, change)
    found, laws = breaks.find(data, LAWS, ())
    kinds = {one.kind: one for one in found}
    assert sorted(kinds) == ["bad night", "drift", "step"]
    step, bad = kinds["step"], kinds["bad night"]
    assert (step.name, bad.name) == ("p5.x", "p1.x")
    assert (step.before, step.after) == (data.nights[39].end, data.nights[40].begin)
    assert bad.night == data.nights[20].number
    assert step.nights[0] <= data.nights[40].number <= step.nights[1]
    assert abs(step.size - 1.2) < 4.0 * step.error
    assert abs(bad.size - 2.0) < 4.0 * bad.error
    assert all(one.held_out > 0 for one in found if one.kind != "bad night")
    assert math.isnan(bad.held_out)
    # What hardly differs is named together, and nights like these would need to be many.
    drift = kinds["drift"]
    assert {drift.name, *drift.alike} >= {"p2.x", "p3.x"}
    assert drift.nights_needed > NIGHTS
    assert breaks.find(data, laws, ())[0] == ()


def test_of_names_that_explain_a_break_alike_one_that_stars_can_be_corrected_for_is_its_law():
    change = np.zeros((NIGHTS, N))
    change[:, 3] = 12.0 * np.linspace(-0.15, 0.15, NIGHTS)
    data = series(7, change)
    (first,) = breaks.find(data, LAWS, ())[0]
    assert first.alike
    (second,), laws = breaks.find(data, LAWS, (), lambda parameter: parameter.name != first.name)
    assert second.name in first.alike
    assert first.name in second.alike
    assert second.z**2 > first.z**2 - breaks.RIVAL
    assert laws[data.names.index(second.name)].per != laws[data.names.index(first.name)].per
    # Without one that is, the best keeps it.
    (third,) = breaks.find(data, LAWS, (), lambda name: False)[0]
    assert third.name == first.name


def test_a_break_beside_a_value_for_every_file_is_held_against_other_nights():
    """The nights that are left out are files that are left out."""
    change = np.zeros((NIGHTS, N))
    change[40:, 5] = 1.2
    (step,) = breaks.find(series(7, change), (*LAWS[:4], Law(("file",), spread=0.2), None), ())[0]
    assert (step.kind, step.name) == ("step", "p5.x")
    assert step.held_out > 0


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("gain in O1", True),
        ("axis of half1.plate", True),
        ("axis of half1.plate * kelvin", True),
        ("light of O2 in O1", True),
        ("light in O1", False),
        ("afterglow in O1", False),
        ("gain in O1 * hours", False),
    ],
)
def test_what_a_change_does_to_a_star_is_known_or_not(text, known):
    """Not from the median of a field, the exposure before, or hours since a first one: a star has none of these."""
    assert Change.parsed(text).of_stars is known


def test_a_model_holds_one_shape_of_an_effect():
    """Where a law or the model has one shape of an effect, the others are no breaks."""
    names = ("half1.wedge", "ghost.depth", "cut#0.angle", "cut#1.angle", "ghost#1.depth", "drift#1.rate")
    one = series(0)
    every = [Parameter(name, "deg", "", "", 0.0, part=name.partition(".")[0]) for name in names]
    parameters = (*every[:2], *map(EffectAmplitude.read, every[2:]))
    nights = tuple(dataclasses.replace(n, parameters=parameters, candidates=4) for n in one.nights)
    data = dataclasses.replace(one, nights=nights, parameters=nights[0].parameters, candidates=4)
    laws = (Law(), Law(), None, Law(("night",)), None, None)
    assert breaks._other_shapes(data, laws) == [names.index("cut#0.angle"), names.index("ghost#1.depth")]
    assert breaks._other_shapes(data, (Law(), Law(), None, None, None, None)) == [
        names.index("ghost#1.depth")
    ]


def test_the_size_of_a_step_between_two_intervals_is_the_difference_of_their_values():
    """A value of 5 before and of 6.2 after: by a step of the law, and by one more edge of its intervals."""
    change, sizes = np.zeros((NIGHTS, N)), []
    change[:, 1], change[40:, 1] = 5.0, 6.2
    data = series(7, change)
    middle = 0.5 * (data.nights[10].end + data.nights[11].begin)
    for law in (Law(), Law(("interval",), at=(middle,))):
        (step,), laws = breaks.find(data, (LAWS[0], law, *LAWS[2:]), ())
        one = breaks.at_solution(data, breaks.solved(data, laws), step)
        assert (one.kind, one.name) == ("step", "p1.x")
        assert abs(one.size - 1.2) < 4.0 * one.error
        sizes.append((one.size, one.error))
    # With an edge that nothing happens at, less data show what was before: the error is larger.
    assert sizes[1][1] > sizes[0][1]

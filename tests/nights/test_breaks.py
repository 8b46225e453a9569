"""Breaks in series of linear equations with a known truth: chances, dates, names, and nights that took no part."""

import dataclasses
import json
import math

import numpy as np
import pytest
from scipy import stats

from walop_jax.data.user_tables import in_memory
from walop_jax.io.errors import DataError
from walop_jax.model.effects.change import Change
from walop_jax.model.laws import Law
from walop_jax.model.parameters import Parameter
from walop_jax.nights import break_search, breaks, night_file, stacking, survey_folder
from walop_jax.nights.algebra import Equations
from walop_jax.nights.survey import Survey
from walop_jax.nights.together import EffectAmplitude, Night, Together, together

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
    assert break_search.both_beyond(u, np.array([rho]))[0] == pytest.approx(wanted, rel=1e-4)


def test_the_largest_of_quiet_series_is_as_the_bound_says():
    """A hundred series in which things walk: never more than the bound by more than chance, and not far below it."""
    largest = []
    for seed in range(100):
        tried = break_search.Tried.of(breaks.solved(series(seed), LAWS))
        largest.append(max(np.abs(tried.z(kind)).max() for kind in range(3)))
    for u in (3.4, 3.8):
        beyond, most = np.sum(np.array(largest) > u), tried.chance(u)
        assert stats.binom.sf(beyond - 1, 100, most) > 1e-3
        assert stats.binom.cdf(beyond, 100, 0.4 * most) > 1e-3


@pytest.mark.parametrize("u", [3.5, 4.5])
def test_the_bound_of_three_nights_is_a_bound(u):
    """A candidate that three equal nights see: five changes that differ, of known correlations (Bonferroni 1936)."""
    number, no = np.arange(3), np.zeros((3, 2))
    e = Equations(61000.0 + number, number, number, no[:, 0], no, np.tile(np.eye(2), (3, 1, 1)), np.ones(2))
    data = dataclasses.replace(
        series(0), equations=e, mean=no[0], width=no[0] + np.inf, parameters=series(0).parameters[4:]
    )
    tried = break_search.Tried.of(breaks.solved(data, (Law(), None)), barred=[0])
    single = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [-1, 0, 1]]) / np.sqrt(
        [[1], [1], [1], [2], [2]]
    )
    correlation = single @ single.T
    both = break_search.both_beyond(u, correlation[np.triu_indices(5, 1)])
    total = 5.0 * 2.0 * stats.norm.sf(u)
    assert total - both.sum() < tried.chance(u) < total


def test_a_step_a_bad_night_and_a_drift():
    """All three at once: kinds, dates, sizes within their errors, and laws that leave nothing."""
    change = np.zeros((NIGHTS, N))
    change[40:, 5], change[20, 1] = 1.2, 2.0
    change[:, 3] = 12.0 * np.linspace(-0.15, 0.15, NIGHTS)
    data = series(7, change)
    found, laws = break_search.find(data, LAWS, ())
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
    assert break_search.find(data, laws, ())[0] == ()


def test_of_names_that_explain_a_break_alike_one_that_stars_can_be_corrected_for_is_its_law():
    change = np.zeros((NIGHTS, N))
    change[:, 3] = 12.0 * np.linspace(-0.15, 0.15, NIGHTS)
    data = series(7, change)
    (first,) = break_search.find(data, LAWS, ())[0]
    assert first.alike
    (second,), laws = break_search.find(data, LAWS, (), lambda parameter: parameter.name != first.name)
    assert second.name in first.alike
    assert first.name in second.alike
    assert second.z**2 > first.z**2 - break_search.RIVAL
    assert laws[data.names.index(second.name)].per != laws[data.names.index(first.name)].per
    # Without one that is, the best keeps it.
    (third,) = break_search.find(data, LAWS, (), lambda name: False)[0]
    assert third.name == first.name


def test_a_break_beside_a_value_for_every_file_is_held_against_other_nights():
    """The nights that are left out are files that are left out."""
    change = np.zeros((NIGHTS, N))
    change[40:, 5] = 1.2
    (step,) = break_search.find(series(7, change), (*LAWS[:4], Law(("file",), spread=0.2), None), ())[0]
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
    assert Change.parsed(text).applies_to_catalogue is known


def test_a_model_holds_one_shape_of_an_effect():
    """Where a law or the model has one shape of an effect, the others are no breaks."""
    names = ("half1.wedge", "ghost.depth", "cut#0.angle", "cut#1.angle", "ghost#1.depth", "drift#1.rate")
    one = series(0)
    every = [Parameter(name, "deg", "", "", 0.0, part=name.partition(".")[0]) for name in names]
    parameters = (*every[:2], *map(EffectAmplitude.read, every[2:]))
    nights = tuple(dataclasses.replace(n, parameters=parameters, candidates=4) for n in one.nights)
    data = dataclasses.replace(one, nights=nights, parameters=nights[0].parameters, candidates=4)
    laws = (Law(), Law(), None, Law(("night",)), None, None)
    assert break_search._other_shapes(data, laws) == [
        names.index("cut#0.angle"),
        names.index("ghost#1.depth"),
    ]
    assert break_search._other_shapes(data, (Law(), Law(), None, None, None, None)) == [
        names.index("ghost#1.depth")
    ]


def test_the_size_of_a_step_between_two_intervals_is_the_difference_of_their_values():
    """A value of 5 before and of 6.2 after: by a step of the law, and by one more edge of its intervals."""
    change, sizes = np.zeros((NIGHTS, N)), []
    change[:, 1], change[40:, 1] = 5.0, 6.2
    data = series(7, change)
    middle = 0.5 * (data.nights[10].end + data.nights[11].begin)
    for law in (Law(), Law(("interval",), at=(middle,))):
        (step,), laws = break_search.find(data, (LAWS[0], law, *LAWS[2:]), ())
        one = breaks.at_solution(data, breaks.solved(data, laws), step)
        assert (one.kind, one.name) == ("step", "p1.x")
        assert abs(one.size - 1.2) < 4.0 * one.error
        sizes.append((one.size, one.error))
    # With an edge that nothing happens at, less data show what was before: the error is larger.
    assert sizes[1][1] > sizes[0][1]


def step_before_night_40(data):
    """A step of p1.x."""
    last, first = data.nights[39:41]
    span = (first.number, first.number)
    return breaks.Break(
        "step", "p1.x", "deg", 2.0, 0.1, 20.0, 1e-9, first.number, span, last.end, first.begin
    )


def test_between_the_nights_of_a_step_it_has_happened_or_not():
    """With probability q: mean and covariance are those of the mixture of both (law of total covariance)."""
    change = np.zeros((NIGHTS, N))
    change[40:, 1] = 1.2
    data = series(7, change)
    step = step_before_night_40(data)
    laws = breaks.with_breaks(data, (Law(),) * 5 + (None,), [step])
    solution = breaks.solved(data, laws)
    step = breaks.at_solution(data, solution, step)
    survey = Survey(data, laws, solution, breaks=(step,))
    (early, of_early), (late, of_late) = map(survey.values_at, (step.before, step.after))
    away = late - early
    for q in (0.1, 0.45, 0.55, 0.9):
        value, covariance = survey.values_at(step.before + q * (step.after - step.before))
        assert value == pytest.approx((1.0 - q) * early + q * late, rel=1e-9, abs=1e-12)
        mixture = (1.0 - q) * of_early + q * of_late + q * (1.0 - q) * np.outer(away, away)
        np.testing.assert_allclose(covariance, mixture, rtol=1e-7, atol=1e-9 * np.abs(mixture).max())


def test_a_break_of_a_survey_whose_law_is_left_out_is_found_anew(tmp_path):
    """Stacked again with laws of its nights that do not have it: once in the list, or not at all."""
    change = np.zeros((NIGHTS, N))
    change[40:, 5] = 1.2
    nights, laws = series(7, change).nights, {f"p{k}.x": law for k, law in enumerate(LAWS) if law}
    (step,) = stacking.stack(nights, laws).breaks
    night_file.write_nights(tmp_path / "nights.fits", nights)
    document = {"breaks": [dataclasses.asdict(step)], "events": []}
    (tmp_path / "survey.json").write_text(json.dumps(document))
    (again,) = stacking.stack([tmp_path], laws).breaks
    assert (again.name, again.date) == (step.name, step.date)
    assert stacking.stack([tmp_path], laws, find=False).breaks == ()
    kept = stacking.stack([tmp_path], laws | {"p5.x": Law(("step",), at=(step.date,))}, find=False)
    assert kept.breaks[0].size == pytest.approx(step.size)


def nightly():
    """A survey of nights with values of their own, at no known place, and its first two nights in a row."""
    data = series(0)
    k = next(k for k in range(NIGHTS) if data.nights[k + 1].mjd - data.nights[k].mjd == 1.0)
    return Survey(data, LAWS, breaks.solved(data, LAWS)), data.nights[k], data.nights[k + 1]


def test_stars_of_a_night_have_its_values_before_and_after_its_calibration():
    """Without a longitude as well: noon is in the middle of the longest part of the day without an exposure."""
    survey, night, other = nightly()
    in_it, _ = survey.values_at(night.mjd)
    for mjd in (night.begin - 0.05, night.end + 0.2):
        assert survey.values_at(mjd)[0][4] == in_it[4]
    assert survey.values_at(other.begin - 0.05)[0][4] == survey.values_at(other.mjd)[0][4] != in_it[4]


def test_stars_of_two_nights_with_values_of_their_own_are_refused():
    """Less than a day apart, they have no calibration in common."""
    survey, night, other = nightly()
    stars = in_memory({"MJD": [night.end + 0.1, other.begin - 0.01]})
    with pytest.raises(DataError, match=r"MJD.*spans two nights.*give a catalogue for every night"):
        survey_folder.calibration_of_stars(survey, stars)


def test_a_night_is_not_far_from_what_it_does_not_see():
    """A star that was seen in other nights alone, and is far from where these were linearised."""
    change = np.zeros((NIGHTS, N))
    change[:, 1] = 50.0
    keep = np.delete(np.arange(N), 1)
    blind = range(0, NIGHTS, 2)
    nights = list(series(7, change).nights)
    for k, night in zip(blind, (series(7).nights[k] for k in blind), strict=True):
        nights[k] = dataclasses.replace(
            night, parameters=tuple(night.parameters[i] for i in keep), reference=night.reference[keep],
            gradient=night.gradient[keep], matrix=night.matrix[np.ix_(keep, keep)],
        )  # fmt: skip
    data = together(nights)
    laws = [law and Law() for law in survey_folder.laws_of_all(data, {})]
    at_hand = dict.fromkeys((night.key for night in data.nights), stacking.Data(None, ""))
    away = stacking._distances(data, breaks.solved(data, laws), data.reference, at_hand)
    assert max(away[k] for k in blind) < 20.0 < 200.0 < min(away[k] for k in range(1, NIGHTS, 2))

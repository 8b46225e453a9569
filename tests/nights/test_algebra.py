"""Stacked normal equations against dense least squares with every unknown written out, and against Gaussian processes.

The dense systems are built here from the rows of data, without the code of the package: A x = b by `numpy.linalg`.
"""

import itertools

import numpy as np
import pytest

from walop_jax.model.laws import Law
from walop_jax.nights import algebra, changes

N = 6  # parameters, the last one a candidate
LAWS = {
    "shared": (Law(),) * 5 + (None,),
    "night": (Law(("night",)), Law(), Law(("night",), spread=0.3), Law(), Law(), None),
    "file": (Law(("file",)), Law(("night",)), Law(), Law(("file",), spread=0.2), Law(), None),
    "walk": (Law(("walk",), rate=0.1), Law(("walk",), rate=0.02), Law(), Law(), Law(("night",)), None),
    "all walk": (*(Law(("walk",), rate=0.05 * (k + 1)) for k in range(5)), None),
    "trends": (
        Law(("linear",)), Law(("annual",)), Law(("interval",), at=(170.5, 222.0)), Law(("step",), at=(205.0,)),
        Law(("walk", "step", "bad"), rate=0.05, at=(190.0,), bad=((200.0, 222.0),)), Law(("step",), at=(205.0,)),
    ),
}  # fmt: skip


def world(seed=0, nights=9, files=2, spanning=False):
    """Rows of data of every unit, the equations made of them, and priors about the origin."""
    rng = np.random.default_rng(seed)
    night = np.repeat(np.arange(nights), files)
    day = 100.0 + np.cumsum(7 * rng.integers(1, 6, nights))
    mjd = np.sort(day[night] + 0.1 * np.tile(np.arange(files), nights))
    file = np.arange(len(mjd))
    if spanning:
        file[files - 1 : files + 1] = file[files - 1]  # the last of a night and the first of the next
        file = np.unique(file, return_inverse=True)[1]
    rows = rng.normal(size=(len(mjd), 8, N)) * np.array([1.0, 30.0, 0.02, 1.0, 5.0, 2.0])
    data = rng.normal(size=(len(mjd), 8)) + rows @ np.array([0.5, 0.01, 20.0, -1.0, 0.1, 0.0])
    matrix = np.einsum("udi,udj->uij", rows, rows)
    scale = 1.0 / np.sqrt(np.einsum("uii->i", matrix))
    equations = algebra.Equations(
        mjd, night, file, np.sum(data**2, axis=1), -np.einsum("udi,ud->ui", rows, data) * scale,
        matrix * np.outer(scale, scale), scale,
    )  # fmt: skip
    return equations, rows, data, np.full(N, 0.1), np.array([3.0, np.inf, 50.0, 2.0, np.inf, np.inf])


def dense(laws, equations, mean, width):
    """Design (unit, parameter, unknown), prior precision and its pull on the unknowns, as the laws mean them."""
    columns, precision, centre = [], [], []
    units, middle = len(equations), equations.mjd.mean()

    def add(i, values, prior=0.0, about=0.0):
        column = np.zeros((units, N))
        column[:, i] = values
        columns.append(column)
        precision.append(prior)
        centre.append(about)

    walks = []
    for i, law in enumerate(laws):
        if law is None:
            continue
        own = (width[i] ** -2.0, mean[i])
        if law.base in ("shared", "") and not (law.base == "" and i == N - 1):
            add(i, np.ones(units), *own)
        if law.base in ("night", "file"):
            if law.spread:
                add(i, np.ones(units), *own)
                own = (law.spread**-2.0, 0.0)
            groups = getattr(equations, law.base)
            for g in np.unique(groups):
                add(i, groups == g, *own)
        if law.base == "walk":
            first = len(columns)
            nights = np.unique(equations.night)
            for k, g in enumerate(nights):
                add(i, equations.night == g, *(own if k == 0 else (0.0, 0.0)))
            walks.append((first, [equations.mjd[equations.night == g].mean() for g in nights], law.rate))
        if law.base == "interval":
            for low, high in itertools.pairwise((-np.inf, *law.at, np.inf)):
                add(i, (equations.mjd >= low) & (equations.mjd < high), *own)
        if "step" in law.per:
            for date in law.at:
                add(i, equations.mjd >= date)
        for low, high in law.bad:
            add(i, (equations.mjd >= low) & (equations.mjd < high))
        if "linear" in law.per:
            add(i, (equations.mjd - middle) / 365.25)
        if "annual" in law.per:
            add(i, np.cos(2 * np.pi * equations.mjd / 365.25))
            add(i, np.sin(2 * np.pi * equations.mjd / 365.25))
    prior = np.diag(precision)
    for first, times, rate in walks:
        for k, gone in enumerate(np.diff(times)):
            v = np.zeros(len(columns))
            v[first + k], v[first + k + 1] = -1.0, 1.0
            prior += np.outer(v, v) / (rate**2 * gone)
    return np.stack(columns, axis=2), prior, np.array(precision) * np.array(centre)


def solved(name, spanning=False):
    equations, rows, data, mean, width = world(spanning=spanning)
    means = np.array([True] * 5 + [False])
    system = algebra.System.of(equations, LAWS[name], mean, width, means)
    design, prior, pull = dense(LAWS[name], equations, mean, width)
    jacobian = np.einsum("udi,uix->udx", rows, design).reshape(-1, design.shape[2])
    normal = jacobian.T @ jacobian + prior
    unit = 1.0 / np.sqrt(np.diag(normal))
    covariance = unit[:, None] * np.linalg.inv(normal * np.outer(unit, unit)) * unit
    return algebra.solve(system), design, jacobian, data.reshape(-1), covariance, pull, rows


CASES = [(name, False) for name in LAWS] + [("file", True)]


@pytest.mark.parametrize(("name", "spanning"), CASES)
def test_values_and_errors_equal_dense_least_squares(name, spanning):
    found, design, jacobian, data, covariance, pull, _ = solved(name, spanning)
    x = covariance @ (jacobian.T @ data + pull)
    scale = found.system.equations.scale
    truth = design @ x
    error = np.sqrt(np.einsum("uix,xy,uiy->ui", design, covariance, design))
    assert np.abs(found.values * scale - truth).max() < 1e-6 * error.max()
    assert np.abs(found.values * scale - truth)[error > 0] == pytest.approx(
        0.0, abs=1e-6 * error[error > 0].min()
    )
    assert found.errors() * scale == pytest.approx(error, rel=1e-6, abs=1e-12)
    assert found.chi2 == pytest.approx(np.sum((data - jacobian @ x) ** 2), rel=1e-9)


@pytest.mark.parametrize("name", LAWS)
def test_prediction_in_a_night_holds_all_covariances(name):
    found, design, _, _, covariance, _, _ = solved(name)
    e = found.system.equations
    for unit in (0, 7, 17):
        night_mean = e.mjd[e.night == e.night[unit]].mean()
        value, matrix = found.predict(night_mean if "walk" in name else e.mjd[unit], int(e.night[unit]))
        if name == "trends":
            continue  # a walk is known at the middle of its night, trends at the time of the unit
        wanted = design[unit] @ covariance @ design[unit].T
        assert matrix * np.outer(e.scale, e.scale) == pytest.approx(wanted, rel=1e-6, abs=1e-10)
        assert value == pytest.approx(found.values[unit], abs=1e-9)


@pytest.mark.parametrize(("name", "spanning"), CASES)
def test_scores_of_changes_equal_a_fit_with_one_column_more(name, spanning):
    found, _, jacobian, data, covariance, pull, rows = solved(name, spanning)
    e, scan = found.system.equations, changes.scan(found)
    residual = data - jacobian @ (covariance @ (jacobian.T @ data + pull))
    left = np.eye(len(data)) - jacobian @ covariance @ jacobian.T
    for c, cell in enumerate(found.system.cells):
        for once in (False, True):
            units = cell.units if once else np.arange(cell.units[0], len(e))
            score, information = (of_kinds[int(once)] for of_kinds in scan)
            for j in range(N):
                column = np.zeros(rows.shape[:2])
                column[units] = rows[units, :, j]
                column = column.reshape(-1)
                wanted = column @ left @ column
                if wanted < 1e-7 * column @ column:
                    assert information[c, j] / e.scale[j] ** 2 < 1e-7 * column @ column
                    continue
                assert information[c, j] / e.scale[j] ** 2 == pytest.approx(wanted, rel=1e-5)
                assert score[c, j] / e.scale[j] == pytest.approx(column @ residual, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", ["night", "file", "walk", "trends"])
def test_a_few_changes_together(name):
    """Steps, one night and a drift, against a fit with all of these columns more."""
    found, _, jacobian, data, covariance, pull, rows = solved(name)
    e = found.system.equations
    weights = np.stack([e.night >= 3, e.night >= 5, e.night == 2, e.mjd - e.mjd.mean()], axis=1).astype(float)
    parameter = np.array([5, 5, 1, 3])
    score, information = changes.weighted(found, weights, parameter)
    residual = data - jacobian @ (covariance @ (jacobian.T @ data + pull))
    columns = np.einsum("udi,ui->udi", rows[:, :, parameter], weights).reshape(-1, 4)
    wanted = columns.T @ (np.eye(len(data)) - jacobian @ covariance @ jacobian.T) @ columns
    scale = e.scale[parameter]
    seen = np.diag(wanted) > 1e-6 * np.sum(columns**2, axis=0)
    assert score / scale == pytest.approx(columns.T @ residual, rel=1e-6, abs=1e-5)
    assert (information / np.outer(scale, scale))[np.ix_(seen, seen)] == pytest.approx(
        wanted[np.ix_(seen, seen)], rel=1e-5, abs=1e-5 * np.diag(wanted).max()
    )


def test_a_walk_is_a_gaussian_process():
    """One parameter, one datum a night: kriging with the kernel w² + r² (min(t, t') − t₀)."""
    rng = np.random.default_rng(3)
    mjd = 100.0 + np.cumsum(rng.exponential(4.0, 40))
    rate, width, noise = 0.1, 2.0, rng.uniform(0.1, 0.5, 40)
    data = np.cumsum(rng.normal(size=40)) * 0.2 + noise * rng.normal(size=40)
    one = np.arange(40)
    equations = algebra.Equations(
        mjd,
        one,
        one,
        (data / noise) ** 2,
        -(data / noise**2)[:, None],
        (noise**-2.0)[:, None, None],
        np.ones(1),
    )
    law = (Law(("walk",), rate=rate),)
    system = algebra.System.of(equations, law, np.zeros(1), np.full(1, width), np.ones(1, bool))
    found = algebra.solve(system)

    def kernel(a, b):
        return width**2 + rate**2 * (np.minimum(a[:, None], b[None]) - mjd[0])

    times = np.concatenate([mjd[:5], 0.5 * (mjd[1:] + mjd[:-1]), [mjd[-1] + 30.0]])
    weight = np.linalg.solve(kernel(mjd, mjd) + np.diag(noise**2), kernel(mjd, times))
    wanted, variance = (
        weight.T @ data,
        np.diag(kernel(times, times)) - np.sum(kernel(mjd, times) * weight, axis=0),
    )
    for k, time in enumerate(times):
        value, covariance = found.predict(float(time))
        assert value[0] == pytest.approx(wanted[k], abs=1e-6 * np.sqrt(variance[k]))
        assert covariance[0, 0] == pytest.approx(variance[k], rel=1e-6)


@pytest.mark.parametrize(
    ("law", "observed", "before", "later"),
    [
        (Law(("night", "step"), at=(59003.0,)), [0.0, 0.0, 0.0, 1.0, 1.0, 1.0], 0.0, 1.0),
        (Law(("night", "bad"), bad=((59002.0, 59003.0),)), [0.0, 0.0, 3.0, 0.0, 0.0, 0.0], 0.0, 0.0),
        (Law(("file", "step"), at=(59003.0,)), [2.0, 2.0, 2.0, 3.0, 3.0, 3.0], 2.0, 3.0),
    ],
)
def test_values_of_single_nights_and_a_step_elsewhere(law, observed, before, later):
    """In a night without data the values of single nights have their mean, beside the step that holds there."""
    found = of_one(law, observed)
    for time, wanted in ((58990.0, before), (59020.0, later)):
        value, covariance = found.predict(time)
        assert value[0] == pytest.approx(wanted, abs=0.02)
        assert covariance[0, 0] < 0.1**2  # a step is no scatter of the nights


def test_the_error_of_a_further_night_holds_that_of_the_mean():
    """Of n values with standard deviation s about their mean, another one is off by s √(1 + 1/n)."""
    value, covariance = of_one(Law(("night",)), [0.0, 1.0], width=np.inf).predict(59020.0)
    assert value[0] == pytest.approx(0.5, abs=1e-6)
    assert covariance[0, 0] == pytest.approx(0.5 * 1.5, rel=1e-6)


def of_one(law, observed, width=10.0):
    """Nights of one parameter, each observed to ±0.01."""
    data, count = np.array(observed), len(observed)
    precision, number = np.full(count, 1e4), np.arange(count)
    equations = algebra.Equations(
        59000.2 + number, number, number, precision * data**2, -(precision * data)[:, None],
        precision[:, None, None], np.ones(1),
    )  # fmt: skip
    return algebra.solve(
        algebra.System.of(equations, [law], np.zeros(1), np.full(1, width), np.ones(1, bool))
    )


def test_what_nothing_determines_is_named():
    equations, *_ = world()
    matrix, gradient = equations.matrix.copy(), equations.gradient.copy()
    matrix[4:6, 1], matrix[4:6, :, 1], gradient[4:6, 1] = (
        0.0,
        0.0,
        0.0,
    )  # the third night says nothing of parameter 1
    poor = algebra.Equations(
        equations.mjd, equations.night, equations.file, equations.chi2, gradient, matrix, equations.scale
    )
    laws = (Law(), Law(("night",)), Law(), Law(), Law(), None)
    system = algebra.System.of(poor, laws, np.zeros(N), np.full(N, np.inf), np.array([True] * 5 + [False]))
    with pytest.raises(algebra.UndeterminedError) as raised:
        algebra.solve(system)
    assert (raised.value.parameter, raised.value.unit) == (1, 4)

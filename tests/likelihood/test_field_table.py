"""Chebyshev series over a rectangle against numpy's polynomials and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.likelihood.field_table import FieldTable, accurate_table, held_out
from walop_jax.model import chebyshev
from walop_jax.model.chebyshev import Rectangle

LOW, HIGH = np.array([-0.3, -0.1]), np.array([0.2, 0.25])
RECTANGLE = Rectangle(LOW, HIGH)


@pytest.fixture(scope="module")
def places():
    x, y = np.random.default_rng(2).uniform(LOW[:, None], HIGH[:, None], (2, 50))
    return x, y


def scaled(x, y):
    return ((2 * v - a - b) / (b - a) for v, a, b in zip((x, y), LOW, HIGH, strict=True))


def interpolate(function, x, y, count, total=False):
    values = function(*chebyshev.grid(RECTANGLE, count))
    return FieldTable.through(RECTANGLE, count, values, total=total)(x, y)


def pole(x, y):
    """f = 1/(1.5 − t) in x: analytic inside the ellipse ρ = 1.5 + √1.25 = 2.618."""
    t, _ = scaled(x, y)
    return 1.0 / (1.5 - t) + 0.0 * y


def test_nodes_are_the_roots():
    coefficients = np.zeros(10)
    coefficients[9] = 1.0
    np.testing.assert_allclose(
        np.sort(chebyshev.nodes(9)), np.polynomial.chebyshev.chebroots(coefficients), atol=1e-14
    )


def test_polynomials_are_those_of_numpy():
    t = np.random.default_rng(1).uniform(-1, 1, (4, 5))
    expected = np.polynomial.chebyshev.chebvander(t, 8)
    np.testing.assert_allclose(chebyshev.polynomials(t, 9), expected, atol=1e-14)
    np.testing.assert_allclose(chebyshev.polynomials(jnp.asarray(t), 9), expected, atol=1e-14)


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("total", [False, True])
def test_polynomials_are_exact(places, count, total):
    """numpy's own Chebyshev series with random coefficients, of the degree that the series can carry."""
    coefficients = np.random.default_rng(count).standard_normal((count, count))
    if total:
        i, j = np.indices(coefficients.shape)
        coefficients[i + j >= count] = 0.0

    def series(x, y):
        return np.polynomial.chebyshev.chebval2d(*scaled(x, y), coefficients)

    np.testing.assert_allclose(interpolate(series, *places, count, total), series(*places), atol=1e-12)


def test_a_series_without_high_terms_is_that_of_numpy_without_them(places):
    full = FieldTable.through(RECTANGLE, 6, pole(*chebyshev.grid(RECTANGLE, 6)))
    half = FieldTable.through(RECTANGLE, 6, pole(*chebyshev.grid(RECTANGLE, 6)), total=True)
    square = full.coefficients.reshape(6, 6).copy()
    i, j = np.indices(square.shape)
    square[i + j >= 6] = 0.0
    expected = np.polynomial.chebyshev.chebval2d(*scaled(*places), square)
    np.testing.assert_allclose(half(*places), expected, atol=1e-13)


def test_the_series_passes_through_its_nodes():
    x, y = chebyshev.grid(RECTANGLE, 5)
    np.testing.assert_allclose(FieldTable.through(RECTANGLE, 5, np.eye(25))(x, y), np.eye(25), atol=1e-13)


def test_trees_go_through_jax(places):
    """What is tabulated may be a tuple of arrays of any shape; jax gives what numpy gives, and differentiates."""
    x, y = chebyshev.grid(RECTANGLE, 7)
    table = FieldTable.through(RECTANGLE, 7, (np.stack([x, y], axis=-1), (x * y)[:, None, None]))
    position, product = jax.jit(lambda t, a, b: t(a, b))(table, *map(jnp.asarray, places))
    np.testing.assert_allclose(position, np.stack(places, axis=-1), atol=1e-13)
    np.testing.assert_allclose(product[:, 0, 0], places[0] * places[1], atol=1e-13)
    slope = jax.grad(lambda a: table(a, jnp.asarray(0.1))[1][0, 0])(jnp.asarray(0.05))
    assert float(slope) == pytest.approx(0.1, rel=1e-11)


def test_error_falls_geometrically(places):
    """O(ρ⁻ⁿ)."""
    counts = np.array([6, 10, 14, 18, 22])
    errors = [np.abs(interpolate(pole, *places, int(n)) - pole(*places)).max() for n in counts]
    slope = np.polyfit(counts, np.log(errors), 1)[0]
    assert np.exp(-slope) == pytest.approx(1.5 + np.sqrt(1.25), rel=0.05)


def test_the_smallest_accurate_table_is_found():
    asked = []

    def exact(x, y):
        asked.append(len(x))
        return pole(x, y)

    def error(found, truth):
        return float(np.abs(found - truth).max())

    table, off = accurate_table(exact, RECTANGLE, (6, 10, 14, 18, 22), 1e-5, error)
    assert table is not None
    assert table.count == 14  # 2.618⁻¹⁴ = 1.4e-6, times the size of the function
    assert asked == [36 + 48, 100, 196]  # the held-out places once
    x, y = held_out(RECTANGLE)
    assert off == np.abs(table(x, y) - pole(x, y)).max() <= 1e-5
    assert accurate_table(exact, RECTANGLE, (6, 10), 1e-5, error)[0] is None
    # What is held against another truth is measured against that.
    _, off = accurate_table(exact, RECTANGLE, (14,), np.inf, error, truth=pole(x, y) + 1.0)
    assert off == pytest.approx(1.0, rel=1e-4)


def test_functions_that_are_not_finite_end_the_search():
    table, off = accurate_table(
        lambda x, y: np.where(x > 0.19, np.nan, x),
        RECTANGLE,
        (6, 10),
        1e-9,
        lambda a, b: float(np.abs(a - b).max()),
    )
    assert table is not None
    assert table.count == 6
    assert not np.isfinite(off)

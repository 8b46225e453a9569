"""Chebyshev interpolation over a rectangle against numpy's polynomials and closed forms."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model import chebyshev
from walop_jax.model.chebyshev import Rectangle

LOW, HIGH = np.array([-0.3, -0.1]), np.array([0.2, 0.25])
RECTANGLE = Rectangle(LOW, HIGH)


@pytest.fixture(scope="module")
def places():
    x, y = np.random.default_rng(2).uniform(LOW[:, None], HIGH[:, None], (2, 50))
    return x, y


def interpolate(function, x, y, count):
    weights = chebyshev.weights(jnp.asarray(x), jnp.asarray(y), RECTANGLE, count)
    return np.asarray(weights) @ function(*chebyshev.grid(RECTANGLE, count))


def test_nodes_are_the_roots():
    coefficients = np.zeros(10)
    coefficients[9] = 1.0
    np.testing.assert_allclose(
        np.sort(chebyshev.nodes(9)), np.polynomial.chebyshev.chebroots(coefficients), atol=1e-14
    )


@pytest.mark.parametrize("count", [2, 3, 6])
def test_polynomials_are_exact(places, count):
    """numpy's own Chebyshev series with random coefficients, of the degree that the nodes can carry."""
    coefficients = np.random.default_rng(count).standard_normal((count, count))

    def series(x, y):
        tx, ty = ((2 * v - a - b) / (b - a) for v, a, b in zip((x, y), LOW, HIGH, strict=True))
        return np.polynomial.chebyshev.chebval2d(tx, ty, coefficients)

    np.testing.assert_allclose(interpolate(series, *places, count), series(*places), atol=1e-12)


def test_weights_at_a_node_are_one_there():
    x, y = chebyshev.grid(RECTANGLE, 5)
    np.testing.assert_allclose(
        chebyshev.weights(jnp.asarray(x), jnp.asarray(y), RECTANGLE, 5), np.eye(25), atol=1e-13
    )


def test_error_falls_geometrically(places):
    """f = 1/(1.5 − t) in x: analytic inside the ellipse ρ = 1.5 + √1.25 = 2.618, so the error is O(ρ⁻ⁿ)."""

    def pole(x, y):
        t = (2 * x - LOW[0] - HIGH[0]) / (HIGH[0] - LOW[0])
        return 1.0 / (1.5 - t) + 0.0 * y

    counts = np.array([6, 10, 14, 18, 22])
    errors = [np.abs(interpolate(pole, *places, int(n)) - pole(*places)).max() for n in counts]
    slope = np.polyfit(counts, np.log(errors), 1)[0]
    assert np.exp(-slope) == pytest.approx(1.5 + np.sqrt(1.25), rel=0.05)

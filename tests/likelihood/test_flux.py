"""The flux eliminated: against projectors written out, and against derivatives of the eliminated residuals."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.likelihood.flux import eliminate_flux, project_flux


@pytest.mark.parametrize("cameras", [2, 4, 5])
def test_projection_is_that_of_the_matrix(cameras):
    """1 − ââᵀ, row by row; a known flux takes nothing, and neither does a row without light."""
    rng = np.random.default_rng(cameras)
    along, columns = rng.standard_normal((6, cameras)), rng.standard_normal((3, 6, cameras))
    along[4] = 0.0
    known = np.array([False, False, True, False, False, True])
    found = project_flux(columns, along, known)
    for e in range(6):
        size = along[e] @ along[e]
        taken = np.outer(along[e], along[e]) / size if size > 0 and not known[e] else 0.0
        expected = columns[:, e] @ (np.eye(cameras) - taken)
        np.testing.assert_allclose(found[:, e], expected, rtol=0, atol=1e-14)
    assert isinstance(found, np.ndarray)
    same = project_flux(jnp.asarray(columns), jnp.asarray(along), jnp.asarray(known))
    assert isinstance(same, jax.Array)
    np.testing.assert_allclose(same, found, rtol=0, atol=1e-14)


def test_columns_may_stand_before_or_behind_the_exposures():
    rng = np.random.default_rng(1)
    along, columns = rng.standard_normal((6, 4)), rng.standard_normal((3, 6, 4))
    known = np.arange(6) % 2 > 0
    front = project_flux(columns, along, known)
    behind = project_flux(columns.swapaxes(0, 1), along[:, None], known[:, None])
    np.testing.assert_array_equal(front, behind.swapaxes(0, 1))


def test_at_a_perfect_fit_it_is_the_derivative_of_the_residual():
    """r(θ) = y − F*(θ) a(θ) with F* the best flux; where r = 0 Kaufman's form is exact."""
    rng = np.random.default_rng(2)
    model = jnp.asarray(rng.uniform(1, 2, (5, 4)))
    slope = jnp.asarray(rng.standard_normal((5, 4)))
    data = 3.0 * model
    none = jnp.zeros(5, bool)
    exact = jax.jacfwd(lambda t: eliminate_flux(data, model + t * slope, none)[1])(0.0)
    np.testing.assert_allclose(-project_flux(3.0 * slope, model, none), exact, rtol=0, atol=1e-13)

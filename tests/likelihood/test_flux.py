"""The flux eliminated: against projectors written out, and against derivatives of the eliminated residuals."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.likelihood.flux import FluxGroups, eliminate_flux, project_flux
from walop_jax.likelihood.inverses import of_low_rank


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


TOGETHER = np.kron(np.eye(2), np.ones((2, 2)))  # two arms of two cameras
GROUPS = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # the first two exposures have their fluxes in common


def test_every_arm_has_a_flux_of_its_own():
    counts = np.array([[2.0, 4.0, 30.0, 60.0]])
    flux, left = eliminate_flux(
        counts, np.array([[1.0, 2.0, 1.0, 2.0]]), np.array([False]), FluxGroups(TOGETHER)
    )
    np.testing.assert_allclose(flux, [[2.0, 2.0, 30.0, 30.0]], rtol=1e-14)
    np.testing.assert_allclose(left, 0.0, atol=1e-13)


def test_exposures_of_a_group_share_the_flux_of_an_arm():
    """Arm 1 of exposures 1 and 2: F = (1·1 + 0·1 + 3·2 + 1·0) / (1 + 1 + 4 + 0) = 7/6."""
    model = np.array([[1.0, 1.0, 1.0, 1.0], [2.0, 0.0, 1.0, 3.0], [1.0, 1.0, 2.0, 2.0]])
    counts = np.array([[1.0, 0.0, 2.0, 2.0], [3.0, 1.0, 2.0, 6.0], [5.0, 5.0, 1.0, 3.0]])
    shared = FluxGroups(TOGETHER, GROUPS)
    flux, left = eliminate_flux(counts, model, np.zeros(3, bool), shared)
    np.testing.assert_allclose(flux[:, 0], [7 / 6, 7 / 6, 5.0], rtol=1e-14)
    np.testing.assert_allclose(flux[:, 2], [2.0, 2.0, 1.0], rtol=1e-14)
    np.testing.assert_allclose(left[0], [1 - 7 / 6, -7 / 6, 0.0, 0.0], atol=1e-14)


def test_what_a_shared_flux_can_follow_is_taken_out_and_nothing_else():
    """The projector is 1 − A A⁺ with a column of A for each flux: numpy's pseudo-inverse makes it."""
    rng = np.random.default_rng(5)
    along, columns = rng.uniform(0.5, 2.0, (3, 4)), rng.standard_normal((2, 3, 4))
    fluxes = [
        (along * GROUPS[:, group, None] * TOGETHER[2 * arm]).ravel() for group in (0, 1) for arm in (0, 1)
    ]
    a = np.stack(fluxes, axis=1)
    expected = columns.reshape(2, -1) @ (np.eye(12) - a @ np.linalg.pinv(a))
    found = project_flux(columns, along, np.zeros(3, bool), FluxGroups(TOGETHER, GROUPS))
    np.testing.assert_allclose(found.reshape(2, -1), expected, rtol=0, atol=1e-13)


def test_what_exposures_have_in_common_is_taken_out_of_their_covariance():
    """1 − U Uᵀ squared is the inverse of 1 + A Aᵀ, for columns of any size side by side, and for none; and back."""
    rng = np.random.default_rng(4)
    responses = rng.normal(size=(3, 5, 4, 2)) * np.array([1e-3, 30.0])
    responses[2] = 0.0
    shared = FluxGroups(stars=of_low_rank(responses))
    values = rng.normal(size=(7, 3, 5, 4))
    found = shared.independent(values)
    for point in range(3):
        a = responses[point].reshape(20, 2)
        value, vector = np.linalg.eigh(np.eye(20) + a @ a.T)
        root = vector / np.sqrt(value) @ vector.T
        np.testing.assert_allclose(
            found[:, point].reshape(7, 20), values[:, point].reshape(7, 20) @ root, atol=1e-12
        )
    np.testing.assert_allclose(shared.independent(found, inverse=True), values, atol=1e-9)
    assert not shared.single

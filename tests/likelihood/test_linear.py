"""Derivatives in pieces (optics, plain parameters, local throughputs) against plain forward differentiation."""

from __future__ import annotations

import dataclasses

import builders
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_run import small_fit

from walop_jax.data.settings import Settings
from walop_jax.likelihood import optics
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.base import Context
from walop_jax.model.parameters import leaves, values_of, with_values
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.specification import series_indices

X, Y = jnp.asarray(0.21), jnp.asarray(-0.13)
# One acts in the optics, one at the telescope, one on the cameras, one in the optics and nowhere else.
EFFECTS = (
    ("hwp1_axis", {"angle": 0.3}), ("telescope_polarisation", {"q": 0.01, "u": -0.004}),
    ("camera_leakage", {"share": 0.02}), ("hwp_temperature", {"coefficient": 0.7}),
)  # fmt: skip


@pytest.fixture(scope="module")
def instrument():
    context = Context(exposures=1, sources=("STD00",))
    effects = [effect_by_name(name).of(context, **numbers) for name, numbers in EFFECTS]
    return builders.south(np.random.default_rng(2), effects, standards=[("STD00", 0.01, 0.02)])


@pytest.fixture(scope="module")
def plan(instrument):
    settings = Settings.default(2, "band").at(CHWP=np.array([np.nan, 22.5]))
    settings = dataclasses.replace(settings, temperature=np.full(2, 4.0))
    return plan_for_settings(instrument, settings, {"band": builders.monochromatic(0.62)})


def matrix_of(instrument, rows, throughput):
    vectors = light.camera_vectors(instrument, rows, throughput, X, Y)
    return light.instrument_matrix(vectors @ light.telescope(instrument, X, Y), instrument.cameras.pairs)


def test_derivatives_are_those_of_forward_differentiation(instrument, plan):
    """Every parameter, whatever it acts on, and the value itself."""
    to_instrument = with_values(instrument)

    def whole(values):
        there = to_instrument(values)
        value = matrix_of(there, light.band_rows(there, plan, X, Y), there.throughput.at(X, Y))
        return value, value

    def quantity(values, local):
        return matrix_of(to_instrument(values), optics.band_rows(values, instrument, plan, X, Y), local)

    def pieces(values):
        there = to_instrument(values)
        found = optics.linearised(there, quantity, there.throughput.at(X, Y))
        basis = there.throughput.basis(X, Y)[None]
        return optics.to_all(there, found.plain, found.local, basis), found.value

    # Compiled as wholes: operation by operation they take 700 compilations.
    values = values_of(instrument)
    derivative, value = compiled(pieces)(values)
    expected, expected_value = compiled(jax.jacfwd(whole, has_aux=True))(values)
    assert derivative.shape == (2, 2, 3, values.size)
    # Phases of thousands of waves: what compilers may reorder is 10⁻¹² of the matrix.
    np.testing.assert_allclose(value, expected_value, rtol=0, atol=1e-11)
    scale = np.abs(expected).max(axis=(0, 1, 2))
    np.testing.assert_allclose(
        derivative / np.where(scale > 0, scale, 1.0), expected / np.where(scale > 0, scale, 1.0), atol=1e-11
    )
    # What the matrix does not depend on: the sky, the stars, the overall scale of the throughput.
    still = [leaf.name for leaf, size in zip(leaves(instrument), scale, strict=True) if size == 0]
    assert still == ["sky.depolarisation", "standard.STD00.q", "standard.STD00.u"]


def test_positions_are_all_parameters_once(instrument):
    plain, series = optics.plain_positions(instrument), series_indices(instrument)
    assert sorted([*plain, *series]) == list(range(values_of(instrument).size))
    assert all(leaves(instrument)[i].name.startswith("throughput.n") for i in series)


def test_local_derivatives_go_through_the_series():
    """Σ over the sites, written out; numpy gives numpy, jax gives jax."""
    rng = np.random.default_rng(3)
    local, basis = rng.standard_normal((5, 2, 3)), rng.standard_normal((2, 6))
    expected = np.zeros((5, 3, 6))
    for site in range(2):
        for camera in range(3):
            for term in range(6):
                expected[:, camera, term] += local[:, site, camera] * basis[site, term]
    found = optics.through_series(local, basis)
    assert isinstance(found, np.ndarray)
    np.testing.assert_allclose(found, expected.reshape(5, 18), rtol=0, atol=1e-14)
    same = optics.through_series(jnp.asarray(local), jnp.asarray(basis))
    assert isinstance(same, jax.Array)
    np.testing.assert_allclose(same, found, rtol=0, atol=1e-14)


@pytest.mark.parametrize("interpolate", [False, True])
def test_one_pass_gives_residuals_and_their_derivatives(interpolate):
    """29 points in two batches; where optics are interpolated the residuals are those of the interpolation.

    The derivatives make the gradient of χ².
    """
    result = small_fit()
    likelihood = Likelihood.of(result.calset, result.model, batch=16, interpolate=interpolate)
    flux, residual, jacobian = likelihood.linearised(result.values)
    fluxes, residuals = likelihood.residuals(result.values)
    np.testing.assert_allclose(flux, fluxes, rtol=1e-12)
    np.testing.assert_allclose(residual, residuals, atol=1e-9)
    # Away from the minimum, where χ² has a slope; that of the projected residuals is exact (Golub & Pereyra 1973).
    moved = result.values + 3.0 * result.sigma
    _, residual, jacobian = likelihood.linearised(moved)
    gradient = jacobian.T @ residual[likelihood.used].reshape(-1)
    for k, position in ((k, result.model.free[k]) for k in (0, 7, 40)):
        step = 1e-3 * result.sigma * (np.arange(len(moved)) == position)
        above, below = (np.sum(likelihood.residuals(moved + sign * step)[1] ** 2) for sign in (1, -1))
        assert gradient[k] == pytest.approx((above - below) / (4.0 * step[position]), rel=1e-5)

"""Metal mirrors against pyElli and the limits of Fresnel's equations."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model.elements.spectral import Mirror
from walop_jax.model.ray import Conditions, Ray


def matrix(n: float, k: float, incidence: float, axis: float = 0.0) -> np.ndarray:
    spectrum = jnp.array([0.55]), Conditions(band_width=jnp.zeros(1), planned={})
    ray = Ray.entering(jnp.zeros(()), jnp.zeros(()), spectrum)
    metal = Mirror(
        n=jnp.array([n]), k=jnp.array([k]), n_at=(0.55,), k_at=(0.55,),
        incidence=jnp.array(incidence), axis=jnp.array(axis),
    )  # fmt: skip
    return np.asarray(metal.mueller(ray))[0]


@pytest.mark.parametrize("metal", [(0.96, 6.69), (0.13, 3.2), (2.9, 3.1)])
@pytest.mark.parametrize("incidence", [15.0, 45.0, 80.0])
def test_reflectances_and_phase_are_those_of_pyelli(metal, incidence):
    elli = pytest.importorskip("elli")
    metal_, air = (elli.IsotropicMaterial(elli.ConstantRefractiveIndex(n)) for n in (complex(*metal), 1.0))
    found = elli.Structure(air, [], metal_).evaluate(550.0, incidence)
    p, s = np.ravel(found.R_pp).item(), np.ravel(found.R_ss).item()
    m = matrix(*metal, incidence)
    assert m[0, 1] == pytest.approx((p - s) / (p + s), abs=1e-12)
    assert np.hypot(m[2, 2], m[2, 3]) == pytest.approx(2 * np.sqrt(p * s) / (p + s), abs=1e-12)
    # The sign of r_p, and so 180 deg of the phase, is a matter of convention.
    phase = np.angle(np.ravel(found.jones_matrix_r)[0] / np.ravel(found.jones_matrix_r)[3])
    assert abs(np.sin(np.arctan2(m[2, 3], m[2, 2]))) == pytest.approx(abs(np.sin(phase)), abs=1e-9)


def test_limits():
    np.testing.assert_allclose(matrix(1.2, 7.0, 0.0), np.diag([1.0, 1.0, -1.0, -1.0]), atol=1e-12)
    glass = matrix(
        1.5, 0.0, np.rad2deg(np.arctan(1.5))
    )  # Brewster: nothing polarised in the plane of incidence
    np.testing.assert_allclose(glass @ [1, 1, 0, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(matrix(1.0, 1e6, 45.0)[:, 0], [1, 0, 0, 0], atol=1e-5)


def test_a_good_conductor_polarises_across_the_plane_of_incidence():
    """(R_s − R_p)/(R_s + R_p) ≈ 2 n sin θ tan θ/(n² + k²) where n² + k² is large (Born & Wolf, 14.2)."""
    n, k = 1.0, 60.0
    expected = 2 * n * np.sin(np.pi / 4) / (n**2 + k**2)
    assert matrix(n, k, 45.0)[1, 0] == pytest.approx(-expected, rel=2e-3)
    assert matrix(n, k, 45.0, axis=45.0)[2, 0] == pytest.approx(-expected, rel=2e-3)

"""Ray geometry against Snell's law in plain vectors and against numbers worked out by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model.elements import geometry

DIRECTIONS = [(0.0, 0.0), (0.05, -0.03), (-0.09, 0.08), (0.08, 0.0), (0.0, -0.1)]


def snell(k, normal, before, after):
    """Refraction in the plane of incidence, from the angles themselves: sin b = before/after sin a."""
    along = k @ normal
    across = k - along * normal
    sine = np.linalg.norm(across)
    if sine < 1e-15:
        return normal.copy()
    refracted = np.arcsin(before / after * sine)
    return np.cos(refracted) * normal + np.sin(refracted) * across / sine


@pytest.mark.parametrize("wedge", [-0.23, 0.23, 0.02, -0.4])
@pytest.mark.parametrize("index", [1.5155, 1.52, 1.8])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_wedge_obeys_snell_at_both_faces(wedge, index, direction):
    k = np.array([*direction, np.sqrt(1 - np.sum(np.square(direction)))])
    front, rear = np.array([np.sin(wedge), 0.0, np.cos(wedge)]), np.array([0.0, 0.0, 1.0])
    expected = snell(snell(k, front, 1.0, index), rear, index, 1.0)
    found = geometry.behind_wedge(tuple(jnp.asarray(v) for v in k), jnp.asarray(wedge), jnp.asarray(index))
    np.testing.assert_allclose(found, expected[:2], atol=1e-14)


def test_wedge_tilts_the_axis_by_almost_seven_degrees():
    """BK7, 0.230 rad, axial ray, by calculator: asin(1.515539 sin(0.23 − asin(sin 0.23 / 1.515539)))."""
    one = jnp.asarray(1.0)
    sx, sy = geometry.behind_wedge((0 * one, 0 * one, one), 0.23 * one, 1.515539 * one)
    assert np.rad2deg(np.arcsin(float(sx))) == pytest.approx(6.8692077, abs=1e-6)
    assert float(sy) == 0.0


def test_wedge_of_no_angle_leaves_the_ray():
    k = tuple(jnp.asarray(v) for v in (0.1, -0.2, np.sqrt(0.95)))
    np.testing.assert_allclose(
        geometry.behind_wedge(k, jnp.asarray(0.0), jnp.asarray(1.5)), [0.1, -0.2], atol=1e-16
    )


# X, Y (deg), magnification, distortion, then the tangents of the two field angles, by calculator
HAND = [
    ((0.0, 0.0, 15.63, 0.02), (0.0, 0.0)),
    # 15.63 × 0.29 = 4.5327°
    ((0.29, 0.0, 15.63, 0.0), (0.0792759904, 0.0)),
    # r² = 0.1682, stretch 1.003364, 4.5479480°
    ((0.29, -0.29, 15.63, 0.02), (0.0795437964, -0.0795437964)),
]


@pytest.mark.parametrize(("arguments", "tangents"), HAND)
def test_field_point_leaves_in_the_direction_worked_out_by_hand(arguments, tangents):
    kx, ky, kz = geometry.pupil_direction(*(jnp.asarray(v) for v in arguments))
    np.testing.assert_allclose([kx / kz, ky / kz], tangents, atol=1e-10)
    assert float(kx**2 + ky**2 + kz**2) == pytest.approx(1.0, abs=1e-15)

"""Mueller algebra against matrices typed by hand and against identities."""

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model import mueller
from walop_jax.model.mueller import inverse2, product2

ANGLES = np.deg2rad([0.0, 17.0, 22.5, 45.0, 90.0, 133.0])


def jones(matrix):
    return jnp.asarray(matrix, complex)


def random_jones(rng, count=20):
    parts = rng.standard_normal((4, count)) + 1j * rng.standard_normal((4, count))
    return jnp.asarray(parts.reshape(2, 2, count)), parts.T.reshape(count, 2, 2)


# -------------------------------------------------------------------------------------- hand-typed matrices

TYPED = {
    # fields exp(i(kz − ωt)): the slow axis gains phase
    "quarter wave, fast axis X": ([[1, 0], [0, 1j]],
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]]),
    "quarter wave, fast axis Y": ([[1j, 0], [0, 1]],
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]]),
    "half wave, axis X": ([[1, 0], [0, -1]], np.diag([1, 1, -1, -1])),
    "half wave, axis 45°": ([[0, 1], [1, 0]], np.diag([1, -1, 1, -1])),
    "rotator by 90°": ([[0, -1], [1, 0]], np.diag([1, -1, -1, 1])),
    "polariser X": ([[1, 0], [0, 0]],
        0.5 * np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])),
    "polariser Y": ([[0, 0], [0, 1]],
        0.5 * np.array([[1, -1, 0, 0], [-1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])),
    "polariser 45°": ([[0.5, 0.5], [0.5, 0.5]],
        0.5 * np.array([[1, 0, 1, 0], [0, 0, 0, 0], [1, 0, 1, 0], [0, 0, 0, 0]])),
    # passes Ex = i Ey, that is V = 2 Im Ex Ey* > 0
    "circular polariser, V > 0": ([[0.5, 0.5j], [-0.5j, 0.5]],
        0.5 * np.array([[1, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 1]])),
}  # fmt: skip


@pytest.mark.parametrize("name", TYPED)
def test_from_jones_of_hand_typed_elements(name):
    matrix, expected = TYPED[name]
    np.testing.assert_allclose(mueller.from_jones(jones(matrix)), expected, atol=1e-15)


def test_from_jones_moves_stokes_vectors_as_the_field_moves():
    """S of J E is M S of E, with S written out from the field, for random matrices and fields."""
    rng = np.random.default_rng(1)
    ours, matrices = random_jones(rng)
    field = rng.standard_normal((20, 2)) + 1j * rng.standard_normal((20, 2))

    def stokes(e):
        cross = e[:, 0] * e[:, 1].conj()
        power = np.abs(e) ** 2
        return np.stack([power.sum(1), power[:, 0] - power[:, 1], 2 * cross.real, 2 * cross.imag], -1)

    after = np.einsum("nij,nj->ni", matrices, field)
    moved = np.einsum("nij,nj->ni", np.asarray(mueller.from_jones(ours)), stokes(field))
    np.testing.assert_allclose(moved, stokes(after), rtol=1e-12, atol=1e-12)


def test_products_and_inverses_of_two_by_two_matrices():
    rng = np.random.default_rng(2)
    (a, matrix_a), (b, matrix_b) = random_jones(rng), random_jones(rng)

    def back(m):
        return np.asarray(m).reshape(4, -1).T.reshape(-1, 2, 2)

    np.testing.assert_allclose(back(product2(a, b)), matrix_a @ matrix_b, rtol=1e-12)
    np.testing.assert_allclose(back(inverse2(a)), np.linalg.inv(matrix_a), rtol=1e-10, atol=1e-12)


# ------------------------------------------------------------------------------------------------ identities


PURE = {
    "jones": lambda rng: mueller.from_jones(random_jones(rng)[0]),
    "retarder": lambda rng: mueller.retarder(*jnp.asarray(rng.uniform(0, 7, (2, 20)))),
    "diattenuator": lambda rng: mueller.diattenuator(
        jnp.asarray(rng.uniform(-0.6, 0.6, 20)), jnp.asarray(0.5)
    ),
    "rotation": lambda _: mueller.rotation(jnp.asarray(ANGLES)),
}


@pytest.mark.parametrize("made", PURE.values(), ids=PURE)
def test_pure_elements_do_not_depolarise(made):
    """Tr(MᵀM) = 4 M00² (Gil & Bernabeu 1985)."""
    matrix = np.asarray(made(np.random.default_rng(3)))
    np.testing.assert_allclose(np.sum(matrix**2, (-2, -1)), 4 * matrix[..., 0, 0] ** 2, rtol=1e-12)


@pytest.mark.parametrize("axis", ANGLES)
@pytest.mark.parametrize("delta", [0.0, 0.4, np.pi / 2, np.pi, 4.0])
def test_retarder_is_a_rotation_that_keeps_its_axis(delta, axis):
    matrix = np.asarray(mueller.retarder(jnp.asarray(delta), jnp.asarray(axis)))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(4), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-13)
    along = np.array([1.0, np.cos(2 * axis), np.sin(2 * axis), 0.0])
    np.testing.assert_allclose(matrix @ along, along, atol=1e-14)
    # the paper builds it by turning axes: M_rot(−α) M_δ M_rot(α)
    turn, back = (np.asarray(mueller.rotation(jnp.asarray(a))) for a in (axis, -axis))
    plain = np.asarray(mueller.retarder(jnp.asarray(delta), jnp.asarray(0.0)))
    np.testing.assert_allclose(matrix, back @ plain @ turn, atol=1e-14)


def test_retarder_of_zero_retardance_does_nothing():
    np.testing.assert_array_equal(mueller.retarder(jnp.asarray(0.0), jnp.asarray(0.0)), np.eye(4))


def test_rotation_turns_the_frame_by_its_angle():
    """Light along 30° is +q in axes turned by 30°."""
    stokes = np.array([1, np.cos(np.pi / 3), np.sin(np.pi / 3), 0.2])
    turned = np.asarray(mueller.rotation(jnp.asarray(np.pi / 6))) @ stokes
    np.testing.assert_allclose(turned, [1, 1, 0, 0.2], atol=1e-15)


def test_diattenuator_of_zero_is_the_identity_and_smooth():
    np.testing.assert_array_equal(mueller.diattenuator(jnp.asarray(0.0), jnp.asarray(0.0)), np.eye(4))


def test_diattenuator_is_that_of_a_jones_matrix():
    """Intensity transmissions 1.3 along X and 0.7 across: D = 0.3, field transmissions their roots."""
    expected = mueller.from_jones(jones(np.diag(np.sqrt([1.3, 0.7]))))
    np.testing.assert_allclose(mueller.diattenuator(jnp.asarray(0.3), jnp.asarray(0.0)), expected, atol=1e-15)
    slanted = np.sqrt(1.3) * np.full((2, 2), 0.5) + np.sqrt(0.7) * np.array([[0.5, -0.5], [-0.5, 0.5]])
    found = mueller.diattenuator(jnp.asarray(0.0), jnp.asarray(0.3))
    np.testing.assert_allclose(found, mueller.from_jones(jones(slanted)), atol=1e-15)


def test_polarised_light():
    """(1, c cos 2θ, c sin 2θ, 0), c = (1 − ε)/(1 + ε): ε = 2e-5 gives 0.99996000080, ε = 1 unpolarised."""
    angle = jnp.asarray(np.deg2rad([0.0, 45.0, 90.0, 30.0]))
    found = mueller.polarised(angle, 2e-5)
    c = 0.9999600007999840
    expected = [[1, c, 0, 0], [1, 0, c, 0], [1, -c, 0, 0], [1, 0.5 * c, np.sqrt(0.75) * c, 0]]
    np.testing.assert_allclose(found, expected, atol=1e-14)
    np.testing.assert_array_equal(mueller.polarised(angle, 1.0)[:, 1:], 0.0)

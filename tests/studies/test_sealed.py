"""The sealed generator against the oracle that it is made of, and against closed forms of what it hides."""

import numpy as np
import pytest
from oracle import forward
from studies.sealed import generators
from studies.sealed_optics import Hidden, full_mueller, vectors

X, Y = np.array([0.0, 0.2, -0.13]), np.array([0.1, -0.22, 0.0])
BAND = np.array([0.58, 0.66]), np.array([0.4, 0.6])


def params():
    made = forward.nominal()
    made["throughput"][:, 3] = (0.01, -0.02, 0.015, 0.0)
    return made


def hidden(where, generator, **changed):
    nothing = Hidden(
        "", where, 1e-3, generator, lambda x, y: 1.0 + x, np.ones_like, np.ones(1), 1.0, np.zeros(4)
    )
    return nothing._replace(**changed)


def test_without_anything_hidden_it_is_the_oracle():
    plain, added = vectors(params(), X, Y, BAND, None)
    np.testing.assert_allclose(plain, forward.analysis_vectors(params(), X, Y, *BAND), atol=1e-13)
    assert not added.any()


def test_mueller_matrices_of_an_attenuator_and_of_a_quarter_wave_plate():
    found = full_mueller(np.array([np.diag([1.0, 0.5]), np.diag([1.0, 1.0j])]))
    np.testing.assert_allclose(
        found[0], [[0.625, 0.375, 0, 0], [0.375, 0.625, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 0.5]]
    )
    np.testing.assert_allclose(
        np.abs(found[1]), [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]], atol=1e-15
    )


@pytest.mark.parametrize("where", ["behind polariser", "behind collimator", "half 1", "half 2"])
def test_light_that_is_lost_everywhere_is_a_matter_of_throughput(where):
    """A = −1: what it adds is −a f times the vectors, in the half that it is in."""
    plain, added = vectors(params(), X, Y, BAND, hidden(where, -np.eye(4)))
    lost = -1e-3 * (1.0 + X)[:, None, None] * plain
    if where.startswith("half"):
        lost[:, 2:] *= where == "half 2"
        lost[:, :2] *= where == "half 1"
    np.testing.assert_allclose(added, lost, atol=1e-15)


def test_crossed_polarisers_give_no_less_than_no_light():
    """A turn of 10⁻³ rad behind the polariser: rows of the matrix exponential, to the third order of the turn."""
    turn = np.zeros((4, 4))
    turn[1, 2], turn[2, 1] = -1.0, 1.0
    one = hidden("behind polariser", turn, field=lambda x, y: np.ones(x.shape))
    plain, added = vectors(params(), X, Y, BAND, one)
    seen = plain + added + vectors(params(), X, Y, BAND, one.second)[1]
    turned = np.array([[np.cos(1e-3), -np.sin(1e-3)], [np.sin(1e-3), np.cos(1e-3)]])
    exact = plain.copy()
    exact[..., 1:3] = plain[..., 1:3] @ turned
    np.testing.assert_allclose(seen, exact, atol=1e-9)


def test_a_drawn_perturbation_is_near_a_physical_one():
    """To first order no light gains a degree of polarisation beyond 1."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        made = np.eye(4) + 1e-4 * generators(rng)
        state = rng.standard_normal((3, 50))
        light = made @ np.vstack([np.ones(50), state / np.linalg.norm(state, axis=0)])
        assert np.all(np.linalg.norm(light[1:], axis=0) <= light[0] * (1.0 + 1e-7))

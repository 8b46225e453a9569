"""Plates in contact against pyElli, another program: Berreman's 4 × 4 transfer matrices.

Frame       pyElli puts the plane of incidence into its xz plane (k_x ≥ 0, z along the light) and works with
            fields that go as exp(−iωt), as we do: a layer is exp(+i k_0 Δ z) on (Ex, Ey, Hx, Hy). Its
            p and s of a forward wave are p = (cos ϑ, 0, −sin ϑ) and s = (0, 1, 0), so p × s = k, and they are
            its x and y axes carried to k by the smallest rotation. For a ray of azimuth φ the crystals are
            turned by −φ, and as carrying commutes with a turn about z, the carried ICS axes follow by
            (E_p, E_s) = R(φ)(E_x, E_y), R the turn of axes by φ: J = R(φ)ᵀ J_ps R(φ). No sign is changed.
Stokes      M = A (J ⊗ J*) A⁻¹ with A typed below, V = 2 Im Ex Ey* as in `conventions.py`.
Fringes     pyElli keeps the waves reflected to and fro, the base model drops them. Both plates are stepped over
            fringes (one is λ / 2k_z of thickness; quarters of it, triangular weights over ± 1), which leaves
            the retardance alone but for some 0.01 rad:
            - the mean of J, phase of one pass taken out, kills every term that has been reflected (they turn
              by 1, 2, … turns in a fringe): it is the single pass itself but for that retardance, 4e-5;
            - the mean of M adds the intensity of light reflected twice. Faces of reflectance 4.6 %
              (air–quartz), 0.3 % (quartz–MgF2), 2.5 % (MgF2–air) send back a share
              R1 R2 + R2 R3 + R1 R3 = 1.4e-3 of the 93 % that pass once, so elements of M, not normalised, may
              differ by up to 1.3e-3 in either sense.
"""

from __future__ import annotations

import elli
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import forward

from walop_jax.model import plates
from walop_jax.model.plates import Plate

CASES = 40
STEPS = [(n / 4, (4 - abs(n)) / 16) for n in range(-3, 4)]  # in fringes, with weights
A = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, -1j, 1j, 0]])


def mueller(jones):
    pairs = np.einsum("...ij,...kl->...ikjl", jones, jones.conj()).reshape(*jones.shape[:-2], 4, 4)
    return (A @ pairs @ np.linalg.inv(A)).real


def layer(ordinary, extraordinary, axis, thickness):
    """pyElli's crystal (optic axis along its z) laid into the surface and turned to `axis` (deg); µm."""
    crystal = elli.UniaxialMaterial(
        elli.ConstantRefractiveIndex(ordinary), elli.ConstantRefractiveIndex(extraordinary)
    )
    into_surface = elli.rotation_v_theta(np.array([0.0, 1.0, 0.0]), 90.0)
    crystal.set_rotation(elli.rotation_v_theta(np.array([0.0, 0.0, 1.0]), axis) @ into_surface)
    return elli.Layer(crystal, thickness * 1e3)


def transfer_jones(case, quartz, mgf2):
    """pyElli's complete Jones matrix (all reflections) in the carried ICS axes."""
    turned = case["axis"] - case["azimuth"]
    stack = [layer(*case["quartz"], turned, quartz), layer(*case["mgf2"], turned + 90.0, mgf2)]
    result = elli.Structure(elli.AIR, stack, elli.AIR).evaluate(
        np.array([case["wavelength"] * 1e3]),
        case["incidence"],
        solver=elli.Solver4x4,
        propagator=elli.solver4x4.PropagatorEig(),
    )
    c, s = np.cos(np.deg2rad(case["azimuth"])), np.sin(np.deg2rad(case["azimuth"]))
    turn = np.array([[c, s], [-s, c]])
    return turn.T @ result.jones_matrix_t[0] @ turn


def over_the_fringes(case):
    """Single-pass Mueller matrix (mean field) and Mueller matrix of all passes (mean intensity)."""
    sine2 = np.sin(np.deg2rad(case["incidence"])) ** 2
    k_q, k_m = (np.sqrt(np.mean(case[name]) ** 2 - sine2) for name in ("quartz", "mgf2"))
    field, intensity = 0.0, 0.0
    for i, weight_i in STEPS:
        for j, weight_j in STEPS:
            d_q, d_m = i * case["wavelength"] / (2 * k_q), j * case["wavelength"] / (2 * k_m)
            jones = transfer_jones(case, case["d_quartz"] + d_q, case["d_mgf2"] + d_m)
            phase = 2 * np.pi / case["wavelength"] * (k_q * d_q + k_m * d_m)
            field = field + weight_i * weight_j * jones * np.exp(-1j * phase)
            intensity = intensity + weight_i * weight_j * mueller(jones)
    return mueller(field), intensity


def make_cases():
    rng = np.random.default_rng(20)
    cases = []
    for i in range(CASES):
        wavelength = rng.uniform(0.5, 0.75)
        cases.append(
            {
                "wavelength": wavelength,
                "incidence": 14.0 * np.sqrt(rng.uniform()) if i else 0.0,
                "azimuth": rng.uniform(0.0, 360.0),
                "axis": rng.uniform(0.0, 180.0),
                "quartz": [float(n) for n in forward.quartz(wavelength)],
                "mgf2": [float(n) for n in forward.mgf2(wavelength)],
                "d_quartz": rng.uniform(2300.0, 2500.0),
                "d_mgf2": rng.uniform(1850.0, 2000.0),
            }
        )
    return cases


@pytest.fixture(scope="module")
def compared():
    """(ours, pyElli's single pass, pyElli's mean over the fringe), each (case, 4, 4)."""
    cases = make_cases()

    def column(name):
        return jnp.asarray([case[name] for case in cases])

    sine = np.sin(np.deg2rad([case["incidence"] for case in cases]))
    azimuth = np.deg2rad([case["azimuth"] for case in cases])
    axis = jnp.deg2rad(column("axis"))
    (q_o, q_e), (m_o, m_e) = column("quartz").T, column("mgf2").T
    stack = (
        Plate(column("d_quartz"), q_o, q_e, axis),
        Plate(column("d_mgf2"), m_o, m_e, axis + 0.5 * jnp.pi),
    )
    sx, sy = jnp.asarray(sine * np.cos(azimuth)), jnp.asarray(sine * np.sin(azimuth))
    ours = np.asarray(plates.stack_mueller(sx, sy, stack, column("wavelength")))
    single, mean = zip(*map(over_the_fringes, cases), strict=True)
    return ours, np.array(single), np.array(mean)


def test_single_pass_is_pyellis(compared):
    """Every element, not normalised, at every case; measured: largest deviation 4.2e-5."""
    ours, single, _ = compared
    np.testing.assert_allclose(ours, single, rtol=0, atol=6e-5)


def test_multiple_reflections_stay_within_their_estimate(compared):
    """Against the fringe mean of the complete solution; the light that comes on top is 1.3e-3."""
    ours, _, mean = compared
    np.testing.assert_allclose(ours, mean, rtol=0, atol=1.5e-3)
    added = mean[:, 0, 0] - ours[:, 0, 0]
    assert added.min() > 1.1e-3
    assert added.max() < 1.5e-3


def test_cases_are_hard_enough(compared):
    """The plates of the cases mix every pair of Stokes parameters: a wrong sign or frame would show."""
    ours, _, _ = compared
    assert np.abs(ours[:, 1:, 1:]).max(0).min() > 0.6
    assert np.abs(ours[:, 0, 1:3]).max() > 1e-3

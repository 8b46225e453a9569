"""The conventions, pinned by canonical states: which camera brightens, and the paper's matrices typed."""

import builders
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import forward

from walop_jax.model import conventions, mueller
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.planning import plan_for

LAM = 0.62


def thin_plate(instrument, retardance):
    """Crossed plates of that retardance (rad, fast axis the MgF2's) at 0.62 µm, indices of the oracle."""
    (q_o, q_e), (m_o, m_e) = forward.quartz(LAM), forward.mgf2(LAM)
    mgf2 = 300.0
    quartz = (mgf2 * (m_e - m_o) - retardance / (2 * np.pi) * LAM) / (q_e - q_o)
    return builders.with_plates(instrument, quartz, mgf2)


def ideal(retardance=np.pi, plates="fixed_axis"):
    """No wedges, no collimator, perfect analysers, throughput one."""
    one, zero = jnp.asarray(1.0), jnp.asarray(0.0)
    instrument = nominal_instrument("WALOP-SOUTH", plates=plates, throughput=1.0)
    for half in ("half1", "half2"):
        instrument = instrument.changed(f"{half}.analyser", efficiency=one)
    instrument = instrument.changed("collimator", diattenuation=zero).changed("polariser", extinction=zero)
    return thin_plate(builders.without_wedges(instrument), retardance)


def responses(instrument, settings=(None,)):
    """Analysis vectors (band, camera, Stokes) at the field centre."""
    plan = builders.setting_plan(builders.monochromatic(LAM), settings)
    return builders.vectors(instrument, plan, 0.0, 0.0)[0]


STATES = {
    "+q": ((1, 1, 0, 0), (1, 0, 0.5, 0.5)),
    "-q": ((1, -1, 0, 0), (0, 1, 0.5, 0.5)),
    "+u": ((1, 0, 1, 0), (0.5, 0.5, 1, 0)),
    "-u": ((1, 0, -1, 0), (0.5, 0.5, 0, 1)),
    "+v": ((1, 0, 0, 1), (0.5, 0.5, 0.5, 0.5)),
    "-v": ((1, 0, 0, -1), (0.5, 0.5, 0.5, 0.5)),
}


@pytest.mark.parametrize("state", STATES)
def test_which_camera_brightens(state):
    """The ideal instrument: N0 sees +q (0°), N1 −q (90°), N2 +u (45°), N3 −u (135°), nobody v."""
    stokes, counts = STATES[state]
    np.testing.assert_allclose(responses(ideal())[0] @ np.array(stokes, float), counts, atol=1e-12)


@pytest.mark.parametrize(
    ("setting", "matrix"),
    [
        (None, ((0, 1, 0), (0, 0, 1))),
        (0.0, ((0, 1, 0), (0, 0, -1))),
        (45.0, ((0, -1, 0), (0, 0, 1))),
        (22.5, ((0, 0, 1), (0, 1, 0))),
    ],
)
def test_calibration_plate_exchanges_and_mirrors(setting, matrix):
    """A half-wave plate at α mirrors the plane of polarisation: 0° turns u round, 45° q, 22.5° swaps them."""
    found = builders.matrix(responses(ideal(), (setting,)))[0]
    np.testing.assert_allclose(found, matrix, atol=1e-12)


@pytest.mark.parametrize("delta", [np.pi, np.pi / 2, 0.3, 2.5, 5.0])
def test_measured_u_is_the_papers(delta):
    """Paper II, appendix B: q_m = q, u_m = q/2 (1 + cos δ) + u/2 (1 − cos δ) − v/√2 sin δ."""
    vectors = responses(ideal(delta))[0]
    expected_q, expected_u = np.array([0.0, 1.0, 0.0, 0.0]), np.array([
        0.0, (1 + np.cos(delta)) / 2, (1 - np.cos(delta)) / 2, -np.sin(delta) / np.sqrt(2),
    ])  # fmt: skip
    np.testing.assert_allclose(vectors[0] - vectors[1], expected_q, atol=1e-12)
    np.testing.assert_allclose(vectors[2] - vectors[3], expected_u, atol=1e-12)


@pytest.mark.parametrize("delta", [np.pi, np.pi / 2, 1.1])
def test_wave_plates_have_the_sign_of_the_papers_retarder(delta):
    """Solved waves: the same with the few 1e-3 of Fresnel losses, sin δ of the right sign."""
    vectors = responses(ideal(delta, plates="waves"))[0]
    u = (vectors[2] - vectors[3]) / (vectors[2, 0] + vectors[3, 0])
    expected = [0, (1 + np.cos(delta)) / 2, (1 - np.cos(delta)) / 2, -np.sin(delta) / np.sqrt(2)]
    np.testing.assert_allclose(u, expected, atol=2e-3)


# ------------------------------------------------------------------------------- the paper's matrices, typed


@pytest.mark.parametrize("delta", [0.0, 0.7, np.pi / 2, np.pi, 4.4])
def test_retarders_are_the_papers(delta):
    c, s, r = np.cos(delta), np.sin(delta), 1 / np.sqrt(2)
    m_0 = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]]
    m_22 = [
        [1, 0, 0, 0],
        [0, (1 + c) / 2, (1 - c) / 2, -r * s],
        [0, (1 - c) / 2, (1 + c) / 2, r * s],
        [0, r * s, -r * s, c],
    ]
    np.testing.assert_allclose(mueller.retarder(jnp.asarray(delta), jnp.asarray(0.0)), m_0, atol=1e-15)
    found = mueller.retarder(jnp.asarray(delta), jnp.asarray(np.pi / 8))
    np.testing.assert_allclose(found, m_22, atol=1e-15)


# ------------------------------------------------------------------------------------------ sources of light


def counts(rows, sky=None, source=None, standards=()):
    instrument = ideal().with_source(nominal_instrument(standards=standards).standard)
    plan = plan_for(instrument, builders.exposures(*rows), {"band": builders.monochromatic(LAM)})
    return builders.counts(instrument, plan, 0.0, 0.0, sky, source)


def test_polariser_angle_grows_from_x_to_y():
    rows = [{"clp_angle": angle} for angle in (0.0, 90.0, 45.0, 135.0)]
    expected = [[1, 0, 0.5, 0.5], [0, 1, 0.5, 0.5], [0.5, 0.5, 1, 0], [0.5, 0.5, 0, 1]]
    np.testing.assert_allclose(counts(rows), expected, atol=1e-12)


def test_star_is_referred_to_the_rotator():
    """EVPA in the ICS = position angle on the sky − ROTATOR: PA 75°, ROTATOR 30° is +u; 75° is +q."""
    q, u = 0.04 * np.cos(np.deg2rad(150.0)), 0.04 * np.sin(np.deg2rad(150.0))
    rows = [{"kind": "standard", "rotator": angle} for angle in (30.0, 75.0)]
    found = counts(rows, source=[0, 0], standards=[("STAR", q, u)])
    expected = [[0.5, 0.5, 0.52, 0.48], [0.52, 0.48, 0.5, 0.5]]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_moon_sky_is_scaled_by_its_depolarisation():
    """δ = 0.8 on (q, u) = (0.1, −0.05), and only in Moon exposures without polariser."""
    rows = [{"kind": "moon"}, {"kind": "standard", "rotator": 0.0}, {"kind": "moon", "clp_angle": 0.0}]
    found = counts(rows, sky=[[0.1, -0.05]] * 3)
    expected = [[0.54, 0.46, 0.48, 0.52], [0.5] * 4, [1, 0, 0.5, 0.5]]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_tables_of_the_conventions():
    """Cameras O1 (0°), E1 (90°), O2 (45°), E2 (135°) in their order, two to an arm; field unit 0.3°."""
    south = nominal_instrument()
    assert south.cameras.names == ("O1", "E1", "O2", "E2")
    assert south.cameras.pairs == ((0, 1), (2, 3))
    axes = [next(e for e in arm.elements if e.name == "plate").axis for arm in south.arms]
    assert [float(axis) for axis in axes] == [0.0, 22.5]
    assert conventions.FIELD_SCALE == 0.3
    assert conventions.matrix_elements(2) == ("m21", "m22", "m23", "m31", "m32", "m33")
    assert conventions.matrix_elements(3)[6:] == ("m41", "m42", "m43")

"""The light path against the oracle, against the paper's formula, and against identities."""

import dataclasses

import builders
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import forward

from walop_jax.instruments.description import parsed
from walop_jax.io.errors import DataError
from walop_jax.model import light
from walop_jax.model.instrument import build, nominal_instrument
from walop_jax.model.planning import plan_for
from walop_jax.model.sources import PointIllumination

SETTINGS = (None, 0.0, 45.0)
FLIP_V = np.array([1.0, 1.0, 1.0, -1.0])  # the oracle's V is 2 Im Ex* Ey, the package's 2 Im Ex Ey*


def oracle_vectors(instrument, x, y, wavelength, weight, setting):
    params = builders.oracle_params(instrument)
    return forward.analysis_vectors(params, x, y, wavelength, weight, setting) * FLIP_V


@pytest.mark.parametrize("seed", range(3))
def test_light_path_is_the_oracles(seed):
    """Random as-built instruments at random field points, all settings, at the package's own nodes."""
    rng = np.random.default_rng(seed)
    instrument, (x, y), teff = builders.south(rng), builders.field(rng, 6), (np.nan, 5772.0, 3500.0)[seed]
    plan = builders.setting_plan(builders.broad_band(), SETTINGS, teff)
    found = builders.vectors(instrument, plan, x, y)
    node, rule = np.asarray(plan.wavelength), np.asarray(plan.node_weight[0])
    weight = rule * forward.photon_spectrum(node, teff)
    for band, setting in enumerate(SETTINGS):
        expected = oracle_vectors(instrument, x, y, node, weight / weight.sum(), setting)
        np.testing.assert_allclose(found[:, band], expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("setting", SETTINGS)
def test_light_path_is_the_oracles_sum_over_the_table(setting):
    rng = np.random.default_rng(11)
    instrument, (x, y) = builders.south(rng), builders.field(rng, 6)
    curve = builders.broad_band()
    plan = builders.setting_plan(curve, (setting,), 5772.0)
    band = forward.band(curve.wavelength, curve.throughput, 5772.0)
    expected = oracle_vectors(instrument, x, y, *band, setting)
    np.testing.assert_allclose(builders.vectors(instrument, plan, x, y)[:, 0], expected, rtol=0, atol=1e-8)


def test_matrix_is_defined_by_band_integrated_intensities():
    """Hand: responses (1, q, u) of O1 (3, 2, 1), E1 (1, −1, 2), O2 (2, 0, 1), E2 (2, 1, −3)."""
    vectors = jnp.asarray([[3.0, 2, 1, 9], [1, -1, 2, 9], [2, 0, 1, 9], [2, 1, -3, 9]])
    expected = [[0.5, 0.75, -0.25], [0.0, -0.25, 1.0]]
    np.testing.assert_allclose(builders.matrix(vectors), expected, atol=1e-15)


def test_throughput_enters_the_offsets():
    """Cameras 0.55 and 0.45 in front of the same half add 0.1 to m21 where the plates add none."""
    instrument = nominal_instrument()
    c = instrument.throughput.coefficients.at[:, 0].set(jnp.asarray([0.55, 0.45, 0.5, 0.5]))
    lopsided = eqx.tree_at(lambda i: i.throughput.coefficients, instrument, c)
    plan = builders.setting_plan(builders.monochromatic(0.62))
    plain, found = (
        builders.matrix(builders.vectors(device, plan, 0.2, 0.1))[0, 0] for device in (instrument, lopsided)
    )
    # (a(1+m) − b(1−m)) / (a(1+m) + b(1−m)) with a, b = 0.55, 0.45
    assert found[0, 0] == pytest.approx((0.1 + plain[0, 0]) / (1 + 0.1 * plain[0, 0]), abs=1e-12)
    np.testing.assert_allclose(found[1], plain[1], atol=1e-15)


def test_counts_are_linear_in_stokes():
    """Three polariser angles foretell the counts at all others: a + b cos 2θ + c sin 2θ."""
    rng = np.random.default_rng(7)
    instrument = builders.south(rng)
    angles = np.array([0.0, 60.0, 120.0, 17.0, 71.0, 155.0])
    plan = plan_for(
        instrument,
        builders.exposures(*({"clp_angle": a} for a in angles)),
        {"band": builders.monochromatic(0.65)},
    )
    counts = builders.counts(instrument, plan, 0.21, -0.13)
    two = 2 * np.deg2rad(angles)
    design = np.stack([np.ones(6), np.cos(two), np.sin(two)], -1)
    found = np.linalg.solve(design[:3], counts[:3])
    np.testing.assert_allclose(design[3:] @ found, counts[3:], atol=1e-13)


@pytest.mark.parametrize("setting", SETTINGS)
def test_no_light_is_made(setting):
    """Half the light for each half of the pupil: four cameras of 0.5 give at most what came, in any state.

    Uncoated faces pass (1 − 4.6 %)(1 − 0.3 %)(1 − 2.5 %) = 92.8 % per stack (Fresnel, normal incidence).
    """
    rng = np.random.default_rng(8)
    instrument = nominal_instrument().changed("collimator", diattenuation=jnp.asarray(0.0))
    plan = builders.setting_plan(builders.monochromatic(0.62), (setting,))
    x, y = builders.field(rng, 20)
    direction = rng.standard_normal((50, 3))
    states = np.concatenate([np.ones((50, 1)), direction / np.linalg.norm(direction, axis=1)[:, None]], 1)
    counts = np.einsum("pks,ns->pnk", builders.vectors(instrument, plan, x, y)[:, 0], states)
    assert counts.min() > -1e-12
    total = counts.sum(-1)
    stacks = 1 if setting is None else 2
    assert total.max() <= 1.0
    np.testing.assert_allclose(total, 0.928**stacks, atol=0.012 * stacks)


def test_mirror_image_of_the_first_half():
    """Everything before N0 and N1 is symmetric in Y: m21 and m22 are even, m23 is odd."""
    rng = np.random.default_rng(9)
    instrument = nominal_instrument()
    plan = builders.setting_plan(builders.monochromatic(0.63))
    x, y = builders.field(rng, 8)
    above, below = (builders.matrix(builders.vectors(instrument, plan, x, s * y))[:, 0, 0] for s in (1, -1))
    np.testing.assert_allclose(above * np.array([1, 1, -1]), below, atol=1e-12)
    assert np.abs(above[:, 2]).max() > 1e-4


# ------------------------------------------------------------------------------------ the paper's fixed axes


def papers_retardance(n_o, n_e, thickness, wavelength, sine, alpha):
    """Equations ne_eff and general_ret of Paper II for one plate, `alpha` from its optic axis (rad)."""
    n_x = n_e * np.sqrt(1 + (1 / n_e**2 - 1 / n_o**2) * sine**2 * np.cos(alpha) ** 2)
    n_y = n_o
    return 2 * np.pi / wavelength * thickness * (np.sqrt(n_x**2 - sine**2) - np.sqrt(n_y**2 - sine**2))


def papers_rows(delta, alpha):
    """I and Q rows of M_{α,δ}."""
    c, s = np.cos(2 * alpha), np.sin(2 * alpha)
    zero, one = np.zeros_like(delta), np.ones_like(delta)
    first = np.stack([one, zero, zero, zero], -1)
    return first, np.stack(
        [zero, c**2 + s**2 * np.cos(delta), c * s * (1 - np.cos(delta)), -s * np.sin(delta)], -1
    )


def no_lens(plates):
    return nominal_instrument(plates=plates).changed("collimator", diattenuation=jnp.asarray(0.0))


def test_fixed_axis_plates_are_the_papers():
    rng = np.random.default_rng(12)
    x, y = builders.field(rng, 12)
    wavelength = 0.64
    plan = builders.setting_plan(builders.monochromatic(wavelength))
    vectors = builders.vectors(no_lens("fixed_axis"), plan, x, y)[:, 0]
    k = forward.pupil_direction(forward.NOMINAL, x, y)
    (q_o, q_e), (m_o, m_e) = forward.quartz(wavelength), forward.mgf2(wavelength)
    for half, axis in ((0, 0.0), (1, np.pi / 8)):
        behind = forward.through_wedge(k, (-0.23, 0.23)[half], np.array([wavelength]))[:, 0]
        sine, azimuth = np.hypot(behind[:, 0], behind[:, 1]), np.arctan2(behind[:, 1], behind[:, 0])
        # net fast axis = fast axis of the MgF2, whose optic axis lies across
        mgf2 = papers_retardance(m_o, m_e, 1930.0, wavelength, sine, azimuth - axis - np.pi / 2)
        quartz = papers_retardance(q_o, q_e, 2407.0, wavelength, sine, azimuth - axis)
        first, second = papers_rows(mgf2 - quartz, axis)
        for camera, sign in ((2 * half, 0.999), (2 * half + 1, -0.999)):
            expected = 0.25 * (first + sign * second)
            np.testing.assert_allclose(vectors[:, camera], expected, atol=1e-11)


def test_fixed_axes_miss_about_a_hundredth_of_cross_talk():
    """Up to 1–2 % at the edge of the field; nothing of the kind on the axis of the plates."""
    edge = np.linspace(-0.29, 0.29, 15)
    x, y = (v.ravel() for v in np.meshgrid(edge, edge))
    plan = builders.setting_plan(builders.monochromatic(0.62))
    exact, fixed = (
        builders.matrix(builders.vectors(no_lens(plates), plan, x, y))[:, 0]
        for plates in ("waves", "fixed_axis")
    )
    missed = np.abs(exact - fixed)[:, :, 1:].max(axis=(0, 1))
    assert 0.008 < missed.max() < 0.06


# ------------------------------------------------------------------------------ what stands ahead of the polariser

AHEAD = """
name = "SOUTH-TURNED-ROUND"
like = "WALOP-SOUTH"
path = ["collimator", "polariser", "pupil", "chwp"]
[elements.collimator]
diattenuation = 0.8
"""


def test_lenses_ahead_of_the_polariser_act_on_the_sky_alone():
    """Diattenuation 0.8 r² along the radius: of an unpolarised star at (0.2, 0.1) it makes q = 0.024, u = 0.032.

    Light through the polariser has forgotten it, and lamps stand behind it.
    """
    instrument = build(parsed(AHEAD, "a test"))
    rows = builders.exposures(
        {"kind": "standard", "rotator": 0.0}, {"clp_angle": 0.0}, {"kind": "flux"}, {"kind": "moon"}
    )
    arrays = plan_for(instrument, rows, {"band": builders.monochromatic(0.62)}).exposures
    illumination = PointIllumination(
        arrays, jnp.zeros((4, 2)), jnp.full(4, -1), jnp.asarray(0.2), jnp.asarray(0.1)
    )
    found = light.stokes(instrument, illumination)
    c = (1 - 2e-5) / (1 + 2e-5)
    expected = [[1, 0.024, 0.032, 0], [1, c, 0, 0], [1, 0, 0, 0], [1, 0.024, 0.032, 0]]
    np.testing.assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize(
    "element", ["chwp", "pupil", "late"], ids=["moves", "bends the ray", "depends on wavelength"]
)
def test_what_cannot_stand_ahead_of_the_polariser_is_refused(element):
    path = ["polariser", "collimator", "pupil", "chwp", "late"]
    path.insert(0, path.pop(path.index(element)))
    text = f'name = "X"\nlike = "WALOP-SOUTH"\npath = {path}\n[elements.late]\nkind = "retarder"\nwavelength = 0.6\n'
    with pytest.raises(DataError, match=f"element '{element}' is ahead of the polariser.*put it behind"):
        build(parsed(text, "a test"))


def test_beams_go_to_the_cameras_of_their_names():
    south = nominal_instrument("WALOP-SOUTH")
    cameras = dataclasses.replace(south.cameras, names=south.cameras.names[::-1])
    rows = jnp.asarray(np.random.default_rng(1).standard_normal((2, 4, 4)))
    found = light.beams(dataclasses.replace(south, cameras=cameras), rows)
    np.testing.assert_array_equal(found[:, ::-1], light.beams(south, rows))

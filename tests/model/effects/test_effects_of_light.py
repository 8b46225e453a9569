"""Effects of sky, polariser and collimator, held against numbers worked out by hand."""

from __future__ import annotations

import dataclasses

import builders
import effect_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model import light, mueller
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.base import Effect
from walop_jax.model.sources import PointIllumination

ONE = builders.exposures({"clp_angle": 30.0}, {"kind": "moon"}, {"kind": "standard", "rotator": 0.0})


def make(name: str, **values) -> Effect:
    return effect_by_name(name).of(scenes.CONTEXT, **values)


def stokes(*effects: Effect, sky=(0.1, 0.0), rows=ONE, source=(-1, -1, 0)) -> np.ndarray:
    """Stokes vectors ahead of the collimator: polariser at 30°, Moon sky, the star (0.04, −0.02)."""
    device = dataclasses.replace(builders.south(standards=scenes.STARS), effects=effects)
    arrays = scenes.plan(effects, rows).exposures
    everywhere = jnp.broadcast_to(jnp.asarray(sky), (len(rows), 2))
    illumination = PointIllumination(
        arrays, everywhere, jnp.asarray(source), jnp.asarray(0.1), jnp.asarray(-0.2)
    )
    return np.asarray(light.stokes(device, illumination))


def linear(angle: float, degree: float = (1 - 2e-5) / (1 + 2e-5)) -> list[float]:
    return [1.0, degree * np.cos(2 * np.deg2rad(angle)), degree * np.sin(2 * np.deg2rad(angle)), 0.0]


def test_without_effects():
    expected = [linear(30.0), [1.0, 0.08, 0.0, 0.0], [1.0, 0.04, -0.02, 0.0]]
    assert stokes() == pytest.approx(np.array(expected), abs=1e-15)


def test_clp_zero_turns_the_polariser_only():
    found = stokes(make("clp_zero", angle=1.5))
    assert found[0] == pytest.approx(linear(31.5), abs=1e-15)
    assert np.array_equal(found[1:], stokes()[1:])


def test_clp_wobble_by_hand():
    # CLP_ANGLE 30° = π/6, phase −π/3: sin(π/2) = 1, the whole amplitude.
    found = stokes(make("clp_wobble", amplitude=0.2, phase=-np.pi / 3))
    assert found[0] == pytest.approx(linear(30.2), abs=1e-14)


def test_clp_wobble_follows_the_reading_not_the_true_angle():
    both = stokes(make("clp_zero", angle=10.0), make("clp_wobble", amplitude=0.2, phase=-np.pi / 3))
    assert both[0] == pytest.approx(linear(40.2), abs=1e-14)


def test_clp_wobble_from_its_linear_directions():
    kind = effect_by_name("clp_wobble")
    (group,) = kind.probes(scenes.CONTEXT)
    found = kind.combine(group, (0.06 * np.cos(1.1), 0.06 * np.sin(1.1)))
    assert float(found.amplitude) == pytest.approx(0.06)
    assert float(found.phase) == pytest.approx(1.1)
    mirrored = found.replaced(amplitude=-found.amplitude, phase=found.phase - np.pi).standard_form()
    assert float(mirrored.amplitude) == pytest.approx(0.06)
    assert float(mirrored.phase) == pytest.approx(1.1)


def test_clp_extinction():
    found = stokes(make("clp_extinction", ratio=0.01))
    assert found[0] == pytest.approx(linear(30.0, 0.99 / 1.01), abs=1e-15)
    assert np.array_equal(stokes(make("clp_extinction", ratio=2e-5)), stokes())


def test_clp_ellipticity():
    found = stokes(make("clp_ellipticity", v=0.03))
    assert found[:, 3].tolist() == [0.03, 0.0, 0.0]


def test_telescope_polarisation_is_of_the_sky_only():
    rows = builders.exposures({"clp_angle": 30.0}, {"kind": "moon"}, {"kind": "standard"}, {"kind": "flux"})
    effect = make("telescope_polarisation", q=0.002, u=-0.001)
    added = stokes(effect, rows=rows, source=(-1, -1, 0, -1)) - stokes(rows=rows, source=(-1, -1, 0, -1))
    sky = [0.0, 0.002, -0.001, 0.0]
    assert added == pytest.approx(np.array([[0.0] * 4, sky, sky, [0.0] * 4]), abs=1e-15)


def test_telescope_polarisation_in_the_instrument_matrix():
    """Its part of m21 is m22 q + m23 u: what an unpolarised star shows."""
    device = scenes.instrument(make("telescope_polarisation", q=0.02, u=-0.01))
    vectors = builders.vectors(device, scenes.plan(), 0.1, 0.05)[0, 0]
    telescope = light.telescope(device, jnp.asarray(0.1), jnp.asarray(0.05))
    plain, seen = builders.matrix(vectors), builders.matrix(vectors @ telescope)
    signal = vectors @ np.array([1.0, 0.02, -0.01, 0.0])
    assert seen[0, 0] == pytest.approx((signal[0] - signal[1]) / (signal[0] + signal[1]), abs=3e-4)
    assert seen[0, 0] - plain[0, 0] == pytest.approx(plain[0, 1:] @ [0.02, -0.01], rel=0.02)


@pytest.mark.parametrize(("sky", "expected"), [((0.1, 0.0), (0.07, 0.0)), ((0.06, 0.08), (0.042, 0.056))])
def test_moon_multiple_scattering(sky, expected):
    # δ = 0.8: p = 0.08 both times; 0.01 less along the same direction.
    found = stokes(make("moon_multiple_scattering", p=0.01), sky=sky)
    assert found[1, 1:3] == pytest.approx(expected, abs=1e-15)
    assert np.array_equal(found[[0, 2]], stokes(sky=sky)[[0, 2]])


def test_moon_multiple_scattering_at_the_moon_itself():
    device, arrays = builders.south(standards=scenes.STARS), scenes.plan((), ONE).exposures

    def q(p):
        there = dataclasses.replace(device, effects=(make("moon_multiple_scattering", p=p),))
        zero = jnp.asarray(0.0)
        return light.stokes(
            there, PointIllumination(arrays, jnp.zeros((3, 2)), jnp.array([-1, -1, 0]), zero, zero)
        )

    assert np.isfinite(np.asarray(jax.jacfwd(q)(jnp.asarray(0.01)))).all()


def test_moon_patch_is_of_its_exposure():
    context = scenes.CONTEXT._replace(moon=(1,), moon_ids=(7,))
    effect = effect_by_name("moon_patch").of(context, q=[0.003], u=[-0.004])
    assert effect.labels("q") == ("q.7",)
    found = stokes(effect) - stokes()
    assert found[1] == pytest.approx([0.0, 0.003, -0.004, 0.0], abs=1e-15)
    assert not found[[0, 2]].any()


def test_rotator_zero_turns_sky_against_instrument():
    # A source at position angle 0° (q = 0.1 for ROTATOR = 0) seen with +X truly at 10°: EVPA −10° in the ICS.
    found = stokes(make("rotator_zero", angle=10.0))
    assert found[1, 1:3] == pytest.approx([0.08 * np.cos(np.deg2rad(20)), -0.08 * np.sin(np.deg2rad(20))])
    assert found[0] == pytest.approx(stokes()[0])
    turned = builders.exposures({"clp_angle": 30.0}, {"kind": "moon"}, {"kind": "standard", "rotator": 10.0})
    assert found[2] == pytest.approx(stokes(rows=turned)[2], abs=1e-15)


def test_standard_outlier_is_of_one_star():
    rows = builders.exposures({"kind": "standard", "rotator": 0.0}, {"kind": "standard", "rotator": 45.0})
    effect = make("standard_outlier", source="red_star", q=0.01)
    plain = stokes(rows=rows, source=(0, 1))
    found = stokes(effect, rows=rows, source=(0, 1)) - plain
    assert not found[0].any()
    assert found[1] == pytest.approx(
        [0.0, 0.0, -0.01, 0.0], abs=1e-15
    )  # ROTATOR 45°: q of the sky is −u here
    with pytest.raises(ValueError, match="red_star"):
        stokes(make("standard_outlier", source="redd_star"), rows=rows, source=(0, 1))


def test_standard_values_are_of_each_star_by_itself():
    """With ROTATOR 45° Q of the sky is −U of the instrument, and U of the sky is Q."""
    rows = builders.exposures({"kind": "standard", "rotator": 0.0}, {"kind": "standard", "rotator": 45.0})
    effect = make("standard_values", q=[0.02, 0.01], u=[-0.005, 0.03])
    assert effect.labels("q") == ("q.blue_star", "q.red_star")
    found = stokes(effect, rows=rows, source=(0, 1)) - stokes(rows=rows, source=(0, 1))
    assert found[0] == pytest.approx([0.0, 0.02, -0.005, 0.0], abs=1e-15)
    assert found[1] == pytest.approx([0.0, 0.03, -0.01, 0.0], abs=1e-15)


def test_standard_values_need_a_standard():
    effect = effect_by_name("standard_values").neutral(scenes.CONTEXT._replace(sources=()))
    assert "there is no standard star" in effect.lacks(builders.south())


def upstream(effect: Effect, x: float, y: float) -> np.ndarray:
    """What the effect adds behind the collimator, which does nothing here."""
    return np.asarray(_upstream(effect, jnp.asarray(x), jnp.asarray(y)))


def _upstream(effect: Effect, x: jax.Array, y: jax.Array) -> jax.Array:
    device = builders.south().changed("collimator", diattenuation=jnp.asarray(0.0))
    return light.upstream(dataclasses.replace(device, effects=(effect,)), x, y)


def test_upstream_retarder_by_hand():
    half_wave = upstream(make("upstream_retarder", delta=np.pi, axis=45.0), 0.0, 0.0)
    assert half_wave == pytest.approx(np.diag([1.0, -1.0, 1.0, -1.0]), abs=1e-15)
    quarter = upstream(make("upstream_retarder", delta=0.5 * np.pi, axis=0.0), 0.1, 0.2)
    assert quarter @ [1, 0, 1, 0] == pytest.approx([1, 0, 0, -1], abs=1e-15)


def test_upstream_retarder_from_its_linear_directions():
    kind = effect_by_name("upstream_retarder")
    (group,) = kind.probes(scenes.CONTEXT)
    found = kind.combine(group, (0.02 * np.cos(2.2), 0.02 * np.sin(2.2)))
    assert float(found.delta) == pytest.approx(0.02)
    assert float(found.axis) == pytest.approx(np.rad2deg(1.1))


@pytest.mark.parametrize(("x", "y"), [(0.3, 0.0), (0.1, -0.2), (-0.25, 0.05)])
def test_lens_birefringence_is_radial_and_grows_with_the_square(x, y):
    expected = mueller.retarder(
        jnp.asarray(2 * np.pi * 0.2 * (x**2 + y**2) / 0.09), jnp.asarray(np.arctan2(y, x))
    )
    assert upstream(make("lens_birefringence", delta=0.2), x, y) == pytest.approx(
        np.asarray(expected), abs=1e-14
    )


def test_lens_birefringence_is_smooth_at_the_centre():
    assert upstream(make("lens_birefringence", delta=0.2), 0.0, 0.0) == pytest.approx(np.eye(4), abs=1e-15)

    def at_centre(delta):
        return _upstream(make("lens_birefringence", delta=delta), jnp.zeros(()), jnp.zeros(()))

    assert np.isfinite(np.asarray(jax.jacfwd(at_centre)(jnp.asarray(0.0)))).all()

"""Effects of cameras and detectors: numbers by hand, flux and gradient of the likelihood with them."""

from __future__ import annotations

import dataclasses

import effect_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import quick

from walop_jax.likelihood import engine
from walop_jax.model import light
from walop_jax.model.effects import Described, effect_by_name
from walop_jax.model.parameters import values_of, with_values
from walop_jax.simulation.simulate import effect_from_text

COUNTS = jnp.array([[1e5, 2e5, 3e5, 4e5]] * 9)
AT = jnp.array([0.1, 0.2])


def make(name: str, **values):
    return effect_by_name(name).of(scenes.CONTEXT, **values)


def detected(*effects) -> np.ndarray:
    return np.asarray(light.detected(scenes.instrument(*effects), scenes.plan().exposures, COUNTS, *AT))


def test_leakage_mixes_orthogonal_cameras():
    plain, found = scenes.observe(), scenes.observe(make("camera_leakage", share=0.01))
    assert found == pytest.approx(plain + 0.01 * plain[..., [1, 0, 3, 2]], rel=1e-12)


def test_ghost_is_the_opposite_point_of_extended_sources():
    found = scenes.observe(make("ghost", share=0.02))
    plain, layout = scenes.observe(), scenes.plan()
    opposite = scenes.points(layout, -scenes.X, -scenes.Y)._replace(sky=scenes.points(layout).sky)
    there = scenes.FLUX * np.asarray(engine.prediction(scenes.instrument(), layout, opposite))
    extended = (scenes.SOURCE < 0)[:, None]
    expected = plain + np.where(extended, 0.02 * there, 0.0)
    # A camera sees the difference of what its analyser takes: rounding is a share of the light, not of what is left.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * expected.max())


def test_pedestal_by_hand():
    found = detected(make("pedestal", level=[0.01, 0.0, 0.0, 0.005]))
    expected = COUNTS + jnp.array([0.01 * 2e5, 0.0, 0.0, 0.005 * 2.4e5])
    assert found == pytest.approx(np.asarray(expected), rel=1e-14)


def test_pedestal_needs_the_medians():
    exposures = dataclasses.replace(scenes.plan().exposures, median_counts=None)
    with pytest.raises(ValueError, match="median"):
        light.detected(scenes.instrument(make("pedestal")), exposures, COUNTS, *AT)


def test_nonlinearity_by_hand():
    found = detected(make("nonlinearity", coefficient=[0.0, 0.02, 0.0, -0.01]))
    assert found[0] == pytest.approx([1e5, 2e5 * 1.004, 3e5, 4e5 * 0.996], rel=1e-14)


@pytest.mark.parametrize(
    ("factors", "expected"),
    [
        ("counts", [0.02 * 0.4, 0.0]),  # 0.02 · 4·10⁵ / 10⁶
        ("root counts", [0.02 * 0.4**0.5, 0.02 / 1e3]),  # of one electron: (1 / 10⁶)^½
        ("counts squared", [0.02 * 0.16, 0.0]),
        ("counts * y", [0.02 * 0.4 * 0.2 / 0.3, 0.0]),  # at y = 0.2, of the amplitude at 0.3°
        ("root counts * x * hours", [0.02 * 0.4**0.5 * 0.1 / 0.3 * 3.6, 0.02 / 1e3 * 0.1 / 0.3 * 3.6]),
    ],
)
def test_gains_that_grow_with_a_power_of_the_counts_by_hand(factors, expected):
    device = scenes.instrument(Described.saying([f"gain of E2 * {factors}"], [0.02]))
    counts = COUNTS.at[4].set(jnp.array([0.0, 0.0, 0.0, 1.0]))

    def reported(n):
        return light.detected(device, scenes.plan().exposures, n, *AT)

    found, slope = jax.jvp(reported, (counts,), (jnp.ones_like(counts),))
    hours = np.asarray(scenes.plan().exposures.hours)[5] / 3.6 if "hours" in factors else 1.0
    assert found[5, 3] / 4e5 - 1.0 == pytest.approx(expected[0] * hours, rel=1e-10)
    assert found[4, 3] - 1.0 == pytest.approx(expected[1], abs=1e-7)
    np.testing.assert_array_equal(found[:, :3], counts[:, :3])
    assert np.isfinite(slope).all()


def test_a_gain_grows_with_one_power_of_the_counts():
    with pytest.raises(ValueError, match="grows with one of root counts, counts, counts squared"):
        scenes.instrument(Described.saying(["gain of E2 * counts * root counts"], [0.02])).patched()


def test_gain_drift_by_hand():
    hours = np.asarray(scenes.plan().exposures.hours)
    assert hours[[0, 1, 4]] == pytest.approx([0.0, 2.4, 3.6])
    found = detected(make("camera_gain_drift", camera=2, rate=0.01))
    assert found[4] == pytest.approx([1e5, 2e5, 3e5 * 1.036, 4e5], rel=1e-12)


@pytest.mark.parametrize("name", ["camera_gain_drift", "blemish"])
@pytest.mark.parametrize("camera", [4, -1])
def test_a_camera_that_does_not_exist_is_refused(name, camera):
    """An index out of range would otherwise change nothing, and a negative one another camera."""
    with pytest.raises(ValueError, match=f"{name}: camera {camera} does not exist; cameras are O1"):
        scenes.instrument(make(name, camera=camera)).patched()


def test_a_camera_goes_by_its_name_or_its_number():
    text = "camera_gain_drift=camera:{},rate:0.01"
    by_name, by_number = (effect_from_text(text.format(given), scenes.CONTEXT) for given in ("E2", "3"))
    assert by_name.choices() == by_number.choices() == {"camera": 3}
    with pytest.raises(ValueError, match=r"camera 'E3' does not exist; cameras are O1 \(0\), E1 \(1\)"):
        effect_from_text(text.format("E3"), scenes.CONTEXT)


def test_blemish_by_hand():
    effect = make("blemish", camera=1, x=0.1, y=-0.1, size=0.05, depth=0.2)

    (spot,) = scenes.instrument(effect).patched().cameras.transmission

    def at(x, y):
        return 0.5 * np.asarray(spot.factors(jnp.asarray(x), jnp.asarray(y)))

    assert at(0.1, -0.1) == pytest.approx([0.5, 0.4, 0.5, 0.5])
    assert at(0.1, -0.05) == pytest.approx([0.5, 0.5 * (1 - 0.2 * np.exp(-0.5)), 0.5, 0.5])
    assert at(-0.2, 0.2) == pytest.approx([0.5] * 4, abs=1e-9)


# --------------------------------------------------------------------------------- likelihood with detectors

TROUBLE = {
    "nonlinearity": {"coefficient": [0.03, -0.02, 0.01, 0.05]},
    "pedestal": {"level": [0.01, 0.02, -0.005, 0.0]},
    "camera_gain_drift": {"camera": 3, "rate": 0.004},
    "ghost": {"share": 0.03},
}


def measured(*effects) -> tuple[engine.PointData, object]:
    """Data of an instrument with effects, flux unknown and not uniform, and their plan."""
    layout = scenes.plan(effects)
    data = scenes.points(layout)
    device = scenes.instrument(*effects)
    flux = np.random.default_rng(2).uniform(2e5, 6e5, (2, 9, 1))
    flux[:, 8] = 1.0
    counts = engine.detected(
        device, layout.exposures, flux * engine.prediction(device, layout, data), data.x, data.y
    )
    weight = 1.0 / jnp.sqrt(counts + 900.0)
    return data._replace(counts=counts, weight=weight), layout


@pytest.mark.parametrize("name", TROUBLE)
def test_flux_is_found_through_the_detectors(name):
    effect = make(name, **TROUBLE[name])
    data, layout = measured(effect)
    _, residual = engine.residuals(scenes.instrument(effect), layout, data)
    assert np.abs(np.asarray(residual)).max() < 1e-7


@pytest.mark.parametrize("name", quick(TROUBLE, ["nonlinearity"]))
def test_gradient_of_chi2_is_exact(name):
    """Half the gradient of χ² with the flux profiled, against central differences of χ²."""
    effect = make(name, **TROUBLE[name])
    data, layout = measured(effect)
    data = data._replace(
        counts=data.counts * (1 + 0.01 * np.random.default_rng(3).normal(size=data.counts.shape))
    )
    device = scenes.instrument(effect)
    values, unravel = values_of(device), with_values(device)
    gradient = np.asarray(engine.normal_equations(device, layout, data).gradient)

    def chi2(v) -> float:
        return float(jnp.sum(engine.residuals(unravel(v), layout, data)[1] ** 2))

    # The last parameters are the effect's; throughputs, an optical and a polarimetric one besides.
    for i in (0, 5, 9, 12, 30, 60, *range(values.size - values_of(effect).size, values.size)):
        h = 1e-5 * max(1.0, abs(float(values[i])) * 0.1)
        step = jnp.zeros(values.size).at[i].set(h)
        assert (chi2(values + step) - chi2(values - step)) / (4 * h) == pytest.approx(
            gradient[i], rel=1e-4, abs=1e-6 * np.abs(gradient).max()
        ), i


def test_effects_combine_in_any_instrument():
    both = [make(name, **values) for name, values in TROUBLE.items()]
    data, layout = measured(*both)
    _, residual = engine.residuals(dataclasses.replace(scenes.BASE, effects=tuple(both)), layout, data)
    assert np.abs(np.asarray(residual)).max() < 1e-7

"""Refractive indices against check values worked out outside this project (numbers.md, section 3)."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from one_arm import one_arm

import walop_jax as walop
from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.fit.minimise import minimise
from walop_jax.fit.model_of_set import model_for
from walop_jax.fit.refit import FitResult
from walop_jax.instruments.description import parsed
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Expansion, Likelihood, OpticsUsed, UsedData
from walop_jax.model import materials
from walop_jax.model.instrument import build
from walop_jax.model.planning import extrapolations, plan_for_settings

CHECKS = {
    "BK7": (1.515539, 1.515089),
    "QUARTZ_O": (1.543047, 1.542606),
    "QUARTZ_E": (1.552107, 1.551651),
    "MGF2_O": (1.377184, 1.376984),
    "MGF2_E": (1.388972, 1.388763),
}
BIREFRINGENCE = {"QUARTZ": 0.009060, "MGF2": 0.011788}


@pytest.mark.parametrize("name", CHECKS)
def test_index_has_the_published_check_values(name):
    index = getattr(materials, name).refractive_index(jnp.array([0.62, 0.6328]))
    np.testing.assert_allclose(index, CHECKS[name], atol=6e-7, rtol=0)


@pytest.mark.parametrize("name", BIREFRINGENCE)
def test_birefringence_has_the_published_value(name):
    lam = jnp.asarray(0.62)
    found = getattr(materials, f"{name}_E").refractive_index(lam) - getattr(
        materials, f"{name}_O"
    ).refractive_index(lam)
    assert float(found) == pytest.approx(BIREFRINGENCE[name], abs=6e-7)


def test_bk7_meets_the_data_sheet_at_the_fraunhofer_lines():
    """Schott data sheet N-BK7: n_d 1.51680, n_F 1.52238, n_C 1.51432, Abbe number 64.17."""
    n_d, n_f, n_c = np.asarray(materials.BK7.refractive_index(jnp.array([0.5875618, 0.4861327, 0.6562725])))
    np.testing.assert_allclose([n_d, n_f, n_c], [1.51680, 1.52238, 1.51432], atol=6e-6)
    assert (n_d - 1) / (n_f - n_c) == pytest.approx(64.17, abs=0.01)


def test_thermal_coefficients_are_those_of_etzel_rose_and_wang():
    assert materials.QUARTZ_THERMAL == 1.23e-4
    assert materials.MGF2_THERMAL == 5.37e-5


@pytest.mark.parametrize(("one", "other"), [("quartz", "quartz_1951"), ("mgf2", "mgf2_1980")])
def test_curves_that_others_measured_agree_in_the_visible(one, other):
    """Two works, two transcriptions: the indices agree to 1e-4 from 0.45 to 0.75 µm, and are not the same."""
    at = jnp.linspace(0.45, 0.75, 7)
    for which in ("ordinary", "extraordinary"):
        first, second = (
            getattr(materials.CRYSTALS[name], which).refractive_index(at) for name in (one, other)
        )
        np.testing.assert_allclose(first, second, rtol=0, atol=1e-4)
        assert np.abs(first - second).max() > 1e-6


def test_quartz_of_1951_has_the_handbook_values_in_sodium_light():
    crystal = materials.CRYSTALS["quartz_1951"]
    found = [
        float(c.refractive_index(jnp.asarray(0.5893))) for c in (crystal.ordinary, crystal.extraordinary)
    ]
    np.testing.assert_allclose(found, (1.54424, 1.55335), rtol=0, atol=1e-5)


# ------------------------------------------------------------------------------------- beyond what was measured

LAYER = """
[[elements.plate.layers]]
name = "only"
material = "{material}"
thickness = {{ value = 100.0, sigma = 1.0, unit = "um" }}
"""
PLATE = """
[elements.plate]
kind = "wave_plate"
{layer}
"""


def plan_of(material, first, last):
    plate = PLATE.format(layer=LAYER.format(material=material))
    instrument = build(parsed(one_arm("INFRARED", ["plate"], plate), "a text"))
    wavelength = np.linspace(first, last, 41)
    curve = FilterCurve("K", wavelength, np.ones(41))
    settings = dataclasses.replace(Settings.default(1), filter=np.array(["K"]))
    return instrument, curve, lambda: plan_for_settings(instrument, settings, {"K": curve})


@pytest.mark.parametrize(
    ("material", "first", "last", "measured"),
    [("quartz", 8.0, 12.0, "0.198 to 2.05"), ("quartz", 2.0, 3.0, "0.198 to 2.05"), ("mgf2", 7.0, 20.0, "0.2 to 7"),
     ("quartz_1951", 0.1, 0.2, "0.18 to 3")],
)  # fmt: skip
def test_no_light_path_far_beyond_the_measured_wavelengths(material, first, last, measured):
    """Toward the poles of the formulae an index means nothing, and is NaN beyond them."""
    _, _, plan = plan_of(material, first, last)
    with pytest.raises(DataError, match=rf"filter K, .*index of {material} .* {measured} µm"):
        plan()


def test_a_band_somewhat_beyond_them_is_remarked_on():
    """Quartz to 2.37 µm, as in the K band: 2.05 µm was measured, the formula still holds to 10⁻³ of 1.5195.

    Radhakrishnan 1951 measured to 3 µm: n_o of his curve there.
    """
    instrument, curve, plan = plan_of("quartz", 2.0, 2.37)
    index = materials.CRYSTALS["quartz"].ordinary.refractive_index(np.asarray(plan().wavelength))
    other = materials.CRYSTALS["quartz_1951"].ordinary.refractive_index(np.asarray(plan().wavelength))
    np.testing.assert_allclose(index, other, atol=1e-3)
    (sentence,) = extrapolations(instrument, [curve])
    assert (
        "filter K, 2 to 2.37 µm: the refractive index of quartz was measured at 0.198 to 2.05 µm" in sentence
    )
    assert (
        extrapolations(
            plan_of("quartz", 1.0, 2.0)[0], [FilterCurve("J", curve.wavelength - 0.7, np.ones(41))]
        )
        == ()
    )


def test_a_fit_says_so_and_is_not_forbidden():
    instrument, curve, _ = plan_of("quartz", 2.0, 2.37)
    counts = 1e5 * (1.0 + np.random.default_rng(1).random((2, 4, 2)))
    calset = walop.from_arrays(
        counts, np.sqrt(counts), [0.0, 0.1], [0.1, 0.0], np.full(4, np.nan), "lamp",
        instrument="INFRARED", filters={"K": curve}, filter="K",
    )  # fmt: skip
    likelihood = Likelihood.of(calset, model_for(calset, "", instrument))
    used_data = UsedData(np.ones(4, int), (0.0, 0.1, 0.0, 0.1), 2)
    n = len(likelihood.model.free)
    expansion = Expansion(5.0, 0.0, 0.0, 1.0, np.zeros(n), np.eye(n), used_data, 5, OpticsUsed(None))
    minimum = minimise(lambda x: expansion, np.zeros(n), np.ones(n))
    size = len(likelihood.model.names)
    result = FitResult(
        likelihood, likelihood.model.start, np.zeros((size, size)), expansion, minimum, seconds=0.0
    ).with_verdict()
    assert any("quartz was measured at 0.198 to 2.05 µm" in text for text in result.warnings)
    assert result.trusted

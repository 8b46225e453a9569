"""Refractive indices against check values worked out outside this project (numbers.md, section 3)."""

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model import materials

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

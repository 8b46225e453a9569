"""The laboratory bench of Paper II: one tilted zero-order plate, cross-talk against tilt as in its table."""

import builders
import numpy as np
import pytest
from oracle import forward
from scipy.optimize import least_squares

from walop_jax.data.settings import builtin_filter
from walop_jax.model.instrument import nominal_instrument

# Paper II, table of the laboratory results: tilt (deg), cross-talk from q into u_m
TILT = np.array([12.0, 14.0, 16.0, 18.0, 20.0])
CROSS_TALK = np.array([0.16, 0.27, 0.43, 0.62, 0.81])


def zero_order_quartz(mgf2):
    """Thickness of quartz (µm) behind which crossed plates retard by half a wave at 0.62 µm; indices of the oracle."""
    (q_o, q_e), (m_o, m_e) = forward.quartz(0.62), forward.mgf2(0.62)
    return (mgf2 * (m_e - m_o) - 0.5 * 0.62) / (q_e - q_o)


def bench(mgf2=None):
    instrument = nominal_instrument("WALOP-LAB")
    if mgf2 is None:
        return instrument
    return builders.with_plates(instrument, zero_order_quartz(mgf2), mgf2, ("half1.plate", "half2.plate"))


def matrix(instrument, plan, tilt=TILT):
    """X of a field point is the tilt in degrees."""
    vectors = builders.vectors(instrument, plan, tilt, np.zeros_like(tilt))
    return builders.matrix(vectors)[:, 0]


@pytest.fixture(scope="module")
def band():
    return builders.setting_plan(builtin_filter("SDSS-r"))


def fitted(plan):
    """The thickness that fits best; in monochromatic light ripples of the cross-talk make local minima."""
    results = [
        least_squares(
            lambda d: matrix(bench(float(d[0])), plan)[:, 1, 1] - CROSS_TALK, [start], diff_step=1e-4
        )
        for start in (450.0, 480.0, 510.0)
    ]
    return float(min(results, key=lambda result: result.cost).x[0])


def test_one_thickness_explains_the_table(band):
    """One free number, five measurements, all within a point; the instrument comes with that number."""
    thickness = fitted(band)
    best = matrix(bench(thickness), band)[:, 1, 1]
    np.testing.assert_allclose(best, CROSS_TALK, atol=0.01)
    assert builders.value(bench(), "half2.plate.mgf2") == pytest.approx(thickness, abs=1.0)
    assert builders.value(bench(), "half2.plate.quartz") == pytest.approx(zero_order_quartz(474.0), rel=1e-7)
    np.testing.assert_allclose(matrix(bench(), band)[:, 1, 1], CROSS_TALK, atol=0.01)


def test_retardance_falls_with_the_square_of_the_tilt(band):
    """180° − δ = 0.321° (tilt/deg)², constant to 2 % (numbers.md); δ from m32 = (1 + cos δ)/2."""
    m32 = matrix(bench(), band)[:, 1, 1]
    rate = (180.0 - np.rad2deg(np.arccos(2 * m32 - 1))) / TILT**2
    np.testing.assert_allclose(rate, 0.321, rtol=0.03)


def test_plate_that_is_not_tilted_has_no_cross_talk(band):
    found = matrix(bench(), band, np.array([0.0]))[0]
    np.testing.assert_allclose(found, [[0, 1, 0], [0, 0, 1]], atol=0.02)
    m32 = found[1, 1]
    assert m32 < 0.01

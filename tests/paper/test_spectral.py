"""The spectral appendix: against the oracle, wavelength by wavelength and colour by colour; the issue's numbers."""

from __future__ import annotations

import builders
import numpy as np
import pytest
from oracle import forward

from walop_jax.paper.polynomial import fit_paper
from walop_jax.paper.wavelength import TEMPERATURES, colour_spread, efficiencies, spread_document

X, Y = np.array([-0.2, 0.1, 0.25]), np.array([0.15, -0.05, 0.12])


@pytest.fixture(scope="module")
def params(calibration):
    return builders.oracle_params(calibration.model.instrument(calibration.values))


@pytest.mark.long
def test_efficiencies_by_the_oracle(calibration, params):
    wavelength = np.array([0.56, 0.6, 0.62, 0.68])
    found = efficiencies(calibration, 0.25, 0.12, wavelength)
    for k, w in enumerate(wavelength):
        m = forward.matrix(params, np.array([0.25]), np.array([0.12]), np.array([w]), np.ones(1))
        expected = [[m["m21"][0], m["m22"][0], m["m23"][0]], [m["m31"][0], m["m32"][0], m["m33"][0]]]
        np.testing.assert_allclose(found[k], expected, atol=1e-9)


def test_colour_spread_by_the_oracle(calibration, params):
    """(q_m, u_m) of 1 % polarised stars of four temperatures, integrated over the table of the filter itself."""
    curve = calibration.filter_curve("SDSS-r")
    angle = np.arange(36) * np.pi / 36
    stars = np.stack([np.ones(36), 0.01 * np.cos(2 * angle), 0.01 * np.sin(2 * angle), np.zeros(36)])
    seen = []
    for teff in TEMPERATURES:
        band = forward.band(curve.wavelength, curve.throughput, teff)
        n = forward.analysis_vectors(params, X, Y, *band) @ stars  # point, camera, star
        seen.append([(n[:, i] - n[:, i + 1]) / (n[:, i] + n[:, i + 1]) for i in (0, 2)])
    expected = np.ptp(np.array(seen), axis=0).max(axis=-1).T
    np.testing.assert_allclose(
        colour_spread(calibration, X, Y), expected, atol=2e-7
    )  # the quadrature is good to 1e-6


def test_sources_of_one_colour_do_not_differ(calibration):
    np.testing.assert_allclose(colour_spread(calibration, X, Y, (5000.0, 5000.0)), 0, atol=1e-15)


def test_statistics_by_hand():
    told = spread_document(np.array([[1e-5, 2e-4], [3e-5, 6e-4]]))
    assert told["q"] == {
        "median": pytest.approx(0.002),
        "max": pytest.approx(0.003),
        "share_negligible": 1.0,
        "share_below_sensitivity": 1.0,
    }
    assert told["u"]["share_below_sensitivity"] == 0.5


def test_paper_field(calset, calibration):
    """Paper II: negligible in q, of order 0.01 % in u and below 0.05 % almost everywhere, for p = 1 %."""
    made = fit_paper(calset)
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(made.x.min(), made.x.max(), 12)]))
    told = spread_document(colour_spread(calibration, x, y))
    assert told["q"]["share_negligible"] == 1.0
    assert 0.003 < told["u"]["median"] < 0.03
    assert told["u"]["share_below_sensitivity"] > 0.9

"""Wavelength nodes against polynomials, and against sums over the tabulated curves by the oracle."""

import itertools

import builders
import numpy as np
import pytest
from oracle import forward

from walop_jax.data.settings import builtin_filter
from walop_jax.model import quadrature

CENTRE_TO_CORNERS = (
    np.array([0.0, 0.29, 0.29, -0.29, -0.29, 0.29, 0.11]),
    np.array([0.0, 0.29, -0.29, 0.29, -0.29, 0.0, -0.23]),
)
SETTINGS = (None, 0.0, 45.0)


def super_gaussian(half_width, power, rows=461, first=0.505, last=0.735):
    wavelength = np.linspace(first, last, rows)
    return wavelength, np.exp(-((np.abs(wavelength - 0.62) / half_width) ** power))


def sdss_r():
    curve = builtin_filter("SDSS-r")
    return curve.wavelength, curve.throughput


CURVES = {
    "SDSS-r": sdss_r,
    "flat-topped": lambda: super_gaussian(0.062, 8),
    "steep": lambda: super_gaussian(0.065, 40),
    "soft": lambda: super_gaussian(0.05, 4),
    "box": lambda: (np.linspace(0.555, 0.685, 261), np.ones(261)),
    "narrow": lambda: super_gaussian(0.005, 2, 81, 0.6, 0.64),
    "coarse, every 5 nm": lambda: super_gaussian(0.062, 8, 47),
    "monochromatic": lambda: (np.array([0.6328]), np.array([0.7])),
}


def gauss_rule(node, weight, count):
    return next(quadrature.gauss_rules(node, weight, range(count, count + 1)))


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_gauss_rule_is_exact_for_polynomials(count):
    """Degree 2n − 1, on a lopsided discrete measure; degree 2n is not."""
    rng = np.random.default_rng(1)
    node, weight = np.sort(rng.uniform(0.5, 0.7, 60)), rng.uniform(0.1, 1.0, 60)
    weight /= weight.sum()
    found, found_weight = gauss_rule(node, weight, count)
    assert found_weight.min() > 0
    t, found_t = (node - 0.6) / 0.1, (found - 0.6) / 0.1
    for degree in range(2 * count):
        assert found_weight @ found_t**degree == pytest.approx(weight @ t**degree, abs=1e-13)
    assert abs(found_weight @ found_t ** (2 * count) - weight @ t ** (2 * count)) > 1e-9


def test_gauss_rule_of_the_uniform_measure_is_gauss_legendre():
    """The three-point rule typed: ± √(3/5), weights 5/18, 4/9, 5/18."""
    edges = np.linspace(-1, 1, 200001)
    middle = 0.5 * (edges[1:] + edges[:-1])
    node, weight = gauss_rule(middle, np.full(middle.size, 1 / middle.size), 3)
    np.testing.assert_allclose(node, [-0.7745966692, 0, 0.7745966692], atol=1e-9)
    np.testing.assert_allclose(weight, [5 / 18, 4 / 9, 5 / 18], atol=1e-9)


def test_tabulated_measure_is_the_trapezium_rule_on_lines_between_the_rows():
    """A triangle of base 0.02 µm, whose mean and variance are known: 0.6 and half base² / 6."""
    node, weight = quadrature.tabulated_measure(np.array([0.59, 0.6, 0.61]), np.array([0.0, 1.0, 0.0]))
    assert weight.sum() == pytest.approx(1.0, abs=1e-14)
    assert weight @ node == pytest.approx(0.6, abs=1e-14)
    # exact up to the trapezium's h²/6
    assert weight @ (node - 0.6) ** 2 == pytest.approx(0.01**2 / 6, abs=0.0005**2 / 5)
    assert np.diff(node).max() < 0.000501


def continuum(wavelength, throughput, step):
    """The curve of straight lines between the rows, summed at a finer step."""
    if wavelength.size == 1:
        return wavelength, throughput
    gaps = itertools.pairwise(wavelength)
    pieces = [np.linspace(a, b, max(1, round((b - a) / step)), endpoint=False) for a, b in gaps]
    fine = np.concatenate([*pieces, wavelength[-1:]])
    return fine, np.interp(fine, wavelength, throughput)


def with_spectrum(node, weight, teff):
    weight = weight * forward.photon_spectrum(node, teff)
    return weight / weight.sum()


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("teff", [None, 3500.0], ids=["flat", "3500 K"])
def test_band_rule_has_converged(name, teff):
    """To 1e-6 of the intensities (docs: model), over the field, calibration plate out, at 0° and at 45°.

    Measured: 2e-8 from the sum over the table (refined to 0.5 nm where it is coarser). The integral over
    straight lines between rows of 0.5 nm is another reading of "tabulated curve"; it differs by up to 8e-6
    (plate fringes of 17 nm, attenuated by the lines), which bounds what refining further could change.
    """
    rng = np.random.default_rng(5)
    params = builders.oracle_params(builders.south(rng))
    curve = CURVES[name]()
    node, weight = quadrature.band_rule(*curve)
    refined, finer = (forward.band(*continuum(*curve, step), teff) for step in (0.0005, 0.0001))
    few = tuple(v[:2] for v in CENTRE_TO_CORNERS)
    for setting in SETTINGS:
        rule = forward.analysis_vectors(
            params, *CENTRE_TO_CORNERS, node, with_spectrum(node, weight, teff), setting
        )
        full = forward.analysis_vectors(params, *CENTRE_TO_CORNERS, *refined, setting)
        level = full[:, :, :1].max()
        np.testing.assert_allclose(rule, full, rtol=0, atol=1e-7 * level)
        if teff is None and setting is not None:
            continue
        limit = forward.analysis_vectors(params, *few, *finer, setting)
        np.testing.assert_allclose(rule[:2], limit, rtol=0, atol=1e-5 * level)


def test_band_rule_is_not_wasteful():
    """SDSS-r: at most a quarter more nodes than the fewest from which on the error stays below 1e-6 (35)."""
    params = forward.nominal()
    curve = sdss_r()
    measure = quadrature.tabulated_measure(*curve)
    full = forward.analysis_vectors(params, *CENTRE_TO_CORNERS, *measure)
    count = len(quadrature.band_rule(*curve)[0])
    error = {}
    for n in range(20, count + 1):
        found = forward.analysis_vectors(params, *CENTRE_TO_CORNERS, *gauss_rule(*measure, n))
        error[n] = np.abs(found - full).max() / full[:, :, 0].max()
    fewest = 1 + max(n for n, e in error.items() if e > 1e-6)
    assert fewest <= count <= 1.25 * fewest


def test_monochromatic_and_short_tables_are_taken_as_they_are():
    node, weight = quadrature.band_rule(np.array([0.6328]), np.array([0.4]))
    np.testing.assert_array_equal(node, [0.6328])
    np.testing.assert_array_equal(weight, [1.0])

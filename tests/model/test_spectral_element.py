"""The spectral element against scipy's splines and Mueller matrices by hand; beams that differ in wavelength."""

from __future__ import annotations

from pathlib import Path

import builders
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_arm import POLARISER, one_arm
from scipy.interpolate import CubicSpline

from walop_jax.data.records import FilterCurve, Position
from walop_jax.io.errors import DataError
from walop_jax.model import mueller
from walop_jax.model.elements.simple import Analyser
from walop_jax.model.elements.spectral import SpectralElement, spline
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import leaves
from walop_jax.model.planning import plan_for
from walop_jax.model.ray import Conditions, Ray

KNOTS = (1.1, 1.3, 1.45, 2.0, 2.4)
VALUES = np.array([0.3, -0.2, 1.1, 0.9, 2.5])
MIRRORS = """
[elements.mirrors]
kind = "spectral"
moves = "DEROT"
axis = 20.0
delta_at = [1.1, 1.3, 1.45, 2.0, 2.4]
delta = { value = [0.3, -0.2, 1.1, 0.9, 2.5], sigma = 0.1, unit = "rad" }
diattenuation_at = [1.6]
diattenuation = [0.05]
"""
TEXT = one_arm(
    "CURVES", ["polariser", "mirrors"], POLARISER + MIRRORS, field="limit = 0.2", cameras=("left", "right"),
    analyser="efficiency = 0.9",
)  # fmt: skip


def ray(wavelength) -> Ray:
    wavelength = jnp.asarray(wavelength)
    return Ray.entering(
        jnp.zeros(()), jnp.zeros(()), (wavelength, Conditions(jnp.zeros_like(wavelength), {}))
    )


def test_spline_is_the_natural_one():
    at = np.linspace(1.1, 2.4, 101)
    expected = CubicSpline(KNOTS, VALUES, bc_type="natural")
    np.testing.assert_allclose(spline(KNOTS, jnp.asarray(VALUES), jnp.asarray(at)), expected(at), atol=1e-12)
    for end in (1.1, 2.4):
        off = 0.3 * np.sign(end - 1.5)
        straight = expected(end) + off * expected(end, 1)
        np.testing.assert_allclose(spline(KNOTS, jnp.asarray(VALUES), jnp.asarray([end + off]))[0], straight)


def test_spline_of_one_and_two_values():
    at = jnp.asarray([1.0, 1.5, 3.0])
    np.testing.assert_allclose(spline((1.5,), jnp.asarray([0.7]), at), 0.7)
    np.testing.assert_allclose(spline((1.0, 2.0), jnp.asarray([0.0, 2.0]), at), [0.0, 1.0, 4.0])


def test_slope_of_the_spline_is_exact():
    at = jnp.linspace(0.9, 2.6, 37)
    slope = jax.vmap(jax.grad(lambda w: spline(KNOTS, jnp.asarray(VALUES), w[None])[0]))(at)
    inside = (at > 1.1) & (at < 2.4)
    expected = CubicSpline(KNOTS, VALUES, bc_type="natural")(np.asarray(at), 1)
    np.testing.assert_allclose(slope[inside], expected[np.asarray(inside)], atol=1e-10)


def test_matrix_by_hand():
    """A diattenuating retarder along +X (k = √(1 − D²)), then a loss."""
    delta, d, lost = 0.8, 0.3, 0.1
    element = SpectralElement(
        delta=[delta],
        delta_at=(1.0,),
        diattenuation=[d],
        diattenuation_at=(1.0,),
        loss=[lost],
        loss_at=(1.0,),
    )
    k, c, s = np.sqrt(1 - d**2), np.cos(delta), np.sin(delta)
    by_hand = np.array([[1, d, 0, 0], [d, 1, 0, 0], [0, 0, k * c, k * s], [0, 0, -k * s, k * c]])
    by_hand[1:] *= 1 - lost
    np.testing.assert_allclose(element.mueller(ray([0.6, 2.0])), [by_hand, by_hand], atol=1e-14)
    assert SpectralElement().mueller(ray([0.6])) is None
    turn = SpectralElement(rotation=[10.0], rotation_at=(1.0,)).mueller(ray([0.6]))[0]
    up = np.deg2rad(2 * np.array([25.0, 35.0]))
    np.testing.assert_allclose(
        np.asarray(turn) @ np.array([1, np.cos(up[0]), np.sin(up[0]), 0.2]),
        [1, np.cos(up[1]), np.sin(up[1]), 0.2],
    )


def test_a_description_gives_curves_and_their_parameters(tmp_path):
    instrument = read(tmp_path, TEXT)
    assert [name for name in names(instrument) if name.startswith("mirrors")] == [
        f"mirrors.delta{i}" for i in range(1, 6)
    ]


def names(instrument: Instrument) -> list[str]:
    return [leaf.name for leaf in leaves(instrument)]


def read(folder: Path, text: str) -> Instrument:
    path = folder / "curves.toml"
    path.write_text(text)
    return Instrument.read(path)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("delta_at = [1.1, 1.3, 1.45, 2.0, 2.4]", "delta_at = [1.1, 1.3]", "5 values for 2 wavelengths"),
        ("delta_at = [1.1, 1.3, 1.45, 2.0, 2.4]", "", "delta_at is missing"),
        ("diattenuation_at = [1.6]", "diattenuation_at = [1.6, 1.5]", "increase"),
        ("diattenuation = [0.05]", "diattenuation = 0.05", "a list of numbers"),
        ("axis = 20.0", "axis = [20.0]", "one number"),
    ],
)
def test_a_description_that_does_not_fit(tmp_path, old, new, what):
    with pytest.raises(DataError, match=what):
        read(tmp_path, TEXT.replace(old, new))


# ----------------------------------------------------------------------------- beams of different wavelength


def vectors(instrument: Instrument, stretch: float = 1.0) -> np.ndarray:
    wavelength = np.linspace(1.41, 1.59, 181)
    curve = FilterCurve("band", stretch * wavelength, np.exp(-0.5 * ((wavelength - 1.5) / 0.025) ** 2))
    moving = {"DEROT": Position(np.array([True]), np.array([12.0]))}
    exposures = builders.exposures({"kind": "flux"}).placed(**moving)
    plan = plan_for(instrument, exposures, {"band": curve})
    return builders.vectors(instrument, plan, 0.0, 0.0)[0, 0]


def test_each_beam_sees_its_own_wavelength(tmp_path):
    """Against instruments without dispersion behind a filter displaced by ±κ: the same to second order in κ."""
    plain, kappa = read(tmp_path, TEXT), 1e-3
    both = vectors(plain.changed("main.analyser", dispersion=jnp.asarray(kappa)))
    first, second = vectors(plain, 1 + kappa)[0], vectors(plain, 1 - kappa)[1]
    assert np.abs(first - vectors(plain)[0]).max() > 1e-3
    np.testing.assert_allclose(both, [first, second], atol=1e-5)
    none = vectors(plain.changed("main.analyser", dispersion=jnp.asarray(0.0)))
    np.testing.assert_allclose(none, vectors(plain), atol=1e-14)


def test_beams_of_a_band_by_hand():
    """½ (1 ± g)(S0 ± (1 − l) q) with g = 0.1, l = 0.2: 0.55 (1 + 0.8 · 0.5) and 0.45 (1 − 0.8 · 0.5)."""
    analyser = Analyser(
        balance=np.array([0.1]), balance_at=(1.0,), loss=np.array([0.2]), loss_at=(1.0,), cameras=("a", "b")
    )
    seen = np.zeros((1, 2, 4))
    seen[0, :, 0] = 1.0, 0.5
    rows = analyser.in_band(jnp.asarray(seen), jnp.array([1.3]))[0, :, 0]
    np.testing.assert_allclose(analyser.beam_weights() @ rows, [0.77, 0.27], rtol=1e-14)


def test_beams_see_neighbouring_wavelengths():
    """First beam ½ (1 + κ λ∂)(S0 + q), second ½ (1 − κ λ∂)(S0 − q)."""
    analyser = Analyser(dispersion=0.01, cameras=("a", "b"))
    expected = [[0.005, 0.005], [-0.005, 0.005]]
    np.testing.assert_allclose(analyser.beam_weights_of_slopes(), expected, rtol=1e-14)


def test_a_spread_of_the_retardance_is_the_mean_of_its_retarders():
    """Gaussian retardances of width σ: what is not along the axis keeps exp(−σ²/2), by quadrature."""
    sigma, delta, axis = 0.4, 1.3, np.deg2rad(25.0)
    nodes, weights = np.polynomial.hermite_e.hermegauss(30)
    each = np.stack(
        [np.asarray(mueller.retarder(jnp.asarray(delta + sigma * x), jnp.asarray(axis))) for x in nodes]
    )
    expected = np.einsum("n,nij->ij", weights / weights.sum(), each)
    element = SpectralElement(
        delta=jnp.array([delta]), delta_at=(0.6,), spread=jnp.array([1.0 - np.exp(-0.5 * sigma**2)]),
        spread_at=(0.6,), axis=jnp.array(25.0),
    )  # fmt: skip
    np.testing.assert_allclose(element.mueller(ray(np.array([0.6])))[0], expected, atol=1e-12)

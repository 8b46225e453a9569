"""A diattenuator over field and colour, beams of unequal efficiency, ties and choices of descriptions, by hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.instruments.description import parsed
from walop_jax.io.errors import DataError
from walop_jax.model.elements.geometry import Wedge
from walop_jax.model.elements.simple import Analyser
from walop_jax.model.elements.spectral import FieldDiattenuator
from walop_jax.model.instrument import build
from walop_jax.model.ray import Conditions, Ray
from walop_jax.model.specification import make_model

TEXT = """
name = "PAIR"
path = ["polariser", "chwp"]
[field]
limit = 0.3
[cameras]
names = ["A", "B", "C", "D"]
split = true
floor = 0.01
[throughput]
degree = 0
[elements.polariser]
kind = "polariser"
moves = "CLP"
[elements.chwp]
kind = "wave_plate"
moves = "CHWP"
always_in = true
[[elements.chwp.layers]]
name = "quartz"
material = "quartz"
thickness = { value = 100.0, sigma = 1.0, unit = "um", tie = "one.plate.quartz" }
[arms.one]
path = ["plate", "balance", "analyser"]
[arms.one.elements.plate]
kind = "wave_plate"
[[arms.one.elements.plate.layers]]
name = "quartz"
material = "quartz"
thickness = { value = 90.0, sigma = 1.0, unit = "um" }
[arms.one.elements.balance]
kind = "field_diattenuator"
at = [0.5, 0.7]
none_at = 0.6
p10 = { value = [0.0, 0.0], sigma = 0.01 }
[arms.one.elements.analyser]
kind = "analyser"
cameras = ["A", "B"]
[arms.two]
path = ["analyser"]
[arms.two.elements.analyser]
kind = "analyser"
cameras = ["C", "D"]
"""


def ray(x: float, y: float, wavelength: float) -> Ray:
    nodes = jnp.array([wavelength])
    return Ray.entering(jnp.asarray(x), jnp.asarray(y), (nodes, Conditions(jnp.zeros(1), {})))


@pytest.mark.parametrize(
    ("x", "y", "wavelength", "expected"),
    [
        (0.3, 0.0, 0.5, 0.02 + 0.05),  # P1(1) = 1, P2(1) = 1
        (0.15, 0.0, 0.5, 0.01 - 0.125 * 0.05),  # P1(1/2) = 1/2, P2(1/2) = -1/8
        (0.3, 0.0, 0.7, 0.04 + 0.05),
        (0.3, 0.0, 0.6, 0.03 + 0.05),  # two values: a straight line
        (0.3, 0.3, 0.8, 0.05 + 0.05),  # continued as one
    ],
)
def test_terms_over_field_and_colour(x: float, y: float, wavelength: float, expected: float):
    element = FieldDiattenuator(p10=[0.02, 0.04], p20=[0.05, 0.05], at=(0.5, 0.7))  # pyright: ignore
    matrix = np.asarray(element.mueller(ray(x, y, wavelength)))[0]
    assert matrix[0, 1] == pytest.approx(expected, rel=1e-12)
    assert matrix[1, 0] == pytest.approx(expected, rel=1e-12)
    assert matrix[2, 2] == pytest.approx(np.sqrt(1 - expected**2), rel=1e-12)


def test_along_45_degrees_it_acts_on_u():
    element = FieldDiattenuator(p00=[0.1], at=(0.6,), axis=45.0)  # pyright: ignore
    matrix = np.asarray(element.mueller(ray(0.1, 0.2, 0.6)))[0]
    np.testing.assert_allclose(matrix[0], [1.0, 0.0, 0.1, 0.0], atol=1e-15)


def test_it_vanishes_where_it_is_told_to():
    element = FieldDiattenuator(p00=[0.1, 0.2], at=(0.5, 0.7), none_at=0.6)  # pyright: ignore
    at = [float(np.asarray(element.mueller(ray(0.0, 0.0, w)))[0, 0, 1]) for w in (0.5, 0.6, 0.7)]
    np.testing.assert_allclose(at, [0.1, 0.0, 0.2], atol=1e-15)
    assert FieldDiattenuator().mueller(ray(0.0, 0.0, 0.6)) is None
    with pytest.raises(ValueError, match="none_at"):
        FieldDiattenuator(p00=[0.1, 0.2], at=(0.5, 0.7), none_at=0.5)  # pyright: ignore
    with pytest.raises(ValueError, match="3 values for 2 wavelengths"):
        FieldDiattenuator(p01=[0.1, 0.2, 0.3], at=(0.5, 0.7))  # pyright: ignore


def test_ahead_of_an_analyser_it_is_a_ratio_of_the_beams():
    """Unpolarised light: (1 + D)/(1 − D); light along the axis goes into the first beam alone."""
    element = FieldDiattenuator(p00=[0.2], at=(0.6,))  # pyright: ignore
    matrix = element.mueller(ray(0.0, 0.0, 0.6))
    assert matrix is not None
    analyser = Analyser()
    beams = np.asarray(analyser.beam_weights() @ analyser.seen(matrix[0]))
    np.testing.assert_allclose(beams[:, 0], [0.6, 0.4], rtol=1e-14)
    np.testing.assert_allclose(beams @ [1.0, 1.0, 0.0, 0.0], [1.2, 0.0], atol=1e-15)


def test_beams_of_unequal_efficiency():
    """η = 0.9, ξ = 0.05: ½ (1, 0.95, 0, 0) and ½ (1, −0.85, 0, 0)."""
    analyser = Analyser(efficiency=0.9, contrast=0.05)  # pyright: ignore
    beams = np.asarray(analyser.beam_weights() @ analyser.seen(jnp.eye(4)))
    np.testing.assert_allclose(beams, [[0.5, 0.475, 0.0, 0.0], [0.5, -0.425, 0.0, 0.0]], atol=1e-15)


def test_a_wedge_the_other_way_round():
    entering = ray(0.2, 0.1, 0.6).toward(jnp.asarray(0.02), jnp.asarray(0.01))
    one = Wedge(angle=-0.2, frame="turned")  # pyright: ignore
    other = Wedge(angle=0.2, sense=-1.0, frame="turned")  # pyright: ignore
    assert float(one.ray(entering).kx[0]) == float(other.ray(entering).kx[0])
    np.testing.assert_array_equal(one.mueller(entering), other.mueller(entering))


def test_a_description_with_ties_shares_and_a_floor():
    instrument = build(parsed(TEXT, "text"))
    model = make_model("PAIR", instrument)
    assert model["chwp.quartz"].tie == "one.plate.quartz"
    assert model.start[model.index("chwp.quartz")] == 90.0
    assert "one.balance.p10_1" in model.names
    assert "one.balance.p10_2" in model.names
    assert instrument.elements[1].position(None) == 0.0
    assert instrument.cameras.fluxes == 2
    np.testing.assert_array_equal(instrument.cameras.together, np.kron(np.eye(2), np.ones((2, 2))))
    assert instrument.cameras.noise_floor == 0.01


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("split = true", "split = 1", "split = 1 must be true or false"),
        ("floor = 0.01", "floor = 1.5", "fraction of the light"),
        ("always_in = true", "always_in = 1.0", "must be true or false"),
        ("none_at = 0.6", "none_at = 0.5", "none_at"),
    ],
)
def test_what_is_wrong_is_said(old: str, new: str, words: str):
    with pytest.raises(DataError, match=words):
        build(parsed(TEXT.replace(old, new), "text"))


def test_a_tie_to_nothing_names_the_nearest():
    text = TEXT.replace('tie = "one.plate.quartz"', 'tie = "one.plate.quarz"')
    with pytest.raises(ValueError, match=r"one\.plate\.quartz"):
        make_model("PAIR", build(parsed(text, "text")))

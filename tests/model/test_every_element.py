"""What every kind of element owes: a source, a test of its own, and nothing done by one without numbers."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model.elements.base import Element
from walop_jax.model.elements.registry import ELEMENTS
from walop_jax.model.ray import Conditions, Ray

TESTS = Path(__file__).parent
EXPECTED = {
    "polariser": "it makes light of its own",
    "analyser": "it ends the light path",
    "analysis_vector": "it is the response of a camera",
    "pupil_mapping": "it makes directions of field points",
}
"""Kinds of elements that act without any numbers, and why."""
every_element = pytest.mark.parametrize("kind", ELEMENTS, ids=lambda kind: kind.kind)


@every_element
def test_a_source_is_cited(kind: type[Element]):
    """`walop-jax cite` prints it for every fit that uses the element."""
    assert kind.reference, f"give {kind.__name__} a `reference`: author, year, work"


@every_element
def test_a_test_makes_one(kind: type[Element]):
    """By its class, or in a description. That the page lists it is asked in `tests/test_docs.py`."""
    texts = [path.read_text() for path in TESTS.rglob("test_*.py") if path.name != Path(__file__).name]
    made = f"{kind.__name__}(", f'"{kind.kind}"', f"{kind.__name__}."
    assert any(word in text for text in texts for word in made), (
        f"no test in {TESTS} makes a {kind.__name__}: hold its Mueller matrix against a closed form or another program"
    )


@every_element
def test_one_without_numbers_does_nothing(kind: type[Element]):
    if kind.kind in EXPECTED:
        return
    wavelength = jnp.array([0.55, 0.62, 0.7])
    spectrum = wavelength, Conditions(0.1 * jnp.ones(3), {})
    ray = Ray.entering(jnp.array(0.1), jnp.array(-0.2), spectrum).toward(jnp.array(0.05), jnp.array(0.02))
    element = kind()
    matrix, behind = element.mueller(ray), element.ray(ray)
    if matrix is not None:
        np.testing.assert_allclose(matrix, np.broadcast_to(np.eye(4), matrix.shape), atol=1e-15)
    for there, here in ((behind.kx, ray.kx), (behind.ky, ray.ky)):
        np.testing.assert_allclose(there, np.broadcast_to(here, jnp.shape(there)), atol=1e-15)

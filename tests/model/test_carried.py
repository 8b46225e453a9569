"""What a model may not take with it to other exposures, found by patching and by asking."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import builders
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model.carried import left_behind, reported
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.elements import Element
from walop_jax.model.mueller import diattenuator
from walop_jax.model.parameters import number, param

CONTEXT = Context(exposures=3, sources=("STD00",))


class DryingWindow(Element):
    """A diattenuator that grows with time."""

    rate: Scalar = number(unit="h-1", about="growth")

    def mueller(self, ray):
        return diattenuator(self.rate * ray.conditions.hours, jnp.zeros_like(ray.conditions.hours))


class Drying(Effect):
    """Optics that change during a run."""

    rate: Scalar = param(unit="h-1", about="growth", source="this test", width=1e-3, default=0.0)
    name: ClassVar[str] = "drying"

    def patch(self, instrument):
        return instrument.inserted(DryingWindow(name="window", rate=self.rate), after="collimator")


@pytest.mark.parametrize(
    ("name", "stays"),
    [
        ("hwp_temperature", False), ("flexure", False), ("telescope_polarisation", False),
        ("camera_leakage", False), ("nonlinearity", False),
        ("ghost", True), ("camera_gain_drift", True), ("pedestal", True),
    ],
)  # fmt: skip
def test_what_stays_behind(name, stays):
    effect = effect_by_name(name).neutral(CONTEXT)
    assert left_behind(builders.south(None, (effect,))) == ((name,) if stays else ())


def test_optics_that_know_the_time_stay_behind():
    effects = (Drying(rate=jnp.asarray(1e-3)), effect_by_name("hwp_temperature").neutral(CONTEXT))
    assert left_behind(builders.south(None, effects)) == ("drying",)


def test_detectors_that_ask_for_their_counts_alone_are_known():
    effect = dataclasses.replace(
        effect_by_name("nonlinearity").neutral(CONTEXT), coefficient=jnp.asarray(0.02)
    )
    counts = np.array([[1e5, 5e5, 1e6, 2e6]])
    found = reported(builders.south(None, (effect,)), jnp.asarray(counts))
    np.testing.assert_allclose(found, counts * (1 + 0.02 * counts / 1e6), rtol=1e-13)

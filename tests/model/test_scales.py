"""Scales of field and wavelength are those of the instrument: narrow and wide fields, bands in the infrared."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.instruments.description import parsed
from walop_jax.model import legendre
from walop_jax.model.conventions import Units
from walop_jax.model.effects import Change, effect_by_name
from walop_jax.model.effects.base import Context
from walop_jax.model.effects.blemish import Blemish
from walop_jax.model.effects.change import AtPoint, patched
from walop_jax.model.effects.free_form import SMOOTH, FreeForm
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.instrument import build, nominal_instrument
from walop_jax.model.ray import Ray
from walop_jax.simulation.observing_plan import ObservingPlan

SOUTH_LIKE = 'name = "OTHER"\nlike = "WALOP-SOUTH"\n'


def like_south(field: str = "", head: str = ""):
    return build(parsed(f"{SOUTH_LIKE}{head}\n[field]\n{field}\n", "a text"))


INSTRUMENTS = {
    "WALOP-SOUTH": (lambda: nominal_instrument("WALOP-SOUTH"), 0.3),
    "WALOP-NORTH": (lambda: nominal_instrument("WALOP-NORTH"), 0.3),
    "WALOP-LAB": (lambda: nominal_instrument("WALOP-LAB"), 20.0),
    "small": (lambda: like_south("limit = 0.02"), 0.02),
    "small, as stated": (lambda: like_south("limit = 0.03\nscale = 0.02"), 0.02),
    "points to an edge": (lambda: like_south("edge = 0.25"), 0.25),
}


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_patterns_over_the_field_are_of_one_size(name):
    """Condition of the 15 smooth patterns over a square: that of Legendre polynomials on ±1, far below 1e5."""
    make, scale = INSTRUMENTS[name]
    instrument = make()
    assert instrument.units.field == instrument.throughput.scale == scale
    side = np.linspace(-scale, scale, 9)
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    effect = FreeForm.of(Context(), blocks=("vectors",))
    (part,) = effect.patch(instrument).cameras.mixing
    smooth = legendre.basis(x, y, SMOOTH, part.scale)
    assert smooth.shape[1] == 15
    assert np.linalg.cond(smooth) < 10.0


@pytest.mark.parametrize(("text", "expected"), [
    ("x", 1.0), ("r2", 1.25), ("x2-y2", 0.75), ("xy", 1.0), ("ring 1", 0.25), ("colour", 0.5),
])  # fmt: skip
def test_factors_are_counted_in_the_scales_of_an_instrument(text, expected):
    """At X = h, Y = h/2 and λ = 3/2 λ₀, worked out by hand."""
    change = Change.parsed(f"retardance q behind collimator * {text}").counted_in(Units(20.0, 1.6))

    class InTheRed(AtPoint):
        wavelength = 2.4

    assert change.factor(InTheRed(20.0, 10.0)) == pytest.approx(expected)


def test_changes_of_an_instrument_are_counted_in_its_scales():
    """A retardance radial in the field is 0.1 rad at the scale of the field, whatever that is."""
    for instrument in (nominal_instrument("WALOP-SOUTH"), like_south("limit = 0.02")):
        change = Change.parsed("retardance radial behind collimator")
        added = patched(instrument, [(change, jnp.asarray(0.1))]).element("described")
        scale = instrument.units.field
        matrix = np.asarray(added.mueller(Ray.entering(jnp.asarray(scale), jnp.zeros(()))))
        assert matrix[2, 2] == pytest.approx(np.cos(0.1), abs=1e-12)  # axis along X: u turns into v


def test_words_have_the_scales():
    change = Change.parsed("turn of polariser * x * colour").counted_in(Units(20.0, 1.6))
    assert "(amplitude at 20°)" in change.in_words()
    assert "λ/1.6 µm" in change.in_words()
    assert "(amplitude at 0.3°)" in Change.parsed("turn of polariser * x").in_words()


def test_fringes_are_looked_for_a_quarter_apart_at_the_wavelength_of_the_instrument():
    """A pair at gaps g and g + λ/8: cos φ and −sin φ; amplitudes of a fringe at g + s are its cosine and sine."""
    instrument = like_south(head="wavelength = 1.6")
    exposures = ObservingPlan(grid=3).exposures()
    pairs = effect_by_name("etalon").probes(effect_context(instrument, exposures))
    gaps = np.array([[float(one.gap) for one in pair] for pair in pairs])
    np.testing.assert_allclose(gaps[:, 1] - gaps[:, 0], 0.2)
    # Neighbours are no more than a fringe and a half apart, as for WALOP: 0.75 µm at 0.62 µm.
    np.testing.assert_allclose(np.diff(gaps[:, 0]), 0.75 * 1.6 / 0.62)
    shift, wave = 0.07, 4.0 * np.pi / 1.6
    found = effect_by_name("etalon").combine(pairs[3], [np.cos(wave * shift), np.sin(wave * shift)])
    assert float(found.contrast) == pytest.approx(1.0)
    assert float(found.gap) == pytest.approx(gaps[3, 0] + shift)


def test_dark_spots_are_looked_for_over_the_field_that_there_is():
    exposures = ObservingPlan(grid=3).exposures()
    for instrument in (nominal_instrument("WALOP-SOUTH"), like_south("limit = 0.02")):
        spots = [one for (one,) in Blemish.probes(effect_context(instrument, exposures))]
        reach, scale = max(float(one.x) for one in spots), instrument.units.field
        assert reach == pytest.approx(0.25 / 0.3 * scale)
        assert float(spots[0].size) == pytest.approx(0.2 * scale)

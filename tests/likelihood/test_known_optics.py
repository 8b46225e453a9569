"""Programs of the optics leave out what changes no row: rows and residuals are those of the whole instrument."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_run import SMALL

from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import engine, optics
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import light
from walop_jax.model.effects import EFFECTS, effect_by_name
from walop_jax.model.effects.in_models import with_effects
from walop_jax.simulation.simulate import simulate

AHEAD_OR_BEHIND = {
    "moon_multiple_scattering", "moon_patch", "rotator_zero", "standard_outlier", "standard_values", "standard_colour",
    "standard_drift", "standard_angles", "standard_degrees", "telescope_polarisation", "clp_zero", "clp_wobble",
    "clp_extinction", "clp_ellipticity", "lens_birefringence", "upstream_retarder", "blemish", "camera_leakage",
    "ghost", "pedestal", "nonlinearity", "camera_gain_drift",
}  # fmt: skip
"""Effects on sources, polariser, collimator and cameras: the rows are of what lies between."""


@pytest.fixture(scope="module")
def calset():
    return simulate(SMALL, seed=1).calset


def likelihood_with(calset, *names: str):
    model = with_effects(base_model(calset), [effect_by_name(name) for name in names], calset)
    return Likelihood.of(calset, model)


def test_effects_between_pupil_and_cameras_change_rows(calset):
    names = [kind.name for kind in EFFECTS if not kind.is_structural()]
    instrument = with_effects(base_model(calset), names, calset).template
    changes = dict(zip((e.name for e in instrument.effects), optics._changes_rows(instrument), strict=True))
    assert {name for name, changed in changes.items() if not changed} == AHEAD_OR_BEHIND


def test_rows_are_those_of_the_whole_instrument(calset):
    """One effect ahead, one on the rows, one behind, none of them neutral."""
    likelihood = likelihood_with(calset, "lens_birefringence", "hwp1_axis", "ghost", "blemish")
    values = likelihood.model.start.copy()
    for name, value in {
        "lens_birefringence.delta": 0.02, "hwp1_axis.angle": 0.5, "ghost.share": 0.01, "blemish.depth": 0.05,
    }.items():  # fmt: skip
        values[likelihood.model.index(name)] = value
    instrument, plan = likelihood.model.instrument(values), likelihood.plan
    assert [effect.name for effect in optics._of_optics(instrument, plan)[0].effects] == ["hwp1_axis"]
    x, y = jnp.array([0.1, -0.2]), jnp.array([-0.15, 0.05])
    whole = jax.jit(jax.vmap(light.band_rows, (None, None, 0, 0)))(instrument, plan, x, y)
    found = optics.known_optics(instrument, plan, x, y)
    np.testing.assert_allclose(found.rows, whole, rtol=0, atol=1e-13)
    batch = next(iter(likelihood.points))
    for one, two in zip(
        engine.linearised_residuals(instrument, plan, batch),
        engine._linearised_residuals(instrument, plan, batch, None),
        strict=True,
    ):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-10 * np.abs(two).max())

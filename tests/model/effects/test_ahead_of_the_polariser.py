"""Changes of light from the sky: those that vary from exposure to exposure beside those that stars have as well."""

import dataclasses

import numpy as np
import pytest
from small_run import SMALL

from walop_jax.calibration.matrix import first_setting, planned_matrices
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Change, Described
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.instrument import Instrument
from walop_jax.model.planning import plan_for_settings
from walop_jax.simulation.simulate import simulate

SIZE = 1e-3
CALSET = simulate(SMALL, seed=3).calset


def of_stars(*texts: str) -> np.ndarray:
    """The matrix of a star where an instrument has some changes."""
    plain: Instrument = base_model(CALSET).template
    effects = (Described.saying(list(texts), [SIZE] * len(texts)),) if texts else ()
    instrument = dataclasses.replace(plain, effects=effects)
    plan = plan_for_settings(instrument, first_setting(CALSET, plain), CALSET.filters)
    return np.asarray(planned_matrices(instrument, plan, np.array([0.1, -0.2]), np.array([0.05, 0.2])))


def residuals(*texts: str) -> np.ndarray:
    """Residuals of the small set for a model with some changes."""
    model = base_model(CALSET)
    if texts:
        model = with_effects(model, [Described.saying(list(texts), [SIZE] * len(texts))], CALSET)
    values = model.start.copy()
    for text in texts:
        values[model.index(f"{Described.name}.{Change.parsed(text).label}")] = SIZE
    return Likelihood.of(CALSET, model).residuals(values)[1]


@pytest.mark.parametrize(
    ("steady", "varying"),
    [
        ("diattenuation q ahead of polariser", "diattenuation q ahead of polariser * kind standard"),
        ("diattenuation u ahead of polariser * x", "diattenuation q ahead of polariser * kind moon"),
        (
            "added polarisation q ahead of polariser",
            "added polarisation q ahead of polariser * kind moon",
        ),
        (
            "added polarisation q ahead of polariser * x",
            "added polarisation q ahead of polariser * kind moon",
        ),
    ],
)
def test_a_steady_change_acts_on_stars_beside_one_that_varies(steady: str, varying: str):
    """A star has the steady change alone; in exposures both act, to first order as their sum."""
    alone = of_stars(steady)
    np.testing.assert_allclose(of_stars(steady, varying), alone, atol=1e-14)
    assert np.abs(alone - of_stars()).max() > 1e-5
    bare = residuals()
    first, second, both = (residuals(*texts) - bare for texts in ((steady,), (varying,), (steady, varying)))
    np.testing.assert_allclose(both, first + second, atol=5e-3 * np.abs(both).max())


def test_polarisation_that_is_added_over_the_field_is_added_to_stars():
    """Against one that is even: at X it has the size of X over the unit of the field."""
    even = of_stars("added polarisation q ahead of polariser") - of_stars()
    tilted = of_stars("added polarisation q ahead of polariser * x") - of_stars()
    share = np.array([0.1, -0.2]) / base_model(CALSET).template.units.field
    np.testing.assert_allclose(tilted, even * share[:, None, None], rtol=5e-3, atol=1e-8)

"""Deviations from the shape of a description: their polynomials, their widths, and their effect on the product."""

import dataclasses
import json

import numpy as np
import pytest
from small_run import SMALL

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import first_setting, planned_matrices
from walop_jax.diagnosis.class_members import classes_of
from walop_jax.diagnosis.class_product import averaged, only_a_class
from walop_jax.diagnosis.description_shape import shape_changes
from walop_jax.diagnosis.examination import examine
from walop_jax.fit.base_model import base_model, model_like
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described
from walop_jax.model.effects.change import AtPoint, product
from walop_jax.model.effects.deviations import CUBIC
from walop_jax.model.effects.optics import GENERATORS
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.specification import effect_context, with_effects
from walop_jax.posterior.run import Run
from walop_jax.simulation.simulate import simulate

TEXT, SIZE = "retardance v behind collimator * x", 4e-3


@pytest.fixture(scope="module")
def described():
    """A fit with one description, and what it leaves open."""
    calset = simulate(SMALL, seed=3, effects=[Described.saying([TEXT], [SIZE])]).calset
    context = effect_context(base_model(calset).template, calset.exposures)
    model = with_effects(base_model(calset), [Described.saying([TEXT], [0.0])], context)
    state = examine(fit(Likelihood.of(calset, model)), (), np.random.default_rng(0))
    return state, context, classes_of(state, context, {Described.name}, [TEXT])


def test_patterns_are_all_polynomials_to_the_third_degree():
    """(n+1)(n+2)/2 = 10 terms x^i y^j with i + j ≤ 3, of which every pattern is a sum."""
    x, y = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 40))
    at = AtPoint(x, y)
    units = base_model(simulate(SMALL, seed=1).calset).template.units
    values = np.stack([product(names, at, units) * np.ones(40) for names in CUBIC], axis=1)
    monomials = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    assert np.linalg.matrix_rank(values / np.abs(values).max(axis=0)) == 10
    remainder = values - monomials @ np.linalg.lstsq(monomials, values, rcond=None)[0]
    assert np.abs(remainder).max() < 1e-12


def test_every_kind_may_be_as_large_as_the_description(described):
    """The sum over patterns of width² times the mean square of the factor is (SIZE x)² of the description."""
    state, _, _ = described
    changes, widths, sizes = shape_changes(state.result, state.design.columns)
    points, units = state.result.calset.points, state.result.model.template.units
    amplitude = state.result.values[state.result.model.index(f"described.{TEXT.replace(' ', '_')}")]
    square = amplitude**2 * np.average(
        (points.x / units.field) ** 2, weights=state.result.likelihood.used.sum(axis=1)
    )
    for kind in GENERATORS:
        chosen = np.array([change.kind == kind for change in changes])
        assert chosen.sum() == 10 - (kind == "retardance v")  # the description itself is in the model
        total = np.sum((widths * sizes)[chosen] ** 2) * 10 / chosen.sum()
        assert total == pytest.approx(square, rel=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "diattenuation q behind collimator * x * r2",  # changes the gains of the cameras
        "diattenuation v behind collimator * y",
        "retardance u behind collimator * x2-y2",
        "depolarisation q behind collimator",
    ],
)
def test_a_deviation_changes_the_product_as_the_optics_do(described, text):
    """Error of the matrix beside the change of the matrix by a description of the same words."""
    state, context, classes = described
    result, shape, size = state.result, classes.shape, 1e-5
    j = [total[0][1].text for total in shape.deviations.sums].index(text)
    count = len(shape.deviations.sums)
    covariance = np.zeros((count, count))
    covariance[j, j] = size**2
    held = np.zeros_like(shape.deviations.slopes)
    deviations = shape.deviations._replace(
        covariance=covariance, slopes=held, values=held[:, 0], amplitudes=np.zeros(count)
    )
    alone = Calibration.from_fit(result.judged())
    alone = dataclasses.replace(alone, covariance=np.zeros_like(alone.covariance), hidden=None)
    x, y = np.random.default_rng(2).uniform(-0.2, 0.2, (2, 20))
    product = averaged(alone, classes._replace(shape=shape._replace(deviations=deviations)), context)
    errors = np.sqrt(np.diagonal(product.matrix(x, y)[1], axis1=1, axis2=2))
    instrument = result.model.instrument(result.values)
    plan = plan_for_settings(instrument, first_setting(result.calset, instrument), result.calset.filters)
    effect = instrument.effect(Described.name).joined(Described.saying([text], [size]))
    changed = dataclasses.replace(instrument, effects=(effect,))
    expected = np.abs(planned_matrices(changed, plan, x, y) - planned_matrices(instrument, plan, x, y))
    np.testing.assert_allclose(errors, expected.reshape(errors.shape), rtol=0.01, atol=3e-3 * expected.max())


def test_a_deviation_larger_than_the_errors_is_not_trusted(described):
    _, _, classes = described
    shape = classes.shape
    assert shape.spread > 0
    assert not list(only_a_class(classes._replace(shape=shape._replace(spread=0.9 * shape.stated))))
    (sentence,) = only_a_class(classes._replace(shape=shape._replace(spread=3 * max(shape.stated, 1e-3))))
    assert "described, not named" in sentence


def test_a_new_night_is_fitted_without_the_deviations(described):
    """Hundreds of parameters that act on the optics of every wavelength would take gigabytes, and mean nothing."""
    state, context, classes = described
    product = averaged(Calibration.from_fit(state.result.judged()), classes, context)
    assert "deviations" in product.model.effect_names
    held = [p for p in product.model.parameters if p.part == "deviations"]
    assert not any(p.free for p in held)
    night = simulate(SMALL, seed=5).calset
    model = model_like(night, product.model)
    assert "deviations" not in model.effect_names
    assert f"described.{TEXT.replace(' ', '_')}" in model.names


def test_a_mean_over_shapes_is_not_made_anew_as_one_fit(tmp_path):
    entry = {"deviations": 90, "spread_of_p": 1e-4, "stated_error_of_p": 1e-4}
    (tmp_path / "diagnosis.json").write_text(json.dumps({"members": [], "shape": entry}))
    with pytest.raises(DataError, match=r"refit --model .*model\.toml"):
        Run(tmp_path).fit()


def test_deviations_of_the_polariser_do_nothing_to_a_star():
    """A star is seen without the polariser: of what its film may have, only the parameters of the fit know."""
    text = "retardance q of polariser * r2"
    calset = simulate(SMALL, seed=3, effects=[Described.saying([text], [4e-3])]).calset
    context = effect_context(base_model(calset).template, calset.exposures)
    model = with_effects(base_model(calset), [Described.saying([text], [0.0])], context)
    state = examine(fit(Likelihood.of(calset, model)), (), np.random.default_rng(0))
    classes = classes_of(state, context, {Described.name}, [text])
    assert classes.shape.in_optics == ()
    product = averaged(Calibration.from_fit(state.result.judged()), classes._replace(additions=()), context)
    assert "deviations" not in product.model.effect_names

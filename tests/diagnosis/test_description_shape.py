"""Deviations from the shape of a description: their polynomials, their widths, and their effect on the product."""

import dataclasses
import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from fits_with import examined_with, fit_with, set_with
from small_run import SMALL

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import first_setting, planned_matrices
from walop_jax.diagnosis.class_product import averaged, only_a_class
from walop_jax.diagnosis.discrepancy import ambiguities, shape_changes
from walop_jax.fit.base_model import base_model
from walop_jax.fit.model_of_set import model_like
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.model.effects import Context, Described, Deviations
from walop_jax.model.effects.change import AtPoint, product
from walop_jax.model.effects.deviations import CUBIC
from walop_jax.model.effects.optics import GENERATORS
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.ray import Conditions, Ray
from walop_jax.posterior.run import Run
from walop_jax.science import epoch
from walop_jax.simulation.simulate import simulate

TEXT, SIZE = "retardance v behind collimator * x", 4e-3


@pytest.fixture(scope="module")
def described():
    """A fit with one description, and what it leaves open."""
    state = examined_with(fit_with(set_with(3, {TEXT: SIZE}), TEXT))
    return state, ambiguities(state, {TEXT: ()})._replace(undetected=None)


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
    state, _ = described
    changes, widths, _ = shape_changes(state.result, state.design.columns)
    points, units = state.result.calset.points, state.result.model.template.units
    amplitude = state.result.values[state.result.model.index(f"described.{TEXT.replace(' ', '_')}")]
    square = amplitude**2 * np.average(
        (points.x / units.field) ** 2, weights=state.result.likelihood.used.sum(axis=1)
    )
    used = state.result.likelihood.used
    at = AtPoint(points.x[:, None], points.y[:, None])
    for kind in GENERATORS:
        chosen = [j for j, change in enumerate(changes) if change.kind == kind]
        assert len(chosen) == 10 - (kind == "retardance v")  # the description itself is in the model
        factors = [product(changes[j].factors, at, units) * np.ones(used.shape) for j in chosen]
        total = sum(widths[j] ** 2 * np.mean(f[used] ** 2) for j, f in zip(chosen, factors, strict=True))
        assert total * 10 / len(chosen) == pytest.approx(square, rel=1e-9)


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
    state, classes = described
    result, shape, size = state.result, classes.shape, 1e-5
    (member,) = shape.members
    j = [change.text for change in member.changes].index(text)
    count = len(member.changes)
    covariance = np.zeros((count, count))
    covariance[j, j] = size**2
    member = member._replace(covariance=covariance, slopes=np.zeros_like(member.slopes))
    shape = shape._replace(members=(member,))
    alone = Calibration.from_fit(result.with_verdict())
    alone = dataclasses.replace(alone, covariance=np.zeros_like(alone.covariance), hidden=None)
    x, y = np.random.default_rng(2).uniform(-0.2, 0.2, (2, 20))
    product = averaged(alone, classes._replace(shape=shape))
    matrix, covariance = product.matrix(x, y)
    errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    instrument = result.model.instrument(result.values)
    plan = plan_for_settings(instrument, first_setting(result.calset, instrument), result.calset.filters)
    effect = instrument.effect(Described.name).joined(Described.saying([text], [size]))
    changed = dataclasses.replace(instrument, effects=(effect,))
    before, after = (planned_matrices(i, plan, x, y).reshape(matrix.shape) for i in (instrument, changed))
    np.testing.assert_allclose(matrix, before, rtol=1e-12, atol=1e-15)
    expected = np.abs(after - before)
    np.testing.assert_allclose(errors, expected, rtol=0.01, atol=3e-3 * expected.max())


def test_a_deviation_larger_than_the_errors_is_not_trusted(described):
    _, classes = described
    shape = classes.shape
    assert shape.spread > 0
    assert not list(only_a_class(classes._replace(shape=shape._replace(spread=0.9 * shape.stated))))
    (sentence,) = only_a_class(classes._replace(shape=shape._replace(spread=3 * max(shape.stated, 1e-3))))
    assert "described, not named" in sentence


def test_a_new_night_is_fitted_without_the_deviations(described):
    """Hundreds of parameters that act on the optics of every wavelength would take gigabytes, and mean nothing."""
    state, classes = described
    product = averaged(Calibration.from_fit(state.result.with_verdict()), classes)
    assert "deviations" in product.model.effect_names
    held = [p for p in product.model.parameters if p.part == "deviations"]
    assert not any(p.free for p in held)
    night = simulate(SMALL, seed=5).calset
    model = model_like(night, product.model)
    assert "deviations" not in model.effect_names
    assert f"described.{TEXT.replace(' ', '_')}" in model.names


def test_a_hidden_deviation_is_in_the_errors():
    """Beside the fit of a model that has both: its size by the linear step from the description alone, √E[c²]."""
    other = "retardance v behind collimator * y"
    calset = set_with(3, {TEXT: SIZE, other: -1.5e-3})
    one, both = fit_with(calset, TEXT), fit_with(calset, TEXT, other)
    (member,) = ambiguities(examined_with(one), {TEXT: ()}).shape.members
    j = [change.text for change in member.changes].index(other)
    exact = both.values[both.model.index(f"described.{other.replace(' ', '_')}")]
    assert exact == pytest.approx(-1.5e-3, rel=0.3)
    assert np.sqrt(member.covariance[j, j]) == pytest.approx(abs(exact), rel=0.25)


def test_a_deviation_with_a_dependence_is_that_of_a_description():
    """Retardance 1 mrad × y/0.3° a kelvin at Y = −0.15°, 20 °C, 10 K from the reference: −5 mrad."""
    template = base_model(simulate(SMALL, seed=1).calset).template
    sizes = np.zeros((1, len(GENERATORS), len(CUBIC)))
    sizes[0, GENERATORS.index("retardance u"), CUBIC.index(("y",))] = 1e-3
    effects = (
        Deviations.of(Context(), places=["behind collimator * kelvin"], sizes=sizes),
        Described.saying(["retardance u behind collimator * y * kelvin"], [1e-3]),
    )
    one = jnp.ones(1)
    ray = Ray.entering(
        0.1 * one[0], -0.15 * one[0], (0.65 * one, Conditions(0.1 * one, {"temperature": 20.0 * one}))
    )
    elements = [
        next(e for e in effect.patch(template).elements if e.name == effect.name) for effect in effects
    ]
    ours, theirs = (np.asarray(element.mueller(ray)).reshape(4, 4) for element in elements)
    np.testing.assert_allclose(ours, theirs, atol=1e-15)
    assert abs(ours[1, 3]) == pytest.approx(np.sin(5e-3), rel=1e-12)


def test_another_deviation_is_that_of_a_description():
    template = base_model(simulate(SMALL, seed=1).calset).template
    text = "gain of O1 * kelvin * x"
    ours = Deviations.of(Context(), sentences=[text], amounts=[2e-3]).patch(template)
    theirs = Described.saying([text], [2e-3]).patch(template)
    assert eqx.tree_equal(ours.cameras, theirs.cameras)


def test_deviations_refuse_what_they_do_not_have():
    with pytest.raises(ValueError, match="size"):
        Deviations.of(Context(), size=1.0)
    instrument = base_model(simulate(SMALL, seed=1).calset).template
    with pytest.raises(ValueError, match="does not pass the polariser"):
        Deviations.of(Context(), places=[f"of {instrument.polariser.name}"]).patch(instrument)


def test_a_new_night_is_fitted_from_the_old_values(described, monkeypatch):
    """Members of a class are much alike: from zero a fit can end in another minimum, with χ²/dof 1.2 for 0.98."""
    state, _ = described
    old = Calibration.from_fit(state.result.with_verdict())
    night, starts = simulate(SMALL, seed=5).calset, []
    monkeypatch.setattr(
        epoch, "fit", lambda likelihood, start: starts.append(start) or fit(likelihood, start=start)
    )
    result = epoch.fit_like(old, night)
    for name in epoch.shared_parameters(old.model, result.model):
        assert starts[0][result.model.index(name)] == old.values[old.model.index(name)]
    assert f"described.{TEXT.replace(' ', '_')}" in epoch.shared_parameters(old.model, result.model)
    moon = [result.model.index(name) for name in result.model.names if name.startswith("moon")]
    np.testing.assert_array_equal(starts[0][moon], result.model.start[moon])


def test_a_mean_over_shapes_is_not_made_anew_as_one_fit(tmp_path):
    entry = {"deviations": 90, "spread_of_p": 1e-4, "stated_error_of_p": 1e-4}
    (tmp_path / "diagnosis.json").write_text(json.dumps({"members": [], "shape": entry}))
    with pytest.raises(DataError, match=r"refit --model .*model\.toml"):
        Run(tmp_path).fit()


def test_deviations_of_the_polariser_do_nothing_to_a_star():
    """A star is seen without the polariser: of what its film may have, only the parameters of the fit know."""
    text = "retardance q of polariser * r2"
    state = examined_with(fit_with(set_with(3, {text: 4e-3}), text))
    classes = ambiguities(state, {text: ()})
    assert classes.shape.members[0].acting == ()
    alone = classes._replace(additions=(), undetected=None)
    product = averaged(Calibration.from_fit(state.result.with_verdict()), alone)
    assert "deviations" not in product.model.effect_names


def test_deviations_of_sky_light_may_depend_on_the_temperature():
    """No element ahead of the polariser may: they are changes of the light, at 0 K from the reference none."""
    text = "diattenuation q ahead of polariser * kelvin"
    calset = simulate(SMALL, seed=3).calset
    kelvin = 10.0 + np.linspace(-2.0, 2.0, len(calset.exposures))
    calset = dataclasses.replace(calset, exposures=dataclasses.replace(calset.exposures, temp=kelvin))
    state = examined_with(fit_with(calset, text))
    classes = ambiguities(state, {text: ()})
    laws = {change.beside_field for change in classes.shape.members[0].changes}
    assert ("kelvin",) in laws
    product = averaged(Calibration.from_fit(state.result.with_verdict()), classes)
    (matrix, covariance), alone = product.matrix(0.1, 0.1), Calibration.from_fit(state.result.with_verdict())
    assert np.all(np.isfinite(matrix))
    assert np.all(np.diag(covariance) >= np.diag(alone.matrix(0.1, 0.1)[1]))

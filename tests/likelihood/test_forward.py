"""The forward model as functions of JAX: against finite differences, the oracle, identities and the fit."""

from __future__ import annotations

import dataclasses
from typing import Any

import builders
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from oracle import forward as oracle
from quick import quick
from small_run import SEED, SMALL, small_fit

from walop_jax.data.settings import Settings
from walop_jax.fit.base_model import base_model
from walop_jax.fit.forward import forward
from walop_jax.likelihood import optics
from walop_jax.likelihood.forward import Forward
from walop_jax.model import light, materials
from walop_jax.model.effects import Described, effect_by_name
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.parameters import values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for_settings
from walop_jax.simulation.simulate import simulate

STEP = 1e-4  # of the scales of the parameters


@pytest.fixture(scope="module")
def scene() -> Forward:
    return forward(small_fit().calset)


@pytest.fixture(scope="module")
def direction(scene: Forward) -> np.ndarray:
    """A change of all parameters by about their scales."""
    scale = np.array([p.scale for p in base_model(small_fit().calset).parameters])
    return scale * np.random.default_rng(1).standard_normal(len(scale))


def difference(function: Any, at: Any, direction: Any) -> Any:
    """Central difference along a direction."""
    up, down = function(at + STEP * direction), function(at - STEP * direction)
    return (up - down) / (2.0 * STEP)


def test_residuals_have_zero_flux_gradient(scene: Forward):
    """Normal equations of the flux: Σ over the cameras of residual × model / error vanishes for every row."""
    counts, measured = scene.counts(scene.start), small_fit().calset.intensities.block(0, scene.shape[0])
    residual = np.where(measured.used[..., None], (measured.counts - counts) / measured.sigma, 0.0)
    np.testing.assert_allclose(scene.residuals(scene.start), residual[measured.used].ravel(), atol=1e-8)
    along = np.where(measured.used[..., None], counts / measured.sigma, 0.0)
    assert np.abs((residual * along).sum(axis=2)).max() < 1e-9 * (np.abs(residual * along)).sum(axis=2).max()


def test_derivatives_are_finite_differences(scene: Forward, direction: np.ndarray):
    """First derivatives in both modes, and the second along a direction."""
    jacobian = jax.jit(jax.jacfwd(scene.residuals))(scene.start)
    expected = difference(jax.jit(scene.residuals), scene.start, direction)
    np.testing.assert_allclose(jacobian @ direction, expected, atol=1e-7 * np.abs(expected).max())
    value, gradient = jax.jit(jax.value_and_grad(scene.log_density))(scene.start)
    whole = scene.log_likelihood(scene.start) + scene.log_prior(scene.start)
    assert float(value) == pytest.approx(float(whole), rel=1e-14)
    slope = difference(jax.jit(scene.log_density), scene.start, direction)
    assert float(gradient @ direction) == pytest.approx(float(slope), rel=1e-6)


def test_second_derivatives_are_finite_differences_of_the_first(scene: Forward, direction: np.ndarray):
    gradient = jax.jit(jax.grad(scene.log_density))
    along = jax.jit(lambda v, d: jax.jvp(gradient, (v,), (d,))[1])(scene.start, direction)
    expected = difference(gradient, scene.start, direction)
    np.testing.assert_allclose(along, expected, atol=1e-6 * np.abs(expected).max())


def test_a_fit_minimises_the_density(scene: Forward):
    """At the minimum the gradient is none, in standard errors; half a standard error away the density is lower."""
    result = small_fit()
    at, sigma = jnp.asarray(result.values), np.sqrt(np.diag(result.covariance))
    gradient = jax.jit(jax.grad(scene.log_density))(at)
    assert np.abs(np.asarray(gradient) * sigma)[result.model.free].max() < 1e-2
    density, rng = jax.jit(scene.log_density), np.random.default_rng(2)
    root = np.linalg.cholesky(result.covariance[np.ix_(result.model.free, result.model.free)] + 0.0)
    for _ in range(3):
        step = rng.standard_normal(len(root))
        step *= 0.5 / np.linalg.norm(step)
        away = at.at[result.model.free].add(root @ step)
        # Half of the squared distance in standard errors, up to what is not linear.
        assert float(density(at) - density(away)) == pytest.approx(0.125, rel=0.05)


def test_another_solver_ends_where_a_fit_ends(scene: Forward):
    """Levenberg-Marquardt of optimistix on residuals and prior rows, from the start, to 1e-3 standard errors."""
    result = small_fit()
    scale = jnp.array([p.scale for p in result.model.parameters])[scene.free]
    index, mean, width = scene.prior

    def rows(steps: Any, scene: Any) -> Any:
        values = scene.full(scene.start[scene.free] + scale * steps)
        return jnp.concatenate([scene.residuals(values), (values[index] - mean) / width])

    solver = optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    solution = optimistix.least_squares(rows, solver, jnp.zeros(scale.size), args=scene, max_steps=64)
    values = scene.full(scene.start[scene.free] + scale * solution.value)
    free = result.model.free
    away = (np.asarray(values) - result.values)[free] / np.sqrt(np.diag(result.covariance))[free]
    assert np.abs(away).max() < 1e-3
    started = (np.asarray(scene.start) - result.values)[free] / np.sqrt(np.diag(result.covariance))[free]
    assert np.abs(started).max() > 1.0  # it had some way to go


def test_gradients_of_the_instrument_come_back_as_one(scene: Forward):
    """For parameters those of the vector; for every other number finite differences."""
    instrument = scene.instrument(scene.start)
    gradient = jax.jit(jax.grad(scene.log_likelihood))(instrument)
    assert isinstance(gradient, Instrument)
    expected = jax.jit(jax.grad(scene.log_likelihood))(scene.start)
    np.testing.assert_allclose(values_of(gradient), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    place = "half1.plate"  # its fast axis is no parameter
    slope = difference(
        lambda angle: scene.log_likelihood(instrument.changed(place, axis=angle)),
        instrument.element(place).axis,
        1.0,
    )
    assert float(gradient.element(place).axis) == pytest.approx(float(slope), rel=1e-5)


def test_numbers_in_float32_are_refused(scene: Forward):
    """Their digits are lost already, and a gradient would have no more: an error that says what to write."""
    single = scene.start.astype(jnp.float32)
    trees = (jax.tree.map(lambda leaf: leaf.astype(jnp.float32), scene.instrument(scene.start)),)
    for values in (single, np.asarray(single), *trees):
        for function in (
            scene.log_likelihood,
            jax.grad(scene.chi2, allow_int=True),
            jax.jit(scene.residuals),
        ):
            with pytest.raises(TypeError, match=r"float32.*give jnp\.asarray\(values, jnp\.float64\)"):
                function(values)
    for function in (scene.log_prior, scene.instrument, lambda v: scene.full(v[scene.free])):
        with pytest.raises(TypeError, match="was given numbers in float32"):
            function(single)
    with pytest.raises(TypeError, match="was given numbers in float32"):
        scene.values({scene.names[0]: single[0]})
    rounded = dataclasses.replace(scene, data=jax.tree.map(lambda leaf: leaf.astype(jnp.float32), scene.data))
    with pytest.raises(TypeError, match="was given numbers in float32"):
        rounded.log_density(scene.start)
    with pytest.raises(TypeError, match="was given numbers in bfloat16"):
        scene.log_density(scene.start.astype(jnp.bfloat16))
    assert scene.log_prior(np.asarray(scene.start)) == scene.log_prior(list(map(float, scene.start)))


@pytest.mark.parametrize("form", ["value", "gradient", "several"])
def test_a_plain_call_is_compiled_once(scene: Forward, form: str):
    """Without `jax.jit` the first call compiles, and later ones do not trace anything of the instrument."""
    forms = {"value": scene.log_density, "gradient": jax.grad(scene.log_density)}
    function = forms.get(form, jax.vmap(scene.log_density))
    values = scene.start if form != "several" else jnp.stack([scene.start, scene.start + 1e-6])
    first = function(values)
    with pytest.MonkeyPatch.context() as patch:

        def traced(*_: Any) -> Any:
            raise AssertionError("the instrument is traced again")

        patch.setattr(Forward, "_unit", traced)
        again = function(values + 0.0)
    np.testing.assert_array_equal(again, first)


def test_ties_hold_whatever_stands_in_their_place():
    calset = small_fit().calset
    model = base_model(calset).change("half2.plate.mgf2", tie="half1.plate.mgf2")
    tied = forward(calset, model)
    master, follower = (model.index(f"half{n}.plate.mgf2") for n in (1, 2))
    moved = tied.start.at[follower].add(1.0)
    assert tied.log_density(moved) == tied.log_density(tied.start)
    gradient = jax.grad(tied.log_likelihood)(tied.start)
    untied = jax.grad(forward(calset).log_likelihood)(tied.start)
    assert gradient[follower] == 0.0
    assert float(gradient[master]) == pytest.approx(float(untied[master] + untied[follower]), rel=1e-9)
    assert len(tied.free) == len(tied.names) - 2  # the overall throughput is held as well
    assert tied.full(tied.start[tied.free])[follower] == tied.start[master]


def test_values_by_name(scene: Forward):
    values = scene.values({"pupil.magnification": 15.6})
    assert scene.named(values)["pupil.magnification"] == 15.6
    with pytest.raises(ValueError, match=r"did you mean 'pupil\.magnification'"):
        scene.values({"pupil.magnificaton": 15.6})


def test_many_instruments_at_once(scene: Forward, direction: np.ndarray):
    several = scene.start + 0.1 * jnp.arange(3)[:, None] * direction
    densities = jax.jit(jax.vmap(scene.log_density))(several)
    np.testing.assert_allclose(densities, [scene.log_density(v) for v in several], rtol=1e-12)


def test_it_is_an_argument_of_programs(scene: Forward):
    """A tree: it may be passed to a compiled function instead of being built into it."""
    density = jax.jit(lambda f, v: f.log_density(v))
    assert float(density(scene, scene.start)) == pytest.approx(
        float(scene.log_density(scene.start)), rel=1e-13
    )


def test_a_flux_that_is_given(scene: Forward):
    """Counts are proportional to it."""
    flux = np.full(scene.shape[:2], 1e5)
    counts = scene.counts(scene.start, flux)
    np.testing.assert_allclose(scene.counts(scene.start, 3.0 * flux), 3.0 * counts, rtol=1e-12)
    assert counts.shape == scene.shape
    best = scene.flux(scene.start)  # with an axis of groups of cameras
    np.testing.assert_allclose(scene.counts(scene.start, best), scene.counts(scene.start), rtol=1e-13)


def test_memory_of_a_gradient_is_flat_in_the_points():
    """Working memory of a gradient: of two hundred points no more than a tenth above that of forty."""
    sizes = []
    for grid in (7, 15):
        scene = forward(dataclasses.replace(SMALL, grid=grid))
        compiled = (
            jax.jit(jax.grad(lambda f, v: f.log_density(v), argnums=1)).lower(scene, scene.start).compile()
        )
        sizes.append(compiled.memory_analysis().temp_size_in_bytes)
    assert scene.shape[0] > 150
    assert sizes[1] < 1.1 * sizes[0]


@pytest.mark.parametrize("name", ["ghost", "nonlinearity", "pedestal", "flexure", "filter_shift"])
def test_effects_are_differentiated(name: str):
    """Ghosts, detectors, a displacement and a shift of the band, away from their neutral values."""
    simulated = simulate(SMALL, seed=SEED)
    calset = simulated.calset
    context = effect_context(simulated.truth, calset.exposures)
    model = with_effects(base_model(calset), [effect_by_name(name)], context)
    scene = forward(calset, model)
    scale = np.array([p.scale for p in model.parameters])
    here = scene.start + 0.1 * scale
    direction = scale * np.random.default_rng(3).standard_normal(len(scale))
    jacobian = jax.jit(jax.jacfwd(scene.residuals))(here)
    expected = difference(jax.jit(scene.residuals), here, direction)
    np.testing.assert_allclose(jacobian @ direction, expected, atol=1e-6 * np.abs(expected).max())


# ------------------------------------------------------------------------------------------------- the rule


@pytest.fixture(scope="module")
def plan() -> Plan:
    """Two settings of the calibration plate in one wavelength."""
    settings = Settings.default(2, "band").at(CHWP=np.array([np.nan, 22.5]))
    return plan_for_settings(nominal_instrument(), settings, {"band": builders.monochromatic(0.62)})


def test_the_rule_is_plain_differentiation(plan: Plan):
    """Rows and their derivatives in the parameters, in a field coordinate and in the wavelength, in both modes."""
    instrument = nominal_instrument()
    values, x, y = values_of(instrument), jnp.asarray(0.2), jnp.asarray(-0.1)

    def ruled(values: Any, x: Any, plan: Plan) -> Any:
        return optics.band_rows(values, instrument, plan, x, y)

    def plain(values: Any, x: Any, plan: Plan) -> Any:
        return light.band_rows(with_values(instrument)(values), plan, x, y)

    for mode in (jax.jacfwd, jax.jacrev):
        expected = jax.jit(mode(plain, (0, 1)))(values, x, plan)
        result = jax.jit(mode(ruled, (0, 1)))(values, x, plan)
        for a, b in zip(result, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-11 * np.abs(b).max())


def test_directions_are_fewer_than_parameters(plan: Plan):
    """Plates and wedges of the two halves share theirs; no parameter of a row shares it with another of that row."""
    instrument = nominal_instrument()
    along = optics.directions(instrument, plan)
    assert (len(along.index), along.count) == (10, 7)
    for k in range(along.count):
        assert along.reached[along.colour == k].sum(axis=0).max() == 1
    without = plan_for_settings(
        instrument, Settings.default(1, "band"), {"band": builders.monochromatic(0.62)}
    )
    assert optics.directions(instrument, without).count == 5  # no calibration plate in the beam


SMOOTH = [
    f"retardance {axis} behind half1.plate * field {i} {j}"
    for axis in "qu"
    for i in range(3)
    for j in range(2)
]
OVER_FIELD = [
    ([*SMOOTH, "gain of O1 * field 1 2", "diattenuation q behind collimator * x"], 3),
    (["thickness of half2.plate.quartz", "thickness of half2.plate.quartz * r2", *SMOOTH[:2]], 2),
    (["displacement x ahead of pupil", *SMOOTH], 1 + len(SMOOTH)),
]


@pytest.mark.parametrize("case", quick(OVER_FIELD, OVER_FIELD[:1]))
def test_terms_of_one_change_over_the_field_share_a_direction(plan: Plan, case: tuple[list[str], int]):
    """The derivatives are those of JAX, also where patterns vanish; a displaced field has other patterns behind it."""
    (texts, further), bare = case, nominal_instrument()
    described = Described.saying(texts, np.linspace(1e-3, 3e-3, len(texts)))
    device = dataclasses.replace(bare, effects=(described,))
    along = optics.directions(device, plan)
    assert along.count <= optics.directions(bare, plan).count + further

    def rows(values: Any, x: Any, y: Any) -> Any:
        return light.band_rows(with_values(device)(values), plan, x, y)

    def by_rule(values: Any, x: Any, y: Any) -> Any:
        return optics.band_rows(values, device, plan, x, y)

    plain, ruled = (jax.jit(jax.jacfwd(function)) for function in (rows, by_rule))
    of_points = jax.jit(lambda x, y: optics.rows_and_slopes(device, plan, x, y))
    for x, y in ((0.2, -0.1), (0.0, 0.0), (0.0, 0.25)):
        at = jnp.asarray(x), jnp.asarray(y)
        expected, result = (function(values_of(device), *at) for function in (plain, ruled))
        atol = 1e-11 * np.abs(expected).max()
        np.testing.assert_allclose(result, expected, atol=atol)
        slopes = np.moveaxis(of_points(*at)[1], 0, -1)
        np.testing.assert_allclose(slopes, expected[..., along.index], atol=atol)


# ---------------------------------------------------------------------------------------- parts of the instrument


def test_mueller_matrix_of_a_camera_is_that_of_the_oracle():
    """Rows that the analysers see, of light behind the polariser, as built from other equations."""
    truth = builders.as_built(nominal_instrument(), np.random.default_rng(5))
    x, y, wavelength = 0.21, -0.13, np.array([0.58, 0.66])
    own = truth.mueller(jnp.asarray(x), jnp.asarray(y), jnp.asarray(wavelength))
    assert own.shape == (4, 2, 4, 4)
    params, signs = (
        builders.oracle_params(truth),
        np.array([1, 1, 1, -1]),
    )  # the oracle counts V the other way
    rows = oracle.optics_rows(params, x, y, wavelength)[0] @ oracle.collimator(params, x, y)[0]
    expected = np.stack([rows[:, half] for half in (0, 0, 1, 1)]) * signs  # O1, E1, O2, E2
    np.testing.assert_allclose(own[:, :, :2], expected, atol=1e-9)
    turned = truth.mueller(jnp.asarray(x), jnp.asarray(y), jnp.asarray(0.62), {"CHWP": 30.0})
    rows = oracle.optics_rows(params, x, y, 0.62, 30.0)[0, 0] @ oracle.collimator(params, x, y)[0]
    np.testing.assert_allclose(turned[2, :2], rows[1] * signs, atol=1e-9)
    with pytest.raises(ValueError, match="did you mean 'CHWP'"):
        truth.mueller(jnp.asarray(x), jnp.asarray(y), jnp.asarray(0.62), {"CHPW": 30.0})


def test_retardance_at_normal_incidence_is_the_closed_form():
    """δ = 2π (d₁ Δn₁ − d₂ Δn₂) / λ of crossed plates, however many waves; its slope in the thickness."""
    plate = nominal_instrument().element("half1.plate")
    thickness = {layer.name: float(layer.thickness) for layer in plate.layers}
    wavelength = np.array([0.55, 0.62, 0.7])
    quartz, mgf2 = (
        c.extraordinary.refractive_index(wavelength) - c.ordinary.refractive_index(wavelength)
        for c in (materials.CRYSTALS["quartz"], materials.CRYSTALS["mgf2"])
    )
    expected = 360.0 * (thickness["mgf2"] * mgf2 - thickness["quartz"] * quartz) / wavelength
    np.testing.assert_allclose(plate.retardance(0.0, 0.0, wavelength), expected, atol=1e-5)


def test_retardance_is_smooth_through_half_a_wave():
    """Of the incidence its slope is a finite difference, at odd multiples of 180° as well."""
    plate = nominal_instrument().element("half1.plate")

    def at(incidence: Any) -> Any:
        return plate.retardance(incidence, 30.0, 0.62)

    angles = np.linspace(0.5, 16.0, 63)
    delta = np.asarray(at(angles))
    assert np.any(np.diff(np.floor(delta / 180.0)) != 0)
    assert np.abs(np.diff(delta)).max() < 12.0  # nowhere a jump by an order
    slope = jax.vmap(jax.grad(at))(jnp.asarray(angles))
    np.testing.assert_allclose(slope, difference(at, angles, 1.0), atol=1e-5)

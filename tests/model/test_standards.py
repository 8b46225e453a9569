"""Standards that have a colour: the law of interstellar polarisation, values of several bands, the slope in a band."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from walop_jax.data.checks import make_sources
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.schema import SOURCES, table_of
from walop_jax.data.settings import builtin_filter
from walop_jax.data.units import Place
from walop_jax.fit.base_model import base_model
from walop_jax.io.errors import DataError
from walop_jax.likelihood import engine
from walop_jax.likelihood.columns import columns, own_columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import light
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.planning import plan_for
from walop_jax.model.sources import PointIllumination, Standards, mean_over_band
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import simulate, truth_values

BOTH = ObservingPlan(
    grid=3, standard_grid=2, polariser_angles=(0.0, 60.0, 120.0), moon_patches=0, standards=3, unpolarised=1,
    filters=("NB-580", "NB-660"), star_lmax=(0.45, 0.65), throughput_degree=1,
)  # fmt: skip
HERE = Place("set.fits", "SOURCES")


def sources(**changes):
    """Two stars, the first with values in two bands."""
    columns = {
        "SOURCE": [4, 4, 7], "NAME": ["HD 1", "HD 1", "HD 2"], "FILTER": ["V", "R", "V"], "Q": [0.05, 0.049, 0.0],
        "U": [0.0, 0.001, 0.0], "Q_ERR": [2e-4] * 3, "U_ERR": [2e-4] * 3, "TEFF": [8000.0, 8000.0, np.nan],
    }  # fmt: skip
    given = {name: np.array(values) for name, values in (columns | changes).items()}
    return make_sources(table_of(given, SOURCES, HERE), HERE)


@pytest.mark.parametrize(
    ("lmax", "r_to_rc", "narrow"), [(0.45, 0.021, 0.064), (0.55, 0.010, 0.029), (0.65, -0.002, -0.014)]
)
def test_ratios_of_the_law(lmax, r_to_rc, narrow):
    """Per cents of Serkowski's law with K = 1.66 λmax + 0.01, worked out by hand for 0.62/0.645 and 0.58/0.66 µm."""
    r, rc, low, high = (
        float(mean_over_band(jnp.array(lmax), jnp.array([one, 0.0]))) for one in (0.62, 0.645, 0.58, 0.66)
    )
    assert (r / rc - 1.0, low / high - 1.0) == pytest.approx((r_to_rc, narrow), abs=6e-4)


def test_mean_over_a_band_is_that_of_a_fine_sum():
    """Three nodes against ten thousand, for a Gaussian band as wide as R."""
    lmax, mean, width = 0.5, 0.64, 0.067
    fine = np.linspace(mean - 6 * width, mean + 6 * width, 10001)
    weight = np.exp(-0.5 * ((fine - mean) / width) ** 2)
    law = np.exp(-(1.66 * lmax + 0.01) * np.log(lmax / fine) ** 2)
    assert float(mean_over_band(jnp.array(lmax), jnp.array([mean, width]))) == pytest.approx(
        float(weight @ law / weight.sum()), abs=2e-5
    )


def test_rows_of_one_star():
    """One number for a star with values in several bands; what contradicts itself names column and row."""
    table = sources()
    assert table.stars.tolist() == [0, 0, 2]
    assert sources(FILTER=["", "", ""], SOURCE=[1, 2, 3]).columns().keys() == SOURCES.keys() - {
        "FILTER",
        "SCATTER",
    }
    for changes, what in (
        ({"FILTER": ["V", "V", "V"]}, "already"),
        ({"FILTER": ["V", "", "V"]}, "not unique"),
        ({"FILTER": ["V", "W", "V"]}, "'W' is neither"),
        ({"NAME": ["HD 1", "HD 3", "HD 2"]}, "NAME"),
        ({"TEFF": [8000.0, 9000.0, np.nan]}, "TEFF"),
    ):
        with pytest.raises(DataError, match=what):
            sources(**changes)


def test_a_value_of_each_filter_is_the_one_that_counts():
    """Of two values that of the own filter; its wavelength changes nothing then, and the law nothing."""
    run = simulate(BOTH, seed=1, noiseless=True)
    model = base_model(run.calset)
    assert {"standard.STD01.NB-580.q", "standard.STD01.lmax", "standard.STD01.turn"} < set(model.names)
    plan = plan_for(run.truth, run.calset.exposures, run.calset.filters, run.calset.sources)
    star = np.where(run.calset.exposures.filter == "NB-660", 1, -1)
    star[run.calset.exposures.kind != "standard"] = -1
    one = run.truth.standard
    both = Standards.coloured(
        (*one.names[:2], "STD01.NB-660", *one.names[2:]),
        np.array([[*one.q[:2], 0.03, *one.q[2:]], [*one.u[:2], 0.01, *one.u[2:]]]),
        [*one.bands[:2], tuple(np.asarray(plan.exposures.colour)[star > 0][0, 1].tolist()), *one.bands[2:]],
        (0, 1, 1, 3),
    )
    colour = jnp.insert(plan.exposures.colour, 2, plan.exposures.colour[:, 1], axis=1)
    exposures = dataclasses.replace(
        plan.exposures, colour=colour, rotator=jnp.zeros_like(plan.exposures.rotator)
    )
    illumination = PointIllumination(
        exposures, jnp.zeros((len(star), 2)), jnp.array(star), jnp.zeros(()), jnp.zeros(())
    )
    np.testing.assert_allclose(
        both.polarisation(illumination)[star > 0], [[0.03, 0.01]] * (star > 0).sum(), rtol=1e-14
    )


def test_truth_fits_without_residuals():
    """Expected counts of stars with colours, in two filters, from the catalogue's value in the first."""
    run = simulate(BOTH, seed=1, noiseless=True)
    model = base_model(run.calset, throughput_degree=1)
    assert list(run.calset.sources.filter) == ["NB-580"] * 3
    values = np.array([run.values[name] for name in model.names])
    _, residual = Likelihood.of(run.calset, model).residuals(values)
    assert np.abs(residual).max() < 1e-6
    assert values[model.index("standard.STD01.lmax")] == 0.45
    # Of one q, u in both filters the counts would be off by many errors.
    values[model.index("standard.STD01.lmax")] = 0.65
    _, residual = Likelihood.of(run.calset, model).residuals(values)
    assert np.abs(residual).max() > 1.0


def test_the_slope_inside_a_band_is_in_the_counts():
    """Counts of a star against the band integral of optics times its q, u at every wavelength."""
    south, lmax = nominal_instrument(), 0.45
    plan = dataclasses.replace(BOTH, filters=("SDSS-r",), star_lmax=(lmax,), moon_patches=0)
    run = simulate(plan, seed=2, noiseless=True)
    e, stars = run.calset.exposures, run.calset.sources
    curves, x, y = {"SDSS-r": builtin_filter("SDSS-r")}, jnp.array(0.21), jnp.array(-0.13)
    device = south.with_source(dataclasses.replace(run.truth.standard))
    laid = plan_for(device, e, curves, stars)
    number = int(np.flatnonzero(e.kind == "standard")[1])
    source = np.where(np.arange(len(e)) == number, 1, -1)
    illumination = PointIllumination(laid.exposures, jnp.zeros((len(e), 2)), jnp.array(source), x, y)
    band = np.take_along_axis(laid.band_of, source[:, None] + 1, 1)[:, 0]
    throughput = device.throughput.at(x, y)

    def counts(law):
        """With the weights of the band times a function of the wavelength."""
        weight = np.asarray(laid.node_weight) * law
        changed = dataclasses.replace(laid, node_weight=jnp.array(weight), slope=None)
        return np.asarray(
            light.camera_vectors(device, light.band_rows(device, changed, x, y), throughput, x, y)
        )

    modelled = np.asarray(
        light.counts(device, light.band_rows(device, laid, x, y), throughput, illumination, jnp.array(band))
    )[number]
    wavelength = np.asarray(laid.wavelength)
    law = np.exp(-(1.66 * lmax + 0.01) * np.log(lmax / wavelength) ** 2)
    flat, sloping = counts(1.0)[band[number]], counts(law)[band[number]]
    qu = np.asarray(device.standard.polarisation(illumination))[number]
    exact = flat[:, 0] + sloping[:, 1:3] @ qu
    without = flat[:, 0] + flat[:, 1:3] @ qu
    assert np.abs(without - exact).max() > 1e-5 * exact.max()
    assert np.abs(modelled - exact).max() < 0.1 * np.abs(without - exact).max()


@pytest.mark.parametrize(
    "name", ["standard_colour", "standard_drift", "standard_values", "standard_angles", "standard_degrees"]
)
def test_columns_of_what_standards_may_do(name):
    """Columns from slots against the derivative of the whole light path, for stars with a colour in two filters."""
    run = simulate(BOTH, seed=3)
    model = base_model(run.calset, throughput_degree=1)
    context = effect_context(model.template, run.calset.exposures)
    effect = effect_by_name(name).probes(context)[0 if name.endswith("s") else 1][0]
    likelihood, values = Likelihood.of(run.calset, model), model.start
    changes = effect.first_order(model.template)
    found = columns(likelihood, values, changes)
    exact = own_columns(likelihood, values, (effect,))
    assert np.abs(exact).max() > 0.0
    # A star's slope inside a band is left out of the columns.
    np.testing.assert_allclose(found, exact, atol=2e-3 * np.abs(exact).max())


def test_degrees_of_all_standards_are_those_of_another_catalogue():
    """Counts of the same stars with Stokes parameters that are larger by 5 %; nothing else changes."""
    run = simulate(BOTH, seed=3)
    model = base_model(run.calset, throughput_degree=1)
    larger = with_effects(
        model, [effect_by_name("standard_degrees").of(BOTH.context(), share=0.05)], run.calset
    )
    values = model.start.copy()
    scaled = [n for n in model.names if n.startswith("standard.") and n.endswith((".q", ".u"))]
    assert scaled
    for name in scaled:
        values[model.index(name)] *= 1.05
    here, there = (Likelihood.of(run.calset, m) for m in (model, larger))
    at = [larger.index(name) for name in model.names]
    start = larger.start
    start[at] = model.start
    changed = here.residuals(values)[1]
    np.testing.assert_allclose(there.residuals(start)[1], changed, atol=1e-9)
    assert np.abs(changed - here.residuals(model.start)[1]).max() > 1.0


def test_two_files_with_a_value_each():
    """Values of one star in two filters are no error when files are joined; two in one filter are."""
    sets = []
    for name in BOTH.filter_names:
        run = simulate(dataclasses.replace(BOTH, filters=(name,)), seed=1)
        table = run.calset.sources
        changed = dataclasses.replace(table, filter=np.full(3, ""), q=table.q + (name == "NB-660") * 1e-3)
        sets.append(dataclasses.replace(run.calset, sources=changed))
    joined = merge_calibration_sets(*sets)
    assert sorted(zip(joined.sources.source.tolist(), joined.sources.filter.tolist(), strict=True)) == [
        (star, name) for star in range(3) for name in BOTH.filter_names
    ]
    other = dataclasses.replace(
        sets[1], exposures=dataclasses.replace(sets[1].exposures, filter=sets[0].exposures.filter)
    )
    with pytest.raises(DataError, match="other values"):
        merge_calibration_sets(sets[0], other)
    same = dataclasses.replace(sets[1], sources=sets[0].sources)
    assert merge_calibration_sets(sets[0], same).sources.filter.tolist() == [""] * 3


# ------------------------------------------------------------------------------------ fields of zero polarisation

FIELD = ObservingPlan(
    grid=2, standard_grid=1, polariser_angles=(0.0, 60.0), moon_patches=0, standards=1, unpolarised=1,
    zero_stars=7, zero_exposures=2, zero_scatter=1e-3, throughput_degree=0,
)  # fmt: skip


def test_the_stars_of_a_field_are_in_every_exposure_of_it():
    used, source = FIELD.layout()
    assert FIELD.star_names == ("STD00", "ZERO")
    assert used.sum(axis=0).tolist() == [4, 4, 1, 7, 7]
    assert np.unique(source[5:], axis=0).tolist() == [[-1, -1, -1, 1, 1]]
    assert len(FIELD.points()) == 4 + 1 + 7
    assert np.abs(FIELD.points().x[5:]).max() <= 0.9 * FIELD.field


def at_truth(likelihood: Likelihood, truth: Instrument) -> np.ndarray:
    """The true values of the parameters of a model."""
    named = truth_values(truth)
    return np.array([named[name] for name in likelihood.model.names])


def turned_field(seed: int) -> tuple[Likelihood, np.ndarray]:
    """The field, its two exposures at rotators that differ, and values a little off those of its model."""
    run = simulate(FIELD, seed=seed, instrument=nominal_instrument())
    calset = run.calset
    rotator = np.array([0.0, 0.0, 0.0, 0.1, 0.6])
    calset = dataclasses.replace(calset, exposures=dataclasses.replace(calset.exposures, rotator=rotator))
    likelihood = Likelihood.of(calset, base_model(calset, throughput_degree=0))
    values = at_truth(likelihood, run.truth)
    values[likelihood.model.index("standard.ZERO.q")] += 5e-4
    return likelihood, values


def test_q_and_u_of_each_star_of_a_field_are_free_within_its_scatter():
    """χ² beside that of scipy with the fluxes and q, u of every star as parameters, the scatter as their prior."""
    likelihood, values = turned_field(1)
    model, data, e = likelihood.model, likelihood.points.gathered, slice(3, 5)
    counts, weight = data("counts")[5:, e], data("weight")[5:, e]
    block = likelihood.calset.intensities.block(5, 12)
    np.testing.assert_allclose(weight, 1.0 / block.sigma[:, e])
    instrument, (batch,) = model.instrument(values), likelihood.points
    row = np.arange(len(likelihood.calset.sources)) == 1

    def unit(q: float, u: float) -> np.ndarray:
        standard = instrument.standard
        moved = instrument.changed("standard", q=standard.q + q * row, u=standard.u + u * row)
        return np.asarray(engine.prediction(moved, likelihood.plan, batch))[5:12, e]

    neutral, probe = unit(0.0, 0.0), 1e-2  # counts are linear in q and u
    by_q, by_u = ((unit(*off) - neutral) / probe for off in ((probe, 0.0), (0.0, probe)))
    _, residual = likelihood.residuals(values)
    for star in range(7):

        def left(x: np.ndarray, star: int = star) -> np.ndarray:
            light = neutral[star] + 1e-3 * (x[2] * by_q[star] + x[3] * by_u[star])
            model_counts = 1e6 * x[:2, None] * light
            return np.append(((counts[star] - model_counts) * weight[star]).ravel(), x[2:])

        best = optimize.least_squares(left, [2.0, 2.0, 0.0, 0.0], x_scale="jac", xtol=1e-12, ftol=1e-12)
        assert np.sum(residual[5 + star, e] ** 2) == pytest.approx(2.0 * best.cost, rel=5e-3)


def test_a_field_in_several_exposures_has_its_degrees_of_freedom():
    """χ² of truths: 3 for each row whatever the stars are like; with weights for the scatter it was a third less."""
    square = []
    for seed in range(12):
        run = simulate(FIELD, seed=seed)
        likelihood = Likelihood.of(run.calset, base_model(run.calset, throughput_degree=0))
        residual = likelihood.residuals(at_truth(likelihood, run.truth))[1]
        square.append(np.sum(residual[5:, 3:] ** 2))
    rows = 12 * 7 * 2
    assert np.sum(square) / (3 * rows) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (3 * rows)))


def test_slopes_of_a_field_are_those_of_its_residuals():
    """Jacobian, columns of the score test and χ² of the expansion against differences of the residuals."""
    likelihood, values = turned_field(2)
    used = likelihood.used
    i = likelihood.model.free.tolist().index(likelihood.model.index("standard.ZERO.q"))
    step = np.zeros_like(values)
    step[likelihood.model.free[i]] = 1e-6
    up, down = (likelihood.residuals(values + sign * step)[1][used].ravel() for sign in (1, -1))
    slope, residual = likelihood.jacobian(values)[:, i], likelihood.residuals(values)[1]
    # The Jacobian leaves out what the residuals turn the flux by, which is of no consequence for the gradient.
    np.testing.assert_allclose(slope, (up - down) / 2e-6, atol=0.01 * np.abs(slope).max())
    assert slope @ residual[used].ravel() == pytest.approx((up @ up - down @ down) / 4e-6, rel=1e-3)
    expansion = likelihood.expand(values)
    assert expansion.data == pytest.approx(np.sum(residual**2), rel=1e-12)
    half = slope @ residual[used].ravel()
    rows = likelihood.priors
    half += rows.jacobian(likelihood.model.selection())[:, i] @ rows.residuals(values)
    assert expansion.gradient[i] == pytest.approx(half, rel=1e-9)
    (effect,), *_ = effect_by_name("standard_outlier").probes(
        effect_context(likelihood.model.template, likelihood.calset.exposures)
    )
    by_slots = columns(likelihood, values, effect.first_order(likelihood.model.template))
    exact = own_columns(likelihood, values, (effect,))
    np.testing.assert_allclose(by_slots, exact, atol=2e-3 * np.abs(exact).max())


def test_stars_of_a_field_differ_by_their_scatter():
    """Simulated counts against those without scatter: q of the same star is off by the same in both exposures."""
    one, other = (
        simulate(dataclasses.replace(FIELD, zero_scatter=s, electrons=1e9), seed=1).calset
        for s in (0.0, 1e-3)
    )
    a, b = (calset.intensities.block(5, 12).counts[:, 3:] for calset in (one, other))
    q = [(n[..., 0] - n[..., 1]) / (n[..., 0] + n[..., 1]) for n in (a, b)]
    off = q[1] - q[0]
    assert 3e-4 < off.std() < 2e-3
    np.testing.assert_allclose(off[:, 0], off[:, 1], atol=2e-4)

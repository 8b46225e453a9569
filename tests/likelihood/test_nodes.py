"""Optics interpolated over the field against optics solved point by point."""

from __future__ import annotations

import effect_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_run import WITH_PLATE

from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood import engine, limits
from walop_jax.likelihood import field_table as nodes
from walop_jax.likelihood.field_table import FieldTable
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import chebyshev
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.dependence import optical_indices
from walop_jax.model.effects import effect_by_name
from walop_jax.model.parameters import leaves, values_of
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

FIELD = Rectangle(np.full(2, -0.3), np.full(2, 0.3))
PLATE_AT_45 = ObservingPlan(
    grid=6, standard_grid=3, polariser_angles=polariser_turn(8, full_turn=True), plate=(None, 45.0),
    moon_patches=4, standards=2, unpolarised=1,
)  # fmt: skip


def same(one, other, rtol=1e-8):
    """χ², gradient and matrix agree, the latter two in units of the standard errors."""
    assert float(one[0]) == pytest.approx(float(other[0]), rel=rtol)
    gradient, matrix = np.asarray(other[1]), np.asarray(other[2])
    size = np.sqrt(np.diag(matrix))
    size = np.where(size > 0, size, 1.0)
    np.testing.assert_allclose(np.asarray(one[1]) / size, gradient / size, atol=rtol * np.sqrt(other[0]))
    np.testing.assert_allclose(
        np.asarray(one[2]) / np.outer(size, size), matrix / np.outer(size, size), atol=rtol
    )


def scales(instrument):
    every = [leaf.width or leaf.scale or 1.0 for leaf in leaves(instrument)]
    return np.array(every)[list(optical_indices(instrument))]


@pytest.fixture(scope="module")
def simulated():
    return simulate(WITH_PLATE, seed=4)


@pytest.fixture(scope="module")
def exact(simulated):
    return Likelihood.of(simulated.calset, base_model(simulated.calset))


@pytest.fixture(scope="module")
def quick(simulated):
    return Likelihood.of(simulated.calset, base_model(simulated.calset), interpolate=True)


def test_expansion_from_a_table_is_that_of_the_points_at_its_nodes():
    """There the series are exact, whatever the optics: χ², gradient and matrix are those of the plain rows."""
    device, plan = scenes.instrument(), scenes.plan()
    x, y = chebyshev.grid(FIELD, 2)
    data = scenes.points(plan, x, y)
    counts = scenes.FLUX * np.random.default_rng(7).uniform(0.1, 0.9, data.counts.shape)
    data = data._replace(counts=jnp.asarray(counts), weight=jnp.asarray(1.0 / np.sqrt(counts)))
    table = FieldTable.through(FIELD, 2, nodes.solved_optics(device, plan, x, y))
    same(
        engine.normal_equations(device, plan, data, jax.tree.map(jnp.asarray, table)),
        engine.normal_equations(device, plan, data),
    )


@pytest.mark.long
def test_expansion_agrees(simulated, exact, quick):
    """Calibration plate in and out, Moon sky, standards of several temperatures; at the truth and away from it."""
    for values in (exact.model.start, np.asarray(values_of(simulated.truth))):
        one, other = quick.expand(values), exact.expand(values)
        same((one.data, one.gradient, one.matrix), (other.data, other.gradient, other.matrix))
        assert 0.0 < one.optics.error <= nodes.TOLERANCE
    for one, other in zip(quick.residuals(values), exact.residuals(values), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-6)


@pytest.mark.long
def test_fit_ends_at_the_same_place(exact, quick):
    one, other = fit(quick), fit(exact)
    assert one.converged
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-8)
    known = other.sigma > 0
    assert (np.abs(one.values - other.values)[known] < 1e-4 * other.sigma[known]).all()
    np.testing.assert_allclose(one.sigma, other.sigma, rtol=1e-6)


@pytest.mark.long
def test_optics_that_change_and_ghosts_go_through_the_same_tables():
    """Flexure and temperature make optics of each exposure, ghosts need the opposite point, detectors the flux."""
    effects = [
        effect_by_name("flexure").of(scenes.CONTEXT, rate_x=0.004, rate_y=-0.002),
        effect_by_name("hwp_temperature").of(scenes.CONTEXT, coefficient=0.8),
        effect_by_name("ghost").of(scenes.CONTEXT, share=0.03),
        effect_by_name("nonlinearity").of(scenes.CONTEXT, coefficient=0.02),
    ]
    device, plan = scenes.instrument(*effects), scenes.plan(effects)
    data = scenes.points(plan)
    rng = np.random.default_rng(7)
    flux = np.where(np.asarray(plan.exposures.flux_known), 1.0, scenes.FLUX)[:, None]
    counts = flux * np.asarray(engine.prediction(device, plan, data))
    data = data._replace(
        counts=jnp.asarray(counts * (1.0 + 0.002 * rng.standard_normal(counts.shape))),
        weight=jnp.asarray(1.0 / np.sqrt(counts + 900.0)),
    )
    table, error = nodes.accurate_nodes(device, plan, FIELD, scales(device))
    assert table is not None
    assert error <= nodes.TOLERANCE
    same(engine.normal_equations(device, plan, data, table), engine.normal_equations(device, plan, data))


def test_error_is_measured(monkeypatch):
    """Too few nodes are noticed, and the stated error is that of places nobody asked about."""
    simulated = simulate(PLATE_AT_45, seed=4)
    plan = Likelihood.of(simulated.calset, base_model(simulated.calset)).plan
    scale = scales(simulated.truth)
    monkeypatch.setattr(limits, "NODES_PER_SIDE", (8,))
    table, stated = nodes.accurate_nodes(simulated.truth, plan, FIELD, scale)
    assert table is None
    assert nodes.TOLERANCE < stated < 0.01
    monkeypatch.setattr(nodes, "TOLERANCE", 0.01)
    table, again = nodes.accurate_nodes(simulated.truth, plan, FIELD, scale)
    assert again == stated
    x, y = np.random.default_rng(3).uniform(-0.3, 0.3, (2, limits.BATCH))
    rows, _ = nodes.solved_optics(simulated.truth, plan, x, y)
    between, _ = table(jnp.asarray(x), jnp.asarray(y))
    assert 0.1 * stated < np.abs(np.asarray(between - rows)).max() < 3.0 * stated


def test_what_cannot_be_interpolated_is_solved_point_by_point(simulated, exact, monkeypatch):
    monkeypatch.setattr(limits, "NODES_PER_SIDE", (6, 8))
    likelihood = Likelihood.of(simulated.calset, base_model(simulated.calset), interpolate=True)
    values = likelihood.model.start
    found = likelihood.expand(values)
    assert found.data == pytest.approx(exact.expand(values).data, rel=1e-14)  # other points together
    assert found.optics.nodes_per_side is None
    # Having failed there, nobody tries again nearby.
    monkeypatch.setattr("walop_jax.likelihood.likelihood.accurate_nodes", None)
    assert likelihood.expand(values, near=found).data == found.data


@pytest.mark.long
def test_as_many_nodes_as_nearby_are_tried_first(quick, monkeypatch):
    here = quick.expand(quick.model.start)
    tried, through = [], FieldTable.through

    def noted(rectangle, count, values, **options):
        tried.append(count)
        return through(rectangle, count, values, **options)

    monkeypatch.setattr(FieldTable, "through", noted)
    again = quick.expand(quick.model.start, near=here)
    assert tried == [here.optics.nodes_per_side]
    assert again.optics == here.optics
    assert again.data == here.data


def test_tables_of_a_few_hundred_points_are_exact(exact):
    assert exact.layout.points < limits.INTERPOLATE_ABOVE
    assert not exact.layout.interpolated
    assert exact.expand(exact.model.start).optics == (None, 0.0)

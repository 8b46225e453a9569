"""Large sets: the minimum from a sample and a pass or two, and what of it is kept."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from frame_run import frame_run

from walop_jax.fit import misfit, search
from walop_jax.fit.base_model import base_model
from walop_jax.fit.minimise import minimise
from walop_jax.fit.refit import fit
from walop_jax.likelihood import engine, limits
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.parameters import with_values
from walop_jax.simulation.simulate import simulate

RUN = frame_run(72)


@pytest.fixture(scope="module")
def made():
    calset = simulate(RUN, seed=12).calset
    return Likelihood.of(calset, base_model(calset, throughput_degree=2), batch=512, interpolate=True)


@pytest.fixture(scope="module")
def fitted(made):
    return fit(made)


@pytest.fixture
def large(made, monkeypatch):
    """The same set, handled as if it were too large for many passes."""
    monkeypatch.setattr(limits, "LARGE_ABOVE", 0)
    monkeypatch.setattr(limits, "SAMPLE", 1024)
    return Likelihood.of(made.calset, made.model, batch=512)


def test_blocks_change_nothing(made):
    """Batches of 512 go in blocks of 64; batches of 250 are one block each."""
    other = Likelihood.of(made.calset, made.model, batch=250, interpolate=True)
    one, two = made.expand(made.model.start), other.expand(made.model.start)
    size = np.sqrt(np.diag(two.matrix))
    assert one.data == pytest.approx(two.data, rel=1e-12)
    np.testing.assert_allclose(
        one.matrix / np.outer(size, size), two.matrix / np.outer(size, size), atol=1e-11
    )


@pytest.mark.long
def test_the_fit_of_a_large_set_ends_where_the_usual_one_ends(large, fitted):
    assert large.layout.large
    found = fit(large)
    assert found.converged
    assert found.minimum.steps <= 3
    assert found.chi2 == pytest.approx(fitted.chi2, rel=1e-9)
    known = fitted.sigma > 0
    assert (np.abs(found.values - fitted.values)[known] < 2e-3 * fitted.sigma[known]).all()
    # The matrix is that of the place before the last step.
    np.testing.assert_allclose(found.sigma, fitted.sigma, rtol=5e-3)
    assert (found.dof, found.n_data) == (fitted.dof, fitted.n_data)
    assert found.expansion.used_data.field == made_field(large)


def made_field(likelihood):
    x, y = likelihood.calset.points.x, likelihood.calset.points.y
    return (x.min(), x.max(), y.min(), y.max())


@pytest.mark.long  # the expansions alone: test_nodes.py
def test_large_and_table_path_agree_to_1e_8(made, monkeypatch):
    """144 of the points: interpolated optics, blocks and a fit from a sample, beside the path that tables take."""
    sample = thinned(made.calset, 144, neighbours=1)
    assert len(sample.points) == 144
    plain = Likelihood.of(sample, made.model)
    assert not plain.layout.interpolated
    monkeypatch.setattr(limits, "LARGE_ABOVE", 0)
    monkeypatch.setattr(search, "LARGE_TOLERANCE", 1e-6)
    monkeypatch.setattr(limits, "SAMPLE", 72)
    large = Likelihood.of(sample, made.model, batch=16, interpolate=True)
    assert large.layout.large
    a, b = plain.expand(made.model.start), large.expand(made.model.start)
    size = np.sqrt(np.diag(a.matrix))
    assert a.data == pytest.approx(b.data, rel=1e-8)
    np.testing.assert_allclose(b.gradient / size, a.gradient / size, atol=1e-8 * np.sqrt(a.data))
    np.testing.assert_allclose(b.matrix / np.outer(size, size), a.matrix / np.outer(size, size), atol=1e-8)
    monkeypatch.setattr(search, "minimise", _tight(search.minimise))
    one, other = fit(plain), fit(large)
    assert other.chi2 == pytest.approx(one.chi2, rel=1e-8)
    scale = np.array([p.scale for p in made.model.parameters])
    np.testing.assert_allclose(other.values / scale, one.values / scale, atol=1e-8)


def _tight(minimise):
    def tighter(*args, **options):
        return minimise(*args, **(options | {"tolerance": min(options.get("tolerance", 1.0), 1e-5)}))

    return tighter


@pytest.mark.long
def test_optimistix_on_residuals_in_memory_finds_the_same(made):
    """The reference: `optimistix.LevenbergMarquardt` on the residuals themselves, derivatives by JAX."""
    sample = thinned(made.calset, 20, neighbours=1)
    likelihood = Likelihood.of(sample, made.model)
    model, batches = likelihood.model, list(likelihood.points)
    scale = np.array([model.parameters[i].scale for i in model.free])
    select = model.selection() * scale
    to_instrument = with_values(model.instrument())

    def residuals(x, _):
        values = jnp.asarray(model.start) + select @ x
        data = [engine._residuals(to_instrument(values), likelihood.plan, batch)[1] for batch in batches]
        known = [(i, *p.prior) for i, p in enumerate(model.parameters) if p.free and p.prior is not None]
        free = [(i, p) for i, p in enumerate(model.parameters) if p.free and p.prior is None]
        pulled = [(i, p.start, p.loose) for i, p in free if p.loose is not None]
        index, mean, width = (np.array(column) for column in zip(*known, *pulled, strict=True))
        return jnp.concatenate([*map(jnp.ravel, data), (values[index] - mean) / width])

    x = jnp.zeros(len(scale))
    # The second one takes away the damping that the first still has when it stops.
    for solver in (optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6), optx.GaussNewton(rtol=1e-12, atol=1e-12)):
        x = optx.least_squares(residuals, solver, x, max_steps=60, throw=False).value

    near = fit(likelihood).values[model.free]
    ours = minimise(lambda x: likelihood.expand(model.full(x)), near, scale, damping=0.0, tolerance=1e-8)
    assert ours.converged
    reference = model.start + select @ np.asarray(x)
    everything = np.array([p.scale for p in model.parameters])
    np.testing.assert_allclose(model.full(ours.x) / everything, reference / everything, atol=1e-8)
    objective = float(jnp.sum(residuals(x, None) ** 2))
    assert ours.expansion.objective == pytest.approx(objective, rel=1e-10)


def test_misfit_of_a_large_set_is_that_of_points_spread_over_it(made, monkeypatch):
    values = made.model.start
    full = misfit.misfit_at(made, values)
    monkeypatch.setattr(misfit, "MISFIT_POINTS", 2560)
    some = misfit.misfit_at(made, values)
    assert some != full
    assert some.camera == pytest.approx(full.camera, rel=0.1)
    assert some.matrix_element == pytest.approx(full.matrix_element, rel=0.1)

"""Steps with a sketch of the matrix: exact χ² and gradient, and the same minimum in the end."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from walop_jax.fit import misfit
from walop_jax.fit.refit import fit
from walop_jax.likelihood import problem as likelihood
from walop_jax.likelihood.chunks import thinned
from walop_jax.likelihood.observing import ObservingPlan, polariser_turn
from walop_jax.likelihood.problem import Problem, base_model, evenly_covered
from walop_jax.likelihood.simulate import simulate

RUN = ObservingPlan(
    grid=72, standard_grid=1, standards=0, unpolarised=0, moon_patches=3,
    polariser_angles=polariser_turn(8, full_turn=True), throughput_degree=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def made():
    calset = simulate(RUN, seed=12).calset
    return Problem(calset, base_model(calset, throughput_degree=2), points_per_chunk=512, interpolate=True)


def test_chi2_and_gradient_are_exact_and_the_matrix_nearly(made):
    values = made.model.start
    sketch, full = made.expand(values, sketch=True), made.expand(values)
    assert sketch.data == pytest.approx(full.data, rel=1e-12)
    size = np.sqrt(np.diag(full.matrix))
    np.testing.assert_allclose(sketch.gradient / size, full.gradient / size, atol=1e-10 * np.sqrt(full.data))
    # 320 of 5184 points, spread evenly: the metric of all of them to some ten per cent in any direction.
    value, vector = np.linalg.eigh(full.matrix / np.outer(size, size))
    white = vector / np.sqrt(value)
    ratio = np.linalg.eigvalsh(white.T @ (sketch.matrix / np.outer(size, size)) @ white)
    assert 0.6 < ratio.min() < ratio.max() < 1.6


def test_blocks_change_nothing(made):
    """Chunks of 512 go in blocks of 64; chunks of 250 are one block each."""
    other = Problem(made.calset, made.model, points_per_chunk=250, interpolate=True)
    one, two = made.expand(made.model.start), other.expand(made.model.start)
    size = np.sqrt(np.diag(two.matrix))
    assert one.data == pytest.approx(two.data, rel=1e-12)
    np.testing.assert_allclose(
        one.matrix / np.outer(size, size), two.matrix / np.outer(size, size), atol=1e-11
    )


def test_fit_ends_where_the_full_matrix_ends(made, monkeypatch):
    full = fit(made)
    monkeypatch.setattr(likelihood, "SKETCH_ABOVE", 0)
    assert made.sketches
    sketched = fit(made)
    assert sketched.converged
    assert sketched.chi2 == pytest.approx(full.chi2, rel=1e-9)
    known = full.sigma > 0
    assert (np.abs(sketched.values - full.values)[known] < 2e-3 * full.sigma[known]).all()
    np.testing.assert_allclose(sketched.sigma, full.sigma, rtol=1e-5)


def test_misfit_of_a_large_set_is_that_of_points_spread_over_it(made, monkeypatch):
    values = made.model.start
    full = misfit.describe(made, values)
    monkeypatch.setattr(misfit, "LOOKED_AT", 2560)
    some = misfit.describe(made, values)
    assert some != full
    assert some.camera == pytest.approx(full.camera, rel=0.1)
    assert some.matrix_element == pytest.approx(full.matrix_element, rel=0.1)


def test_exposures_of_a_few_points_are_never_left_to_chance(made):
    """A standard star at three places among the pixels: a sixteenth of the points might hold none of them."""
    chunk = made.chunks[0]
    assert evenly_covered(chunk)
    assert evenly_covered(chunk._replace(weight=chunk.weight.at[:, 2].set(0.0)))
    assert not evenly_covered(chunk._replace(weight=chunk.weight.at[3:, 2].set(0.0)))
    calset = thinned(made.calset, 512, run=512)
    table = calset.intensities
    rare = table.using((table.exposure != 2) | (table.point < 3))
    for intensities, exact in ((table, False), (rare, True)):
        problem = Problem(
            dataclasses.replace(calset, intensities=intensities), made.model, 512, interpolate=True
        )
        sketch, full = (problem.expand(made.model.start, sketch=flag) for flag in (True, False))
        assert np.array_equal(sketch.matrix, full.matrix) == exact

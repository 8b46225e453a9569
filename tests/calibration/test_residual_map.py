"""The map of what a smooth model leaves: put in by hand, found again; nothing found where nothing is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from changed_sets import with_block
from frame_run import frame_run

from walop_jax.calibration import residual_map
from walop_jax.calibration.matrix import analysis_vectors, residual_names
from walop_jax.calibration.residual_map import cell_of, cells_for, residual_map_at
from walop_jax.data.settings import Settings
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.parameters import values_of
from walop_jax.model.planning import plan_for_settings
from walop_jax.simulation.simulate import simulate

RUN = frame_run(24)
BROKEN = np.array([3e-4, -2e-4, 5e-4, -4e-4, 1e-4, 6e-4, 2e-3])


def as_values(instrument):
    return np.asarray(values_of(instrument))


def with_structure(simulated, west):
    """Counts of an instrument whose matrix, and whose throughput of N2 and N3, differ by `BROKEN` at some points.

    By the definition of the matrix, m = (v0 − v1)/(v0 + v1)·(1, 0, 0), from the light behind the polariser,
    (1, cos 2θ, sin 2θ).
    """
    calset = simulated.calset
    block = calset.intensities.block(0, len(calset.points))
    e = calset.exposures
    # The lamp, whose colour is not flat.
    lamp = dataclasses.replace(Settings.default(1), teff=e.teff[e.clp_in][:1])
    plan = plan_for_settings(simulated.truth, lamp, calset.filters)
    vectors = analysis_vectors(simulated.truth, plan, block.x, block.y)[:, 0, :, :3]
    twice = 2.0 * np.deg2rad(np.where(e.clp_in, e.clp_angle, 0.0))
    light = np.stack([np.ones(len(e)), np.cos(twice), np.sin(twice)], axis=-1)
    # From all cameras together: a dark one sees little but what the polariser lets through.
    flux = block.counts.sum(axis=-1) / np.einsum("pks,es->pe", vectors, light)
    counts = block.counts.copy()
    for pair, delta in ((0, BROKEN[:3]), (2, BROKEN[3:6])):
        total = (vectors[:, pair, 0] + vectors[:, pair + 1, 0])[:, None]
        for camera, sign in ((pair, 0.5), (pair + 1, -0.5)):
            counts[..., camera] += sign * flux * total * (light @ delta)
    counts[..., 2:] *= 1.0 + BROKEN[6]
    use = west[:, None, None] & e.clp_in[None, :, None]
    return with_block(calset, counts=np.where(use, counts, block.counts))


@pytest.fixture(scope="module")
def noiseless():
    return simulate(RUN, seed=8, noiseless=True)


@pytest.fixture
def cells(monkeypatch):
    """Six by six cells of sixteen points."""
    monkeypatch.setattr(residual_map, "POINTS_PER_CELL", 16)


def likelihood_of(calset):
    return Likelihood.of(calset, base_model(calset, throughput_degree=2), interpolate=True)


def test_structure_is_found_where_it_is(noiseless, cells, monkeypatch):
    monkeypatch.setattr(residual_map, "_main_setting", polariser_only)
    west = noiseless.calset.points.x < 0
    likelihood = likelihood_of(with_structure(noiseless, west))
    found = residual_map_at(likelihood, as_values(noiseless.truth))
    assert found.values.shape == (7, 6, 6)
    for plane, expected in zip(found.values, BROKEN, strict=True):
        # First order in the structure: what is left is of second order.
        np.testing.assert_allclose(plane[:, :3], expected, atol=3e-6)
        np.testing.assert_allclose(plane[:, 3:], 0.0, atol=1e-7)
    assert (found.chi2[:, :3] > 1e3 * found.chi2[:, 3:]).all()


def polariser_only(settings, through):
    """The Moon sky is in the same setting, and its counts were left alone."""
    return settings[:1], through


def test_noise_alone_makes_corrections_of_the_size_of_their_errors(cells):
    simulated = simulate(RUN, seed=8)
    found = residual_map_at(likelihood_of(simulated.calset), as_values(simulated.truth))
    pulls = found.values / found.errors
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=5 * np.sqrt(2 / pulls.size))
    assert abs(found.significance()) < 5
    assert found.chi2.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / (576 * 11 * 3)))
    excess = found.excess()
    for name, error in zip(residual_names(2), found.errors, strict=True):
        # The scatter of a mean of 36 squares.
        assert abs(excess[name]) ** 2 < 5 * np.sqrt(2 / 36) * np.mean(error**2)


def test_structure_below_the_noise_of_a_point_stands_out_of_many(cells, monkeypatch):
    """5·10⁻⁴ in m23: half of the error of a single point, ten times that of the whole map."""
    monkeypatch.setattr(residual_map, "_main_setting", polariser_only)
    simulated = simulate(RUN, seed=8)
    noise = simulated.calset.intensities.block(0, 576)
    clean = simulate(RUN, seed=8, noiseless=True)
    structure = with_structure(clean, np.ones(576, bool)).intensities.block(0, 576)
    added = structure.counts - clean.calset.intensities.block(0, 576).counts
    calset = with_block(simulated.calset, counts=noise.counts + added)
    found = residual_map_at(likelihood_of(calset), as_values(simulated.truth))
    assert found.significance() > 5
    weight = found.errors**-2
    mean = np.sum(found.values * weight, axis=(1, 2)) / np.sum(weight, axis=(1, 2))
    error = np.sum(weight, axis=(1, 2)) ** -0.5
    # 1 %: second order in the structure.
    assert (np.abs(mean - BROKEN) < 5 * error + 0.01 * np.abs(BROKEN)).all()


def test_the_map_is_of_the_setting_with_the_most_exposures():
    plan = dataclasses.replace(RUN, plate=(None, 45.0), moon_patches=0, grid=4)
    e = simulate(plan, seed=1).calset.exposures
    setting, chosen = residual_map._main_setting(Settings.of(e, ("CHWP",)), e.clp_in)
    assert setting.filter[0] == "SDSS-r"
    assert np.isnan(setting.position("CHWP")[0])
    np.testing.assert_array_equal(chosen, ~e.position("CHWP").inside)
    only = dataclasses.replace(plan, plate=(45.0,))
    e = simulate(only, seed=1).calset.exposures
    assert residual_map._main_setting(Settings.of(e, ("CHWP",)), e.clp_in)[0].position("CHWP")[0] == 45.0


def test_cells_without_enough_light_hold_no_number(cells):
    plan = dataclasses.replace(RUN, moon_patches=0)
    calset = simulate(plan, seed=8).calset
    table = calset.intensities
    corner = (calset.points.x > 0.15) & (calset.points.y > 0.15)
    used = ~(corner[table.point] & (table.exposure > 1))
    likelihood = likelihood_of(dataclasses.replace(calset, intensities=table.using(used)))
    found = residual_map_at(likelihood, likelihood.model.start)
    assert np.isnan(found.values[:, -1, -1]).all()
    assert np.isfinite(found.values[:, :3, :3]).all()


def test_every_point_has_a_cell(noiseless, cells):
    likelihood = likelihood_of(noiseless.calset)
    grid = cells_for(likelihood.layout.points, likelihood.used_data, residual_map.POINTS_PER_CELL)
    x, y = likelihood.calset.points.x, likelihood.calset.points.y
    cell = cell_of(grid, x, y)
    np.testing.assert_array_equal(np.bincount(cell), np.full(36, 16))
    centre_x, centre_y = grid.xy(0, 36)
    width = 2 * RUN.field / 6
    assert np.abs(centre_x[cell] - x).max() <= 0.5 * width + 1e-12
    assert np.abs(centre_y[cell] - y).max() <= 0.5 * width + 1e-12

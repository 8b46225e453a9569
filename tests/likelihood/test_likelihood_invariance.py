"""What must not matter to a likelihood does not, whatever the permutation, factor or mask (Hypothesis)."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from small_run import SEED, SMALL

from walop_jax.data.records import Block, CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood.likelihood import Expansion, Likelihood
from walop_jax.simulation.simulate import simulate

few = settings(max_examples=8, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


@functools.cache
def simulated():
    return simulate(SMALL, seed=SEED)


@functools.cache
def plain() -> tuple[Likelihood, np.ndarray, Expansion]:
    """A likelihood, values away from the minimum, and the expansion there."""
    likelihood = of(simulated().calset)
    scale = np.array([p.scale for p in likelihood.model.parameters])
    values = likelihood.model.start + 0.1 * scale * np.random.default_rng(0).standard_normal(len(scale))
    return likelihood, values, likelihood.expand(values)


def of(calset: CalibrationSet) -> Likelihood:
    return Likelihood.of(calset, base_model(calset, throughput_degree=2))


def block_of(calset: CalibrationSet) -> Block:
    return calset.intensities.block(0, len(calset.points))


def with_block(calset: CalibrationSet, **changed: np.ndarray) -> CalibrationSet:
    block = dataclasses.replace(block_of(calset), **changed)
    return dataclasses.replace(calset, intensities=TableIntensities.dense(calset.points, block))


def assert_same(calset: CalibrationSet, rtol: float = 1e-10) -> Likelihood:
    """χ², gradient and matrix are those of the plain set, in units of the standard errors."""
    _, values, expected = plain()
    likelihood = of(calset)
    found = likelihood.expand(values)
    size = np.sqrt(np.diag(expected.matrix))
    assert abs(found.data - expected.data) < rtol * expected.data
    np.testing.assert_allclose(
        found.gradient / size, expected.gradient / size, rtol=0, atol=rtol * np.sqrt(expected.data)
    )
    np.testing.assert_allclose(
        found.matrix / np.outer(size, size), expected.matrix / np.outer(size, size), rtol=0, atol=rtol
    )
    assert found.dof == expected.dof
    return likelihood


@few
@given(seed=seeds)
def test_the_order_of_points_and_exposures_changes_nothing(seed):
    rng, calset = np.random.default_rng(seed), simulated().calset
    p, e = rng.permutation(len(calset.points)), rng.permutation(len(calset.exposures))
    block = block_of(calset)
    points = dataclasses.replace(
        calset.points, **{n: getattr(calset.points, n)[p] for n in ("point", "x", "y")}
    )
    moved = Block(
        block.x[p], block.y[p],
        *(getattr(block, n)[p][:, e] for n in ("counts", "sigma", "used", "source")),
    )  # fmt: skip
    table = TableIntensities.dense(points, moved)
    assert_same(dataclasses.replace(calset, points=points, exposures=calset.exposures[e], intensities=table))


@few
@given(seed=seeds, span=st.floats(0.0, 8.0))
def test_counts_and_errors_in_another_unit_change_the_flux_alone(seed, span):
    """A factor for every exposure at every point, over up to eight decades."""
    calset = simulated().calset
    block = block_of(calset)
    factor = 10.0 ** np.random.default_rng(seed).uniform(-span, 0.0, (*block.used.shape, 1))
    likelihood = assert_same(with_block(calset, counts=block.counts * factor, sigma=block.sigma * factor))
    values = plain()[1]
    flux, residual = likelihood.residuals(values)
    plain_flux, plain_residual = plain()[0].residuals(values)
    np.testing.assert_allclose(flux, plain_flux * factor[..., 0], rtol=1e-9)
    np.testing.assert_allclose(residual, plain_residual, rtol=0, atol=1e-9 * np.abs(plain_residual).max())


@few
@given(seed=seeds, share=st.floats(0.01, 0.5))
def test_what_is_masked_does_not_count_whatever_stands_there(seed, share):
    """Rows that are not used, with any counts and errors, against the same rows with others, and their sum by hand."""
    rng, calset = np.random.default_rng(seed), simulated().calset
    likelihood, values, _ = plain()
    block = block_of(calset)
    gone = block.used & (rng.random(block.used.shape) < share)
    wild = np.where(gone[..., None], rng.uniform(-1e12, 1e12, block.counts.shape), block.counts)
    small = np.where(gone[..., None], 1e-9, block.sigma)
    masked = of(with_block(calset, counts=wild, sigma=small, used=block.used & ~gone))
    found = masked.expand(values)
    residual = likelihood.residuals(values)[1]
    kept = (block.used & ~gone)[..., None]
    np.testing.assert_allclose(found.data, np.sum(np.where(kept, residual, 0.0) ** 2), rtol=1e-10)
    assert masked.independent == likelihood.independent - 3 * int(gone.sum())
    # The derivatives of the rows that are left, from the dense Jacobian of all.
    rows = likelihood.jacobian(values).reshape(-1, residual.shape[-1], len(found.gradient))
    left, used = rows[~gone[block.used]], residual[block.used & ~gone]
    priors = likelihood.priors
    select = likelihood.model.selection()
    pull = priors.jacobian(select).T @ priors.residuals(values)
    size = np.sqrt(np.diag(found.matrix))
    np.testing.assert_allclose(
        np.einsum("rkf,rk->f", left, used) / size, (found.gradient - pull) / size,
        rtol=0, atol=1e-9 * np.sqrt(found.data),
    )  # fmt: skip


@few
@given(seed=seeds)
def test_points_that_are_removed_are_as_good_as_masked(seed):
    rng, calset = np.random.default_rng(seed), simulated().calset
    block, keep = block_of(calset), np.sort(rng.permutation(len(calset.points))[:-3])
    used = block.used.copy()
    used[np.setdiff1d(np.arange(len(calset.points)), keep)] = False
    points = dataclasses.replace(
        calset.points, **{n: getattr(calset.points, n)[keep] for n in ("point", "x", "y")}
    )
    fewer = Block(*(getattr(block, f.name)[keep] for f in dataclasses.fields(Block)))
    table = TableIntensities.dense(points, fewer)
    removed = of(dataclasses.replace(calset, points=points, intensities=table))
    masked = of(with_block(calset, used=used))
    values = plain()[1]
    one, other = removed.expand(values), masked.expand(values)
    size = np.sqrt(np.diag(one.matrix))
    assert abs(one.data - other.data) < 1e-10 * one.data
    np.testing.assert_allclose(
        one.gradient / size, other.gradient / size, rtol=0, atol=1e-10 * np.sqrt(one.data)
    )
    np.testing.assert_allclose(
        one.matrix / np.outer(size, size), other.matrix / np.outer(size, size), rtol=0, atol=1e-10
    )
    assert one.dof == other.dof

"""The points of a set in batches and parts, and samples of them."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from frame_run import frame_run
from frames_file import write_frames

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.grid import Grid
from walop_jax.data.records import Intensities
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import limits
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import simulate

SIDE = 9
RUN = frame_run(SIDE)
STEP = 2 * RUN.field / (SIDE - 1)
GRID = Grid(SIDE, SIDE, (1.0, 1.0), (-RUN.field, -RUN.field), ((STEP, 0.0), (0.0, STEP)))


class Counted(Intensities):
    """Notes which points are asked for."""

    def __init__(self, inner):
        self.inner, self.asked = inner, []

    @property
    def cameras(self):
        return self.inner.cameras

    def block(self, start, stop):
        self.asked.append((start, stop))
        return self.inner.block(start, stop)


@pytest.fixture(scope="module")
def calset(tmp_path_factory):
    """A small run written as whole frames, a few pixels bad, and read back."""
    table = simulate(RUN, seed=6).calset
    # Pixels run along the rows, the points of the simulator in an order of its own.
    order = np.lexsort((table.points.x.round(9), table.points.y.round(9)))
    np.testing.assert_allclose(
        np.stack([table.points.x, table.points.y])[:, order], GRID.xy(0, SIDE**2), atol=1e-12
    )

    class Ordered(Intensities):
        def block(self, start, stop):
            whole = table.intensities.block(0, SIDE**2)
            rows = order[start:stop]
            block = {f.name: np.array(getattr(whole, f.name)[rows]) for f in dataclasses.fields(whole)}
            block["used"] &= (np.arange(start, stop) % 17 != 3)[:, None]
            return dataclasses.replace(whole, **block)

    path = tmp_path_factory.mktemp("frames") / "frames.fits"
    write_frames(
        path, dataclasses.replace(table, points=GRID.points, intensities=Ordered()), GRID, dtype="f8"
    )
    return read_calibration_set(path)


@pytest.fixture
def counted(calset, monkeypatch):
    """The same set in three parts of two batches of 16 points, which notes what is asked for."""
    monkeypatch.setattr(limits, "PARTS", 2)
    return dataclasses.replace(calset, intensities=Counted(calset.intensities))


def test_every_point_is_read_once(calset, counted):
    likelihood = Likelihood.of(counted, base_model(calset, throughput_degree=2), batch=16)
    for _ in range(2):
        used = sum(int((np.asarray(batch.weight[..., 0]) > 0).sum()) for batch in likelihood.points)
        assert used == calset.intensities.rows
    assert counted.intensities.asked == [(0, 32), (32, 64), (64, 76)]
    assert [len(likelihood.points.part(n)) for n in range(3)] == [2, 2, 1]
    np.testing.assert_array_equal(likelihood.points.gathered("x"), calset.points.x)


def test_expansion_and_counts_agree(calset, counted):
    one = Likelihood.of(counted, base_model(calset, throughput_degree=2), batch=16)
    other = Likelihood.of(calset, base_model(calset, throughput_degree=2), batch=16)
    a, b = one.expand(one.model.start), other.expand(other.model.start)
    assert a.data == b.data
    np.testing.assert_array_equal(a.matrix, b.matrix)
    # What an expansion has counted on its way is what a pass of its own counts.
    for found in (a, b):
        np.testing.assert_array_equal(found.used_data.rows, one.used_data.rows)
        assert (found.n_data, found.dof) == (other.used_data.n_data, a.dof)
    assert a.n_data == 4 * other.used.sum() == 4 * calset.intensities.rows
    x, y = calset.points.x, calset.points.y
    assert a.used_data.field == one.used_data.field == (x.min(), x.max(), y.min(), y.max())


def test_a_fault_in_the_file_stops_the_pass(calset, counted):
    def broken(start, stop):
        if start >= 32:
            raise OSError("the disk has gone")
        return calset.intensities.block(start, stop)

    likelihood = Likelihood.of(counted, base_model(calset, throughput_degree=2), batch=16)
    counted.intensities.block = broken
    with pytest.raises(OSError, match="the disk has gone"):
        likelihood.expand(likelihood.model.start)


def test_a_pass_may_be_left_half_way(calset, counted):
    likelihood = Likelihood.of(counted, base_model(calset, throughput_degree=2), batch=16)
    first = next(iter(likelihood.points))
    assert first.x.shape == (16,)
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: len(list(likelihood.points))).result(timeout=60) == 5


def test_a_sample_is_part_of_the_set(calset):
    sample = thinned(calset, 30)
    assert len(sample.points) == 30
    assert thinned(calset, 81) is calset
    rows = np.searchsorted(calset.points.point, sample.points.point)
    whole, part = calset.intensities.block(0, 81), sample.intensities.block(0, 30)
    assert len(np.unique(rows)) == 30
    for field in dataclasses.fields(part):
        np.testing.assert_array_equal(getattr(part, field.name), getattr(whole, field.name)[rows])
    # Spread over the field: the mean position is near its centre.
    assert np.abs([sample.points.x.mean(), sample.points.y.mean()]).max() < 0.3 * RUN.field

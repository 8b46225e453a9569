"""What an iteration costs in time and memory, from a table of 144 points to whole frames.

    OMP_NUM_THREADS=1 python -m pytest tests/likelihood/test_scale.py --benchmark -s

prints the table. Points lie on a square raster, 25 exposures of the polariser, four cameras; counts are made slab by
slab when they are asked for, never stored whole. Reading such slabs from FITS is timed on its own.

Measured on two cores of which other programs took most (load 5 to 8), one thread for BLAS:

    points        data      step     in full    peak
    144                    0.05 s     0.05 s    0.7 GB   exact optics, 350 µs a point
    14 400                 0.16 s     0.38 s    0.7 GB
    1 000 000     4.3 s    9.1 s     25.5 s     1.1 GB   refit 69 s: 5 steps and one in full

The compiled code of a step is 47 kflop and 103 kB a point (3.9 µs: 12 Gflop/s, 26 GB/s), in full 274 kflop and 516 kB
(26 µs: 10 Gflop/s, 20 GB/s; 17 µs in blocks of 64). Bytes are as the compiler counts them, caches or not; that smaller
blocks are faster speaks for memory, not arithmetic, as what holds it back. Frames
are read at 260 000 points/s. Hence 16.7 million points in 19 min under that load, linear in the points.
"""

from __future__ import annotations

import dataclasses
import resource
import time

import jax
import numpy as np
import pytest

from walop_jax.data import Grid, read_calibration_set, write_frames
from walop_jax.data.records import Block, CalibrationSet, Intensities
from walop_jax.fit.refit import fit
from walop_jax.likelihood import engine
from walop_jax.likelihood.chunks import Chunks, bytes_per_point
from walop_jax.likelihood.observing import ObservingPlan, polariser_turn
from walop_jax.likelihood.problem import LARGE_CHUNK, Problem, base_model
from walop_jax.likelihood.simulate import simulate

EXPOSURES, ELECTRONS, READ_NOISE = 25, 1e6, 30.0
WHOLE_FRAME = 4096**2
RUN = ObservingPlan(
    grid=12, standard_grid=1, standards=0, unpolarised=0, moon_patches=0,
    polariser_angles=polariser_turn(EXPOSURES, full_turn=True),
)  # fmt: skip


class Made(Intensities):
    """Counts of an instrument at the points of a set, made when asked for; noise from a pool of 4096 points."""

    def __init__(self, blank: CalibrationSet, truth):
        self.blank, self.truth = blank, truth
        self.problem = Problem(blank, base_model(blank), interpolate=True)
        self.nodes = self.problem.nodes(truth)
        self.chunks = Chunks(blank, self.problem.plan, LARGE_CHUNK)
        pool = np.random.default_rng(0).standard_normal((4096, EXPOSURES, 4))
        self.pool = pool / np.sqrt(np.mean(pool**2))  # or χ² would scatter as that of 4096 points

    def block(self, start, stop):
        n = stop - start
        x, y = self.blank.points.x[start:stop], self.blank.points.y[start:stop]
        used, none = np.ones((n, EXPOSURES), bool), np.full((n, EXPOSURES), -1)
        counts = np.empty((n, EXPOSURES, 4))
        for first in range(0, n, LARGE_CHUNK):
            inside = np.minimum(np.arange(first, first + LARGE_CHUNK), n - 1)
            ones = np.ones((LARGE_CHUNK, EXPOSURES, 4))
            data = self.chunks.point_data(Block(x[inside], y[inside], ones, ones, used[inside], none[inside]))
            unit = engine.prediction(self.truth, self.problem.plan, data, self.nodes)
            counts[first : first + LARGE_CHUNK] = np.asarray(unit)[: n - first]
        counts *= 4.0 * ELECTRONS
        sigma = np.sqrt(counts + READ_NOISE**2)
        counts += sigma * self.pool[np.arange(start, stop) % len(self.pool)]
        return Block(x, y, counts, sigma, used, none)

    @property
    def rows(self):
        return len(self.blank.points) * EXPOSURES


def raster(side: int) -> Grid:
    step = 2 * RUN.field / (side - 1)
    return Grid(side, side, (1.0, 1.0), (-RUN.field, -RUN.field), ((step, 0.0), (0.0, step)))


def made(side: int) -> CalibrationSet:
    simulated = simulate(RUN, seed=3)
    blank = dataclasses.replace(simulated.calset, points=raster(side).points)
    return dataclasses.replace(blank, intensities=Made(blank, simulated.truth))


def peak() -> float:
    """Largest memory of this process so far, in GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def seconds(work) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def test_counts_made_in_slabs_are_those_of_the_instrument():
    """What the table is made with: the truth explains it."""
    calset = made(20)
    problem = Problem(calset, base_model(calset), points_per_chunk=100)
    truth = np.concatenate([np.ravel(v) for v in jax.tree.leaves(simulate(RUN, seed=3).truth)])
    chi2, dof = problem.expand(truth).data, 3 * 400 * EXPOSURES
    assert abs(chi2 - dof) < 5 * np.sqrt(2 * dof)
    again = calset.intensities.block(130, 150)
    np.testing.assert_allclose(again.counts, calset.intensities.block(0, 400).counts[130:150], rtol=1e-12)


@pytest.mark.benchmark
def test_cost_per_iteration():
    rows = []
    for side in (12, 120, 1000):
        calset = made(side)
        problem = Problem(calset, base_model(calset))
        values = problem.model.start
        problem.expand(values)  # compiles; fills the memory where the set is kept
        data = seconds(lambda problem=problem: [None for _ in problem.chunks])
        full = seconds(lambda problem=problem, values=values: problem.expand(values))
        sketch = full
        if problem.interpolates:
            problem.expand(values, sketch=True)
            sketch = seconds(lambda problem=problem, values=values: problem.expand(values, sketch=True))
        rows.append((side**2, data, sketch, full, peak()))
        print(
            f"\n{side**2:>9,} points: data {data:8.3f} s, step {sketch:8.3f} s, in full {full:8.3f} s "
            f"({side**2 / full:9,.0f} points/s), error of the optics {problem.optics_error:.0e}, peak {peak():.2f} GB",
            end="",
        )
    began = time.perf_counter()
    result = fit(Problem(calset, base_model(calset)))
    whole = time.perf_counter() - began
    steps = result.minimum.steps + 1
    n, data, sketch, full, _ = rows[-1]
    factor = WHOLE_FRAME / n
    print(
        f"\nrefit of {n:,} points: {whole:.0f} s, {steps} steps and one in full, χ²/dof {result.chi2 / result.dof:.4f}"
    )
    print(
        f"{WHOLE_FRAME:,} points, extrapolated: a step {sketch * factor:.0f} s (of it data {data * factor:.0f} s), "
        f"in full {full * factor:.0f} s, refit {whole * factor / 60:.1f} min"
    )
    assert result.converged
    assert peak() < 4.0
    # Linear in the points, once there are many.
    assert full / n < 2.0 * rows[1][3] / rows[1][0] + data / n


@pytest.mark.benchmark
def test_work_per_point():
    """Floating-point operations and bytes that the compiled code counts, and the rate at which it does them."""
    calset = made(32)
    problem = Problem(calset, base_model(calset), points_per_chunk=engine.LARGEST_BLOCK, interpolate=True)
    instrument = problem.model.instrument()
    arguments = (instrument, problem.plan, problem.chunks[0], problem.nodes(instrument))
    for label, function in (("in full", engine.normal_equations), ("step", engine.sketched_equations)):
        cost = jax.jit(function.__wrapped__).lower(*arguments).compile().cost_analysis()
        jax.block_until_ready(function(*arguments))
        best = min(seconds(lambda f=function: jax.block_until_ready(f(*arguments))) for _ in range(5))
        n = engine.LARGEST_BLOCK
        print(
            f"\n{label}: {cost['flops'] / n / 1e3:.0f} kflop and {cost['bytes accessed'] / n / 1e3:.0f} kB a point; "
            f"{1e6 * best / n:.1f} µs, {cost['flops'] / best / 1e9:.1f} Gflop/s, "
            f"{cost['bytes accessed'] / best / 1e9:.1f} GB/s",
            end="",
        )


@pytest.mark.benchmark
def test_reading_frames(tmp_path):
    side = 512
    write_frames(tmp_path / "frames.fits", made(side), raster(side))
    calset = read_calibration_set(tmp_path / "frames.fits")
    each = bytes_per_point(EXPOSURES)
    problem = Problem(calset, base_model(calset))
    problem.chunks.kept = False
    raw = seconds(lambda: [None for _ in slabs(calset, (1 << 26) // each)])
    ready = seconds(lambda: [None for _ in problem.chunks])
    print(
        f"\nframes: {side**2 / raw:,.0f} points/s read, {side**2 / ready:,.0f} points/s ready for the engine"
    )

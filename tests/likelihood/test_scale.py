"""What a pass costs in time and memory, from a table of 144 points to whole frames.

    OMP_NUM_THREADS=1 python -m pytest tests/likelihood/test_scale.py --benchmark -s

prints the tables. Points lie on a square raster, 25 exposures of the polariser, four cameras; counts are made slab by
slab when they are asked for, never stored whole. Reading such slabs from FITS is timed on its own.

Two cores, nothing else running, one thread for BLAS, warm:

      points      data     gradient   with the matrix   peak
         144                 0.036 s       0.036 s      0.65 GB   optics solved at every point
      14 400     0.01 s      0.15  s       0.31  s      0.71 GB   kept in memory
   1 000 000     3.2  s      4.7   s      10.7   s      1.55 GB

Points that are no pixels of frames. One million on one core take 35 s, on two in two threads 26 s.
Frames of 4096 × 4096 pixels, 11 exposures, are read as cells in 42 s of one core, and fitted in 7 s more (0.5 GB).

The compiled code does 276 kflop and 381 kB a point with the matrix (14.8 µs of one core: 19 Gflop/s, 26 GB/s), 29 kflop
and 47 kB for a gradient (4.1 µs: 7 Gflop/s, 12 GB/s); bytes are as the compiler counts them, caches or not. Reading
takes 3.3 µs of one core, so that a gradient waits for its data as long as it computes.
"""

from __future__ import annotations

import dataclasses
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frame_run import raster
from frames_file import write_frames

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import analysis_vectors
from walop_jax.calibration.residual_map import residual_map
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import Block, CalibrationSet, Intensities
from walop_jax.data.settings import Settings
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood import engine
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.compiled import compiled
from walop_jax.model.light import instrument_matrix
from walop_jax.model.parameters import values_of
from walop_jax.model.planning import plan_for_settings
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

EXPOSURES, ELECTRONS, READ_NOISE = 25, 1e6, 30.0
TILE = 1024
PREDICTION = compiled(
    jax.vmap(engine.point_prediction, (None, None, 0, None))
)  # with optics on nodes of the field
RUN = ObservingPlan(
    grid=12, standard_grid=1, standards=0, unpolarised=0, moon_patches=0,
    polariser_angles=polariser_turn(EXPOSURES, full_turn=True),
)  # fmt: skip


class Made(Intensities):
    """Counts of an instrument at the points of a set, made when asked for; noise is drawn anew for every point.

    The noise of `TILE` points has a seed of its own: it does not depend on how the points are asked for. Errors are
    those of the expected counts, or of the measured ones where `from_counts`.
    """

    def __init__(self, blank: CalibrationSet, truth, electrons=ELECTRONS, *, from_counts=False):
        self.blank, self.truth, self.electrons, self.from_counts = blank, truth, electrons, from_counts
        degree = truth.throughput.degree
        self.likelihood = Likelihood.of(blank, base_model(blank, throughput_degree=degree), interpolate=True)
        self.nodes, _ = self.likelihood.nodes(truth)
        shape = (TILE, EXPOSURES)
        first = Block(
            np.zeros(TILE), np.zeros(TILE), np.ones((*shape, 4)), np.ones((*shape, 4)), np.ones(shape, bool),
            np.full(shape, -1),
        )  # fmt: skip
        self.data = self.likelihood.points.reader.point_data(first)

    def block(self, start, stop):
        tiles = range(start // TILE, -(-stop // TILE))
        parts = [self.tile(n) for n in tiles]
        here = slice(start - tiles[0] * TILE, stop - tiles[0] * TILE)
        counts, sigma = (np.concatenate([part[i] for part in parts])[here] for i in (0, 1))
        points, shape = self.blank.points, (stop - start, EXPOSURES)
        return Block(
            points.x[start:stop],
            points.y[start:stop],
            counts,
            sigma,
            np.ones(shape, bool),
            np.full(shape, -1),
        )

    def tile(self, number):
        inside = np.minimum(np.arange(number * TILE, (number + 1) * TILE), len(self.blank.points) - 1)
        data = self.data._replace(x=self.blank.points.x[inside], y=self.blank.points.y[inside])
        unit = np.asarray(PREDICTION(self.truth, self.likelihood.plan, data, self.nodes))
        counts = 4.0 * self.electrons * unit
        sigma = np.sqrt(counts + READ_NOISE**2)
        random = np.random.Generator(np.random.SFC64([number, 7]))
        counts += sigma * random.standard_normal(counts.shape, np.float32)
        return counts, np.sqrt(np.maximum(counts, 0.0) + READ_NOISE**2) if self.from_counts else sigma

    @property
    def rows(self):
        return len(self.blank.points) * EXPOSURES


def made(side: int, plan: ObservingPlan = RUN, *, from_counts: bool = False) -> CalibrationSet:
    simulated = simulate(plan, seed=3)
    blank = dataclasses.replace(simulated.calset, points=raster(RUN, side).points)
    return dataclasses.replace(
        blank, intensities=Made(blank, simulated.truth, plan.electrons, from_counts=from_counts)
    )


def peak() -> float:
    """Largest memory of this process so far, in GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def seconds(work) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


@pytest.mark.long  # of what only the timings below are made with
def test_counts_made_in_slabs_are_those_of_the_instrument():
    """What the table is made with: the truth explains it."""
    calset = made(20)
    likelihood = Likelihood.of(calset, base_model(calset), batch=100)
    truth = np.asarray(values_of(simulate(RUN, seed=3).truth))
    chi2, dof = likelihood.expand(truth).data, 3 * 400 * EXPOSURES
    assert abs(chi2 - dof) < 5 * np.sqrt(2 * dof)
    again = calset.intensities.block(130, 150)
    np.testing.assert_allclose(again.counts, calset.intensities.block(0, 400).counts[130:150], rtol=1e-12)


@pytest.mark.benchmark
def test_cost_per_iteration():
    rows = []
    for side in (12, 120, 1000):
        calset = made(side)
        likelihood = Likelihood.of(calset, base_model(calset))
        values = likelihood.model.start
        near = likelihood.expand(values)  # compiles; fills the memory where the set is kept
        data = seconds(lambda likelihood=likelihood: dataclasses.replace(likelihood).used_data)
        full = seconds(lambda likelihood=likelihood, values=values: likelihood.expand(values))
        rows.append((side**2, data, full))
        print(
            f"\n{side**2:>9,} points: data {data:8.3f} s, all {full:8.3f} s "
            f"({side**2 / full:9,.0f} points/s), error of the optics {near.optics.error:.0e}, peak {peak():.2f} GB",
            end="",
        )
    # Linear in the points, once there are many.
    n, data, full = rows[-1]
    assert (full - data) / n < 2.0 * rows[1][2] / rows[1][0]


@pytest.mark.benchmark
@pytest.mark.parametrize("side", [1024, 4096])
def test_whole_frames(tmp_path, side):
    """Frames on disk: read as cells, and fitted. Writing those of 4096 × 4096 takes ten minutes."""
    path = tmp_path / "frames.fits"
    write_frames(path, made(side), raster(RUN, side))
    began = time.perf_counter()
    calset = read_calibration_set(path)
    read = time.perf_counter() - began
    result = fit(Likelihood.of(calset, base_model(calset)))
    fitted = time.perf_counter() - began
    residuals = residual_map(result)
    whole = time.perf_counter() - began
    truth = np.asarray(values_of(simulate(RUN, seed=3).truth))
    known = result.sigma > 0
    pulls = (result.values - truth)[known] / result.sigma[known]
    print(
        f"\n{side**2:,} pixels: read {read:.1f} s, fitted {fitted:.1f} s, {result.minimum.steps} steps; "
        f"with the residual map {whole:.1f} s, peak {peak():.2f} GB; χ²/dof "
        f"{result.chi2 / result.dof:.5f}, {result.minimum.message}; residual map {residuals.significance():+.1f} "
        f"standard deviations above noise; pulls of the parameters: rms {np.sqrt(np.mean(pulls**2)):.2f}"
    )
    assert result.converged
    assert peak() < 2.0
    assert whole < 600.0


def matrix_error(calset, truth, result) -> tuple[float, float]:
    """Rms error of the elements of the matrix at places between the points, and what the covariance expects."""
    x, y = (part.ravel() for part in np.meshgrid(*[np.linspace(-0.23, 0.23, 11)] * 2))
    calibration = Calibration.from_fit(result.with_verdict())
    found, covariance = calibration.matrix(x, y)
    plan = plan_for_settings(truth, Settings.default(1), calset.filters)
    exact = instrument_matrix(jnp.asarray(analysis_vectors(truth, plan, x, y)[:, 0]), truth.cameras.pairs)
    error = found - np.asarray(exact).reshape(len(x), 6)
    return float(np.sqrt(np.mean(error**2))), float(
        np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2) / 6))
    )


@pytest.mark.benchmark
def test_errors_fall_with_the_points():
    """As 1/√N where the model can be the truth; to a limit where it cannot, or where the errors know the noise.

    10⁴ electrons, so that limits come within reach: errors that an observer takes from measured counts give more
    weight to counts that came out low, which makes all of them one electron too small, here 10⁻⁴.
    """
    print(
        "\n   points  rms error   expected   errors from counts   fifth and sixth order of the throughput lacking"
    )
    rows = []
    for side in (12, 48, 192, 384):
        row = []
        for degree, from_counts in ((4, False), (4, True), (6, False)):
            plan = dataclasses.replace(RUN, throughput_degree=degree, electrons=1e4)
            calset = made(side, plan, from_counts=from_counts)
            result = fit(Likelihood.of(calset, base_model(calset, throughput_degree=4)))
            row.append(
                (*matrix_error(calset, simulate(plan, seed=3).truth, result), result.chi2 / result.dof)
            )
        (error, expected, _), (biased, *_), (lacking, _, ratio) = row
        rows.append((side**2, error, expected, biased, lacking))
        print(
            f"{side**2:9,} {100 * error:9.5f} % {100 * expected:8.5f} % {100 * biased:14.5f} % "
            f"{100 * lacking:14.5f} % (χ²/dof {ratio:.3f})",
            flush=True,
        )
    for n, error, expected, *_ in rows:
        assert 0.5 < error / expected < 2.0, n
    (n, _, expected, *_), *_, (many, _, last, biased, lacking) = rows
    assert expected / last == pytest.approx(np.sqrt(many / n), rel=0.2)
    assert biased > 3 * last
    assert lacking > 3 * last


@pytest.mark.benchmark
def test_work_per_point():
    """Floating-point operations and bytes that the compiled code counts, and the rate at which it does them."""
    calset = made(32)
    likelihood = Likelihood.of(calset, base_model(calset), batch=256, interpolate=True)
    instrument = likelihood.model.instrument()
    arguments = (instrument, likelihood.plan, next(iter(likelihood.points)), likelihood.nodes(instrument)[0])
    function, n = engine._table_equations, 256
    cost = jax.jit(function.__wrapped__).lower(*arguments).compile().cost_analysis()
    jax.block_until_ready(function(*arguments))
    best = min(seconds(lambda: jax.block_until_ready(function(*arguments))) for _ in range(5))
    print(
        f"\n{cost['flops'] / n / 1e3:.0f} kflop and {cost['bytes accessed'] / n / 1e3:.0f} kB a point; "
        f"{1e6 * best / n:.1f} µs, {cost['flops'] / best / 1e9:.1f} Gflop/s, "
        f"{cost['bytes accessed'] / best / 1e9:.1f} GB/s",
        end="",
    )

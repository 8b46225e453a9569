"""The laboratory table of Paper II (section 4) on a simulated bench: five tilts of one half-wave plate.

Each tilt is an instrument of its own for the paper's polynomial; the joint model sees one plate, tilted. Sources with
p ≤ 5 % test both. The paper's sources were themselves known to 0.03 %, and its bench is not a simulation: its numbers
are an upper bound for what photon noise alone does here.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import walop_jax as walop
from walop_jax import Calibration, FitResult, Instrument, Likelihood, ObservingPlan, Settings

TILTS = (12.0, 14.0, 16.0, 18.0, 20.0)
PAPER_CROSS_TALK = (0.16, 0.27, 0.43, 0.62, 0.81)
PAPER_ERRORS = (
    (3e-4, 9e-4, 4e-4),
    (4e-4, 14e-4, 8e-4),
    (4e-4, 16e-4, 7e-4),
    (4e-4, 17e-4, 7e-4),
    (3e-4, 29e-4, 13e-4),
)
"""Accuracies of q, u and p at the five tilts, Paper II, table of the laboratory tests."""


_ABSENT = ("collimator", "pupil", "half1.wedge", "half2.wedge")  # a bench has no lenses and no wedges


class BenchRow(NamedTuple):
    """One tilt (deg): cross-talk from q into u_m; errors of (q, u, p), rms over the sources."""

    tilt: float
    cross_talk: float
    paper_published: tuple[float, ...]
    paper_here: tuple[float, ...]
    joint: tuple[float, ...]


def bench_table(seed: int = 0, electrons: float = 1e6) -> list[BenchRow]:
    """Simulate the bench at the five tilts, calibrate it both ways, and test with 100 sources.

    `electrons` is the level of a camera in every one of 15 polariser exposures.
    """
    plan = dataclasses.replace(ObservingPlan.bench(11), electrons=electrons)  # 0, 2, … 20 deg
    truth = _as_built(np.random.default_rng([seed, 1]))
    run = walop.simulate(plan, seed=seed, instrument=truth)
    model = walop.base_model(run.calset, throughput_degree=0)
    for p in model.parameters:
        if p.part in _ABSENT:
            model = model.change(p.name, free=False)
    fitted = Calibration.from_fit(FitResult.of(Likelihood.of(run.calset, model)).with_verdict())
    true = dataclasses.replace(fitted, values=np.array([run.values[n] for n in model.names]))
    x, y = np.array(TILTS), np.full(len(TILTS), run.calset.points.y[0])
    settings = dataclasses.replace(Settings.default(1), teff=np.array([plan.teff]))
    matrix = true.matrix(x, y, settings)[0]
    errors = walop.compare(run.calset, fitted, truth=(x, y, matrix)).between
    cross_talk, paper, ours = matrix[:, 4], errors.paper, errors.joint  # m32
    rows = zip(TILTS, cross_talk.tolist(), PAPER_ERRORS, paper.tolist(), ours.tolist(), strict=True)
    return [BenchRow(t, c, published, tuple(p), tuple(j)) for t, c, published, p, j in rows]


def _as_built(rng: np.random.Generator) -> Instrument:
    """A bench as it might be: plates off by 0.1 µm, cameras that differ by some per cent, nothing else.

    (A plate of zero order that is off by 1 µm has 7° of retardance too much.)
    """
    nominal = ObservingPlan.bench().design
    throughput = 0.5 + 0.03 * rng.standard_normal((4, 1))
    for arm in nominal.arms:
        off = 0.1 * rng.standard_normal()
        nominal = nominal.changed(f"{arm.name}.plate.mgf2", thickness=lambda d, off=off: d + off)
    series = dataclasses.replace(nominal.throughput, degree=0, coefficients=jnp.asarray(throughput))
    return dataclasses.replace(nominal, throughput=series)

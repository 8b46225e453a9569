"""A year of a simulated instrument, for the notebook: what happens to it, and the sets of its nights."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import numpy as np
from jax import Array

import walop_jax as walop

PLAN = walop.ObservingPlan(
    grid=5, standard_grid=2, polariser_angles=tuple(22.5 * np.arange(8)), moon_patches=3, standards=3
)
NIGHTS = 24  # fifteen days apart
REMOUNT, BAD = 15, 8  # a half-wave plate is turned before the one; the telescope polarises in the other
TURN, SMOKE = 0.06, 3e-3  # deg; Stokes u
RATE = 2e-4  # of the throughput of camera N1, per √day


def nights(seed: int = 3) -> Iterator[walop.CalibrationSet]:
    """The calibration sets of a year, night by night."""
    rng = np.random.default_rng(seed)
    truth, walk = walop.simulate(PLAN, seed=seed).truth, 0.0
    for k in range(NIGHTS):
        hidden = {
            "hwp1_axis": {"angle": TURN * (k >= REMOUNT)},
            "telescope_polarisation": {"u": SMOKE * (k == BAD)},
        }
        effects = [walop.effect_by_name(name).of(PLAN.context(), **values) for name, values in hidden.items()]
        now = eqx.tree_at(lambda i: i.throughput.coefficients, truth, _walked(truth, walk))
        made = walop.simulate(
            dataclasses.replace(PLAN, mjd=PLAN.start + 15.0 * k),
            seed=seed + k,
            instrument=now,
            effect=effects,
            catalogue_seed=seed,
        )
        yield dataclasses.replace(made.calset, origin=f"night {k}")
        walk += RATE * np.sqrt(15.0) * rng.normal()


def _walked(truth: walop.Instrument, walk: float) -> Array:
    """The throughputs with that of camera N1 changed."""
    return truth.throughput.coefficients.at[1, 0].add(walk)

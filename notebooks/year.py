"""A year of a simulated instrument, for the notebook: what happens to it, and the sets of its nights."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

import walop_jax as walop
from walop_jax.model.specification import effect_context, make_model, with_effects
from walop_jax.simulation.observing_plan import polariser_turn
from walop_jax.simulation.simulate import simulate

PLAN = walop.ObservingPlan(
    grid=5, standard_grid=2, polariser_angles=polariser_turn(8), moon_patches=3, standards=3
)
NIGHTS = 24  # fifteen days apart
REMOUNT, BAD = 15, 8  # a half-wave plate is turned before the one; the telescope polarises in the other
TURN, SMOKE = 0.06, 3e-3  # deg; Stokes u
RATE = 2e-4  # of the throughput of camera N1, per √day


def nights(seed: int = 3) -> Iterator[walop.CalibrationSet]:
    """The calibration sets of a year, night by night."""
    rng = np.random.default_rng(seed)
    first = simulate(PLAN, seed=seed)
    context = effect_context(first.truth, first.calset.exposures)
    effects = [
        walop.effect_by_name(name).neutral(context) for name in ("hwp1_axis", "telescope_polarisation")
    ]
    model = with_effects(make_model(PLAN.name, first.truth), effects, context)
    values, walk = model.start, 0.0
    for k in range(NIGHTS):
        now = values.copy()
        now[model.index("throughput.n1.p00")] += walk
        now[model.index("hwp1_axis.angle")] += TURN * (k >= REMOUNT)
        now[model.index("telescope_polarisation.u")] += SMOKE * (k == BAD)
        plan = dataclasses.replace(PLAN, mjd=PLAN.start + 15.0 * k)
        made = simulate(plan, seed=seed + k, instrument=model.instrument(now), catalogue_seed=seed).calset
        yield dataclasses.replace(made, origin=f"night {k}")
        walk += RATE * np.sqrt(15.0) * rng.normal()

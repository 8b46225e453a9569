"""Exposures in which every effect shows, at a few field points; counts with and without an effect."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import builders
import jax
import jax.numpy as jnp
import numpy as np

from walop_jax.data.records import FilterCurve, Sources
from walop_jax.likelihood import engine
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan, with_median
from walop_jax.model.planning import plan_for

FLUX = 4e5
X, Y = np.array([0.21, -0.13]), np.array([-0.17, -0.08])
STARS = (("blue_star", 0.04, -0.02), ("red_star", -0.01, 0.03))
FILTERS = {
    "band": FilterCurve("band", np.array([0.59, 0.62, 0.65]), np.array([1.0, 1.0, 1.0])),
    "line": FilterCurve("line", np.array([0.61]), np.array([1.0])),
}
EXPOSURES = builders.exposures(
    {"clp_angle": 10.0, "ha": -2.0, "temp": 4.0},
    {"clp_angle": 55.0, "filter": "line", "mjd": 61043.95},
    {"clp_angle": 100.0, "chwp_angle": 0.0, "filter": "line"},
    {"clp_angle": 145.0, "chwp_angle": 45.0, "filter": "line"},
    {"kind": "moon", "rotator": 20.0, "filter": "line", "mjd": 61044.0},
    {"kind": "moon", "rotator": 70.0, "filter": "line"},
    {"kind": "standard", "rotator": 40.0, "filter": "line"},
    {"kind": "standard", "rotator": -15.0, "filter": "line"},
    {"kind": "flux", "filter": "line"},
)
CONTEXT = Context(exposures=9, moon=(4, 5), moon_ids=(4, 5), sources=tuple(s[0] for s in STARS))
MEDIAN = np.full((9, 4), 2e5) * np.array([1.0, 1.1, 0.9, 1.2])
SOURCE = np.array([-1] * 6 + [0, 1, -1])
SKY = np.array([[0.10, 0.02], [-0.05, 0.08]])


def plan(effects: Sequence[Effect] = (), exposures=EXPOSURES, filters=FILTERS) -> Plan:
    nan = np.full(2, np.nan)
    stars = Sources(np.arange(2), np.array([s[0] for s in STARS]), nan, nan, nan, nan, nan)
    return with_median(plan_for(instrument(*effects), exposures, filters, stars), MEDIAN)


def points(plan: Plan, x=X, y=Y) -> engine.PointData:
    """Point data without counts: polarised Moon sky, two stars, everything else extended."""
    n, e = len(x), len(SOURCE)
    sky = np.zeros((n, e, 2))
    sky[:, 4:6] = SKY + 0.01 * np.asarray(x)[:, None, None]
    source = np.broadcast_to(SOURCE, (n, e))
    return engine.PointData(
        x=jnp.asarray(x), y=jnp.asarray(y), counts=jnp.zeros((n, e, 4)), weight=jnp.ones((n, e, 4)),
        sky=jnp.asarray(sky), source=jnp.asarray(source),
        band=jnp.asarray(plan.band_of[np.arange(e), SOURCE + 1][None].repeat(n, 0)),
        opposite_sky=jnp.asarray(sky),
    )  # fmt: skip


BASE = builders.south(np.random.default_rng(5), standards=STARS)


def instrument(*effects: Effect) -> Instrument:
    """An instrument as built, not as designed, with effects."""
    return dataclasses.replace(BASE, effects=effects)


def counts(instrument: Instrument, plan: Plan, data: engine.PointData) -> jax.Array:
    """Electrons that the cameras report for light of flux `FLUX`; not compiled."""
    unit = engine.prediction.__wrapped__(instrument, plan, data)
    return engine.detected.__wrapped__(instrument, plan.exposures, FLUX * unit)


def observe(*effects: Effect, plan_of: Sequence[Effect] | None = None) -> np.ndarray:
    """Counts (point, exposure, camera) of the scene with some effects active."""
    layout = plan(effects if plan_of is None else plan_of)
    device = instrument(*effects)
    data = points(layout)
    return np.asarray(
        engine.detected(device, layout.exposures, FLUX * engine.prediction(device, layout, data))
    )

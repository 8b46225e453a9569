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
from walop_jax.model.effects.optics import AXES
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
# Every kind of change, every factor that the scene can show, every side of a place.
EVERY_CHANGE = (
    *(f"{kind} {axis} behind collimator" for kind in ("retardance", "diattenuation") for axis in AXES),
    "depolarisation behind collimator",
    "turn of polariser * x",
    "turn ahead of half1.plate * y",
    "turn of polariser * x2-y2 * sin 1 CLP",
    "depolarisation of polariser * cos 2 CLP",
    "diattenuation v of polariser * xy",
    "retardance radial of polariser",
    "retardance u of chwp * cos 2 CHWP",
    "depolarisation behind chwp * kelvin",
    "depolarisation q behind collimator * x",
    "depolarisation u of polariser",
    "depolarisation v of chwp * cos 2 CHWP",
    "retardance v ahead of half2.plate * hours",
    "diattenuation diagonal ahead of half1.plate * colour",
    "added polarisation q ahead of polariser",
    "added polarisation u behind collimator",
    "diattenuation q ahead of polariser * r2",
    "displacement x ahead of pupil * hour angle",
    "displacement y ahead of pupil",
    "fringes of half1.plate * gap 2.5",
    "shift of band",
    "rotator of sky",
    "degree of standard",
    "extinction of polariser",
    "ellipticity of polariser",
    "axis of half2.plate",
    "axis of half1.plate.mgf2",
    "cut of half1.plate.quartz",
    "thickness of half2.plate.mgf2",
    "thermal of half1.plate",
    "polarisation of sky",
    "polarisation q of sky * exposure 4",
    "polarisation u of blue_star",
    "gain of O1 * r2",
    "gain of half2 * ring 3",
    "gain of O2 * exposure 3",
    "gain of E2 * kind moon",
    "gain of E1 * hours 1 to 3",
    "gain of E2 * counts",
    "reported gain of O1 * hours",
    "light in E1 * hours",
    "light of E1 in O1",
    "light of E2 in O2 * r2",
    "light of O2 in E2 * hours * x",
    "light of opposite in O2",
    "afterglow in O1",
)
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
    return engine.detected.__wrapped__(instrument, plan.exposures, FLUX * unit, data.x, data.y)


def observe(*effects: Effect, plan_of: Sequence[Effect] | None = None) -> np.ndarray:
    """Counts (point, exposure, camera) of the scene with some effects active."""
    layout = plan(effects if plan_of is None else plan_of)
    device = instrument(*effects)
    data = points(layout)
    return np.asarray(
        engine.detected(
            device, layout.exposures, FLUX * engine.prediction(device, layout, data), data.x, data.y
        )
    )

"""Wavelength and colour: the spectral appendix of Paper II from a fitted model.

Efficiency  m22 … m33 in monochromatic light across the filter, at any field point.
Colour      Δq_m, Δu_m: the difference between the largest and the smallest (q_m, u_m) that stars of equal
            polarisation and different temperature show, the worst case over their position angles.
Retardance  of the wave plates, as the rays of the field meet them.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import analysis_vectors
from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import DEFAULT_FILTER, Settings
from walop_jax.model import fold, light
from walop_jax.model.compiled import compiled
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.ray import Ray
from walop_jax.paper.polynomial import measured_qu, transmitted

TEMPERATURES = (3500.0, 5000.0, 7000.0, 10000.0)
"""Four stars (K); Paper II names no temperatures, but finds the largest differences below 4000 K."""
DEGREE, ANGLES = 0.01, 36
NEGLIGIBLE, GOAL = 1e-4, 5e-4
"""Below 0.01 % a difference is of no matter; 0.05 % is the sensitivity that the survey asks for."""


def efficiencies(
    calibration: Calibration, x: float, y: float, wavelength: Float[np.ndarray, " w"]
) -> Float[np.ndarray, "w 2 3"]:
    """Instrument matrix (wavelength, q_m or u_m, 1 q u) in monochromatic light (µm) at a field point (deg)."""
    instrument = calibration.model.instrument(calibration.values)
    plan = _monochromatic(instrument, wavelength)
    a = analysis_vectors(instrument, plan, np.array([x]), np.array([y]))[0][np.asarray(plan.band_of)[:, 0]]
    rows = [(a[:, i] - a[:, i + 1]) / (a[:, i] + a[:, i + 1])[:, :1] for i in (0, 2)]
    return np.stack(rows, axis=1)[..., :3]


def _monochromatic(instrument: Instrument, wavelength: Float[np.ndarray, " w"]) -> Plan:
    """Plan of a computation in monochromatic light of each wavelength (µm)."""
    names = [f"line {k:05d}" for k in range(len(wavelength))]
    curves = {n: FilterCurve(n, np.array([w]), np.ones(1)) for n, w in zip(names, wavelength, strict=True)}
    settings = dataclasses.replace(Settings.default(len(names)), filter=np.array(names))
    return plan_for_settings(instrument, settings, curves)


def colour_spread(
    calibration: Calibration,
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
    temperatures: tuple[float, ...] = TEMPERATURES,
    filter_name: str = DEFAULT_FILTER,
) -> Float[np.ndarray, "p 2"]:
    """Δq_m, Δu_m at every point between stars of the given temperatures (K), largest over position angles."""
    angle = np.arange(ANGLES) * np.pi / ANGLES
    stars = DEGREE * np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=1)
    vectors = AnalysisVectors(calibration).exact(Settings.default(1, filter_name), x, y, temperatures)
    measured = np.stack([measured_qu(transmitted(vectors[:, k], stars)) for k in range(len(temperatures))])
    return np.ptp(measured, axis=0).max(axis=1)


def spread_document(spread: Float[np.ndarray, "p 2"]) -> dict[str, Any]:
    """Median and maximum in per cent, and the fractions of the field below 0.01 % and 0.05 %."""
    document = {}
    for name, values in zip("qu", spread.T, strict=True):
        shares = {"share_negligible": values < NEGLIGIBLE, "share_below_sensitivity": values < GOAL}
        sizes = {"median": 100.0 * float(np.median(values)), "max": 100.0 * float(values.max())}
        document[name] = sizes | {key: float(np.mean(below)) for key, below in shares.items()}
    return document


def plate_names(instrument: Instrument) -> tuple[str, ...]:
    """Names of the wave plates in the arms, in the order of the arms."""
    named = ((arm.name, element) for arm in instrument.arms for element in arm.train())
    return tuple(f"{arm}.{element.name}" for arm, element in named if isinstance(element, WavePlate))


def _plates(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> Float[Array, "w n 4 4"]:
    ray = Ray.entering(x, y, (light.node_wavelengths(instrument, plan), plan.conditions))
    arms = fold.Fold.of(instrument.behind_polariser(), instrument.arms, ray, plan.moving, plan.positions).arms
    stations = [station for arm in arms for station in arm if isinstance(station[0], WavePlate)]
    return jnp.stack([jnp.asarray(element.mueller(ray_at)) for element, ray_at in stations])


_all_plates = compiled(jax.vmap(_plates, in_axes=(None, None, 0, 0)))


def retardance(mueller: Float[np.ndarray, "*s 4 4"], axis: Float[np.ndarray, 2]) -> Float[np.ndarray, "*s"]:
    """Retardance (deg, 0 to 360) of nearly pure retarders about `axis` (cos 2α, sin 2α).

    From the rotation of (q, u, v): its trace is 1 + 2 cos δ, its antisymmetric part sin δ along the axis.
    """
    r = mueller[..., 1:, 1:] / mueller[..., :1, :1]
    cosine = 0.5 * (np.trace(r, axis1=-2, axis2=-1) - 1.0)
    turn = 0.5 * np.stack([r[..., 1, 2] - r[..., 2, 1], r[..., 2, 0] - r[..., 0, 2]], axis=-1)
    size = np.sqrt(np.sum(turn**2, axis=-1) + 0.25 * (r[..., 0, 1] - r[..., 1, 0]) ** 2)
    sine = np.where(turn @ axis < 0, -size, size)
    return np.asarray(np.mod(np.rad2deg(np.arctan2(sine, cosine)), 360.0))


def plate_retardances(
    instrument: Instrument,
    wavelength: Float[np.ndarray, " l"],
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
) -> Float[np.ndarray, "w p l"]:
    """Retardance (deg, modulo 360) about the first optic axis of every plate of `plate_names` at wavelengths (µm,
    ascending) and field positions."""
    patched = instrument.patched()
    plan = _monochromatic(patched, wavelength)
    mueller = np.asarray(_all_plates(patched, plan, jnp.asarray(x), jnp.asarray(y)))
    plates = [e for arm in patched.arms for e in arm.train() if isinstance(e, WavePlate)]
    retardances = []
    for k, plate in enumerate(plates):
        angle = 2.0 * np.deg2rad(float(plate.axis) + float(plate.layers[0].axis))
        retardances.append(retardance(mueller[:, k], np.array([np.cos(angle), np.sin(angle)])))
    return np.stack(retardances)

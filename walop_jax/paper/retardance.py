"""Retardance of the wave plates of an instrument, as the rays of the field meet them."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.model import fold, light
from walop_jax.model.compiled import compiled
from walop_jax.model.elements import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for_settings

LINE = "line"


def plate_names(instrument: Instrument) -> tuple[str, ...]:
    """Names of the wave plates in the arms, in the order of the arms."""
    return tuple(
        f"{arm.name}.{element.name}"
        for arm in instrument.arms
        for element in arm.train()
        if isinstance(element, WavePlate)
    )


def _plates(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> Float[Array, "w n 4 4"]:
    ray = light.ray_at(instrument, plan, x, y)
    train = light.divided(instrument)
    _, ray = fold.stations((*train.leading, *train.banded), ray)
    arms = [fold.stations(tuple(arm.train()), ray)[0] for arm in instrument.arms]
    stations = [station for arm in arms for station in arm if isinstance(station[0], WavePlate)]
    return jnp.stack([jnp.asarray(element.mueller(there)) for element, there in stations])


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
    there = instrument.patched()
    names = [f"{LINE}{k:04d}" for k in range(len(wavelength))]
    curves = {n: FilterCurve(n, np.array([w]), np.ones(1)) for n, w in zip(names, wavelength, strict=True)}
    settings = dataclasses.replace(Settings.default(len(names)), filter=np.array(names))
    plan = plan_for_settings(there, settings, curves)
    mueller = np.asarray(_all_plates(there, plan, jnp.asarray(x), jnp.asarray(y)))
    plates = [e for arm in there.arms for e in arm.train() if isinstance(e, WavePlate)]
    found = []
    for k, plate in enumerate(plates):
        angle = 2.0 * np.deg2rad(float(plate.axis) + float(plate.layers[0].axis))
        found.append(retardance(mueller[:, k], np.array([np.cos(angle), np.sin(angle)])))
    return np.stack(found)

"""Gain of one camera that drifts with time.

Equation    N → N (1 + rate · t)
Symbols     t hours since the first exposure; rate [1/h]
Source      calibration contract, section 6; temperature of the readout electronics.
Neutral     rate = 0
Revealed by zero offsets of one half that change with time in every kind of exposure.
"""

from __future__ import annotations

from typing import ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.effects.base import CONTRACT, Context, Effect, ExposureArrays, Scalar, check_camera
from walop_jax.model.parameters import param


class CameraGainDrift(Effect):
    """Counts of one camera grow in proportion to time."""

    rate: Scalar = param(
        unit="1/h", about="relative change of the gain", source=CONTRACT, width=0.003, default=0.0
    )
    camera: int = eqx.field(static=True, default=0)

    name: ClassVar[str] = "camera_gain_drift"
    revealed_by: ClassVar[str] = "exposures of one kind spread over hours"
    separated_by: ClassVar[str] = (
        "polariser angles in random order: a drift then cannot look like a harmonic of the angle"
    )

    def __check_init__(self) -> None:
        check_camera(self, self.camera)

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Any one of the cameras."""
        return tuple((cls(camera=camera),) for camera in range(4))

    def detector(self, counts: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Scale the counts of the camera."""
        drift = 1.0 + self.rate * exposures.hours
        return counts * jnp.ones_like(counts).at[:, self.camera].set(drift)

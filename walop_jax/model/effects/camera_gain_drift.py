"""Gain of one camera that drifts with time.

Equation    N → N (1 + rate · t)
Symbols     t hours since the first exposure; rate [1/h]
Source      temperature of the readout electronics.
Neutral     rate = 0
Revealed by zero offsets of one half that change with time in every kind of exposure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.cameras import DetectorPart
from walop_jax.model.effects.base import Context, Effect, Scalar, check_camera
from walop_jax.model.parameters import param
from walop_jax.model.sources import ExposureArrays

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "temperature of readout electronics: expected size"


class GainDrift(DetectorPart):
    """Counts of one camera grow in proportion to time."""

    rate: Scalar
    camera: int = eqx.field(static=True)

    def reported(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """Scale the counts of the camera."""
        drift = 1.0 + self.rate * exposures.hours
        return counts * jnp.ones_like(counts).at[:, self.camera].set(drift)


class CameraGainDrift(Effect):
    """Gain of one camera that drifts with time."""

    rate: Scalar = param(
        unit="1/h", about="relative change of the gain", source=SOURCE, width=0.003, default=0.0
    )
    camera: int = eqx.field(static=True, default=0)

    name: ClassVar[str] = "camera_gain_drift"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "exposures of one kind spread over hours"
    separated_by: ClassVar[str] = (
        "polariser angles in random order: a drift then cannot look like a harmonic of the angle"
    )

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Any one of the cameras."""
        return tuple((cls(camera=camera),) for camera in range(context.cameras))

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """A gain of one camera."""
        return (f"gain of {instrument.cameras.names[self.camera]} * hours",)

    def patch(self, instrument: Instrument) -> Instrument:
        """Let the gain of the camera drift."""
        camera = check_camera(self, self.camera, instrument.cameras.names)
        return instrument.with_part("detectors", GainDrift(self.rate, camera))

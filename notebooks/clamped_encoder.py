"""Error of the polariser's encoder, three times per turn.

Equation    θ = CLP_ANGLE + amplitude · sin(3 CLP_ANGLE − phase)
Symbols     θ transmission axis in the ICS; amplitude [deg]; phase [rad]
Source      a code disc that its three screws bend; two reading heads on opposite sides see the same error
Neutral     amplitude = 0, whatever the phase
Revealed by side bands at one and five times the polariser angle
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from walop_jax.model.effects import Effect
from walop_jax.model.elements import EncoderError
from walop_jax.model.parameters import param

SOURCE = "notebook your_own_effect"


class ClampedEncoder(Effect):
    """Transmission axis = CLP_ANGLE + amplitude · sin(3 CLP_ANGLE − phase)."""

    amplitude: float = param(unit="deg", about="largest error", source=SOURCE, width=0.05, default=0.0)
    phase: float = param(unit="rad", about="phase", source=SOURCE, scale=0.3, loose=10.0, default=0.0)

    name: ClassVar[str] = "clamped_encoder"
    shape: ClassVar[tuple[str, ...]] = ("phase",)
    starts: ClassVar = (({"phase": 0.0}, {"phase": 0.5 * np.pi}),)
    revealed_by: ClassVar[str] = "polariser exposures at many angles over a full turn"
    separated_by: ClassVar[str] = (
        "the polariser turned in its mount: an error of the encoder stays with the encoder"
    )

    def patch(self, instrument):
        """Give the encoder an error three times per turn."""
        error = EncoderError(self.amplitude, self.phase, order=3)
        return instrument.changed("polariser", encoder=lambda errors: (*errors, error))

    @classmethod
    def combine(cls, group, amplitudes):
        """Amplitude and phase from the two linear directions."""
        sine, cosine = amplitudes
        return dataclasses.replace(group[0], amplitude=np.hypot(sine, cosine), phase=np.arctan2(cosine, sine))

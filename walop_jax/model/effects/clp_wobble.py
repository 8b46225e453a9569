"""Error of the polariser's encoder, once per turn.

Equation    θ = CLP_ANGLE + amplitude · sin(CLP_ANGLE − phase)
Symbols     θ transmission axis in the ICS; amplitude [deg]; phase [rad]
Source      An eccentric code disc reads wrong by e/r sin: 0.1° is 0.35 %
            of the intensity at worst.
Neutral     amplitude = 0, whatever the phase
Revealed by side bands at one and three times the polariser angle in the normalised intensities of all
            cameras.

Around neutral the effect is linear in amplitude · (cos phase, sin phase): two probes at phase 0 and π/2
span it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements import EncoderError
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "eccentric code disc of an encoder: expected size"


class ClpWobble(Effect):
    """Error of the polariser's encoder, once per turn."""

    amplitude: Scalar = param(unit="deg", about="largest error", source=SOURCE, width=0.1, default=0.0)
    phase: Scalar = param(
        unit="rad", about="encoder reading of no error", source=SOURCE, scale=0.3, loose=10.0, default=0.0
    )

    name: ClassVar[str] = "clp_wobble"
    said: ClassVar[tuple[str, ...]] = ("turn of polariser * cos 1 CLP", "turn of polariser * sin 1 CLP")
    reference: ClassVar[str] = SOURCE
    shape: ClassVar[tuple[str, ...]] = ("phase",)
    starts: ClassVar[tuple[tuple[Mapping[str, Any], ...], ...]] = (({"phase": 0.0}, {"phase": 0.5 * np.pi}),)
    revealed_by: ClassVar[str] = "polariser exposures at many angles, best over a full turn"
    separated_by: ClassVar[str] = (
        "polariser angles over 360° instead of 180°: an encoder error changes sign after half a turn, "
        "nothing that polarised light itself does can"
    )

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """Amplitude and phase from the two linear directions."""
        sine, cosine = amplitudes
        return dataclasses.replace(group[0], amplitude=np.hypot(sine, cosine), phase=np.arctan2(cosine, sine))

    def standard_form(self) -> Self:
        """Positive amplitude, phase in (−π, π]."""
        phase = float(self.phase) + (np.pi if float(self.amplitude) < 0 else 0.0)
        phase = float(np.angle(np.exp(1j * phase)))
        return dataclasses.replace(self, amplitude=jnp.abs(self.amplitude), phase=phase)

    def patch(self, instrument: Instrument) -> Instrument:
        """Give the encoder an error once per turn."""
        error = EncoderError(self.amplitude, self.phase)
        return instrument.changed("polariser", encoder=lambda errors: (*errors, error))

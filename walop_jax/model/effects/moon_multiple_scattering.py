"""Multiply scattered moonlight.

Equation    (q, u) → (q, u) − p · (q₁, u₁)/|(q₁, u₁)|
Symbols     (q₁, u₁) polarisation of single scattering, whose direction is kept; p what is missing of its
            degree
Source      light scattered twice splits the zero at the Moon into neutral
            points 10–20° from it (Berry, Dennis & Lee 2004, New J. Phys. 6, 162; Gál et al. 2001, JGR 106,
            22647).
Neutral     p = 0
Revealed by Moon patches at several distances from the Moon: a constant is missing, not a factor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Berry, Dennis & Lee 2004, New J. Phys. 6, 162; Gál et al. 2001, JGR 106, 22647"


class MoonMultipleScattering(Effect):
    """Polarisation of the Moon sky lowered by multiple scattering."""

    p: Scalar = param(unit="", about="missing degree of polarisation", source=SOURCE, width=0.01, default=0.0)

    name: ClassVar[str] = "moon_multiple_scattering"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "Moon patches at different distances from the Moon, with polariser exposures"
    separated_by: ClassVar[str] = (
        "patches at 40–90° from the Moon separate it from δ (which is a factor); patches on all sides "
        "separate it from the telescope"
    )

    said: ClassVar[tuple[str, ...]] = ("polarisation of sky",)

    def patch(self, instrument: Instrument) -> Instrument:
        """Take polarisation away from the sky."""
        return instrument.changed("sky", missing=lambda p: self.p if p is None else p + self.p)

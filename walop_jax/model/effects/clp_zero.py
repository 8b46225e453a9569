"""Zero point of the polariser's encoder.

Equation    θ = CLP_ANGLE + angle
Symbols     θ transmission axis in the ICS; angle [deg]
Source      axes of such polarisers are clocked to 0.1° (Harrington et al.
            2021, JATIS 7, 018004).
Neutral     angle = 0
Revealed by standard stars: polariser and sky then disagree on the direction of +q by the same angle
            everywhere.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Harrington et al. 2021, JATIS 7, 018004"


class ClpZero(Effect):
    """Zero point of the polariser's encoder."""

    angle: Scalar = param(
        unit="deg", about="added to the encoder reading", source=SOURCE, width=0.3, default=0.0
    )

    name: ClassVar[str] = "clp_zero"
    said: ClassVar[tuple[str, ...]] = ("turn of polariser",)
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = (
        "polariser exposures together with polarised standards (or a trusted sky angle)"
    )
    separated_by: ClassVar[str] = (
        "a polarised standard separates it from rotated plates or analysers (they turn stars as well); "
        "standards and Moon at several ROTATOR angles separate it from the rotator zero"
    )

    def patch(self, instrument: Instrument) -> Instrument:
        """Add to the encoder reading."""
        return instrument.changed(
            "polariser", zero=lambda zero: self.angle if zero is None else zero + self.angle
        )

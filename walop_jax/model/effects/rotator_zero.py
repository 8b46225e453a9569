"""Zero point of the position angle of the instrument.

Equation    true ROTATOR = header + angle, hence (q + iu) of the sky in the ICS → (q + iu) exp(−2i angle)
Symbols     angle [deg], north through east
Source      EVPA in the instrument frame = position angle on the sky − ROTATOR (docs: conventions).
Neutral     angle = 0
Revealed by Moon and standards turned together against the polariser.

Field points also stand elsewhere on the sky, by angle · r, which changes the Moon sky by less than 3e-5 for
one degree and is left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "position angle on the sky minus ROTATOR is the angle in the instrument frame"


class RotatorZero(Effect):
    """Zero point of the position angle of the instrument."""

    angle: Scalar = param(unit="deg", about="added to ROTATOR", source=SOURCE, width=0.3, default=0.0)

    name: ClassVar[str] = "rotator_zero"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polarised standards, or Moon patches, together with polariser exposures"
    separated_by: ClassVar[str] = (
        "nothing but an independent zero of the polariser, such as a polariser aligned in the laboratory: "
        "both turn sky against polariser"
    )

    said: ClassVar[tuple[str, ...]] = ("retardance v ahead of polariser",)

    def patch(self, instrument: Instrument) -> Instrument:
        """Add to ROTATOR."""
        return instrument.changed(
            "", rotator_zero=lambda zero: self.angle if zero is None else zero + self.angle
        )

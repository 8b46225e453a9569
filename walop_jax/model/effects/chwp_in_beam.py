"""The calibration half-wave plate is in the beam although the header says out.

Equation    CHWP out → the plate stands at 0°; settings that the header says are in stay as they are
Source      a plate left in the beam, or a header that is wrong.
Neutral     none: the effect is there or it is not; without it the header is right
Revealed by everything that has u: the plate reverses its sign ahead of the wedges. Two models are compared.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect
from walop_jax.model.elements import WavePlate

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "a plate left in the beam, or a header that is wrong"


class ChwpInBeam(Effect):
    """Calibration plate in the beam, at 0°, where the header says that it is out."""

    name: ClassVar[str] = "chwp_in_beam"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures, or any polarised source, said to be without the plate"
    separated_by: ClassVar[str] = (
        "exposures with the plate at 45°: a wrong sign of u in the polariser is the same in all"
    )

    def fits(self, instrument: Instrument) -> bool:
        """Whether there is a calibration plate that can be out."""
        plate = next((e for e in instrument.elements if e.name == "chwp"), None)
        return isinstance(plate, WavePlate) and not plate.always_in

    def patch(self, instrument: Instrument) -> Instrument:
        """Put the plate in at 0°."""
        return instrument.changed("chwp", always_in=True)

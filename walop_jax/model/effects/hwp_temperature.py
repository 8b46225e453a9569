"""Birefringence of the plates against temperature.

Equation    n_e − n_o → (n_e − n_o) (1 − coefficient · b · (TEMP − 10 °C)), n_o unchanged
Symbols     b relative change per kelvin, 1.23e-4 quartz and 5.37e-5 MgF2; TEMP [Celsius]; coefficient, 1
            for crystals that behave as published
Source      Etzel, Rose & Wang 2000, Appl. Opt. 39, 5796.
Neutral     coefficient = 0
Revealed by cross-talk that changes with the temperature of the instrument: 0.84° of retardance per kelvin
            for plates of 1.5 waves, since the two crystals do not cancel. A missing TEMP counts as 10 °C.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements import WavePlate
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Etzel, Rose & Wang 2000, Appl. Opt. 39, 5796"


class HwpTemperature(Effect):
    """Birefringence of all plates that changes with temperature."""

    coefficient: Scalar = param(
        unit="",
        about="of the published thermal change",
        source=SOURCE,
        width=1.0,
        default=0.0,
    )

    name: ClassVar[str] = "hwp_temperature"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "the same polariser exposures at two temperatures"
    separated_by: ClassVar[str] = (
        "a time series with a temperature log: at one temperature it cannot be told from thickness; wedge "
        "and flexure are odd in the field, this is even"
    )

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """All plates."""
        return tuple(f"thermal of {place}" for place in instrument.places(WavePlate))

    def sums(self, instrument: Instrument) -> tuple[tuple[str, ...], ...]:
        """All plates alike."""
        return (self.in_sentences(instrument),)

    def patch(self, instrument: Instrument) -> Instrument:
        """Let the birefringence of all wave plates change with temperature."""
        for place in instrument.places(WavePlate):
            instrument = instrument.changed(
                place, thermal=lambda c: self.coefficient if c is None else c + self.coefficient
            )
        return instrument

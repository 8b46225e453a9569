"""Birefringence of the plates against temperature.

Equation    n_e − n_o → (n_e − n_o) (1 − coefficient · b · (TEMP − 10 °C)), n_o unchanged
Symbols     b relative change per kelvin, 1.23e-4 quartz and 5.37e-5 MgF2; TEMP [Celsius]; coefficient, 1
            for crystals that behave as published
Source      calibration contract, section 6; Etzel, Rose & Wang 2000, Appl. Opt. 39, 5796.
Neutral     coefficient = 0
Revealed by cross-talk that changes with the temperature of the instrument: 0.84° of retardance per kelvin
            for plates of 1.5 waves, since the two crystals do not cancel. A missing TEMP counts as 10 °C.
"""

from __future__ import annotations

from typing import ClassVar

from walop_jax.model.effects.base import CONTRACT, Conditions, Effect, Scalar
from walop_jax.model.materials import MGF2_THERMAL, QUARTZ_THERMAL, REFERENCE_TEMPERATURE
from walop_jax.model.parameters import param
from walop_jax.model.plates import Plate


class HwpTemperature(Effect):
    """All plates change their birefringence with temperature."""

    coefficient: Scalar = param(
        unit="",
        about="of the published thermal change",
        source=CONTRACT,
        width=1.0,
        optical=True,
        default=0.0,
    )

    name: ClassVar[str] = "hwp_temperature"
    optics_depend_on: ClassVar[tuple[str, ...]] = ("temperature",)
    revealed_by: ClassVar[str] = "the same polariser exposures at two temperatures"
    separated_by: ClassVar[str] = (
        "a time series with a temperature log: at one temperature it cannot be told from thickness; wedge "
        "and flexure are odd in the field, this is even"
    )

    def plates(self, where: str, plates: tuple[Plate, ...], conditions: Conditions) -> tuple[Plate, ...]:
        """Scale the birefringence of quartz and MgF2."""
        warmer = self.coefficient * (conditions.temperature - REFERENCE_TEMPERATURE)
        return tuple(
            plate._replace(
                extraordinary=plate.ordinary
                + (plate.extraordinary - plate.ordinary) * (1.0 - thermal * warmer)
            )
            for plate, thermal in zip(plates, (QUARTZ_THERMAL, MGF2_THERMAL), strict=True)
        )

"""Wollaston prisms turned about the axis.

Equation    analysers ½ (1, ±η cos 2 angle, ±η sin 2 angle, 0)
Symbols     angle of the analysers from +X toward +Y [deg]; η their efficiency
Source      mounting of the prisms.
Neutral     angle = 0
Revealed by an analysed direction that is turned the same way in both halves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "mounting of the prisms: expected size"


class WollastonAxis(Effect):
    """Wollaston prisms of both halves turned about the optical axis."""

    angle: Scalar = param(
        unit="deg", about="rotation of the analysers", source=SOURCE, width=0.3, default=0.0
    )

    name: ClassVar[str] = "wollaston_axis"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures with polarised standards"
    separated_by: ClassVar[str] = (
        "nothing at one field point: only 2 α − angle enters; the field pattern of the plates, whose axes "
        "set its symmetry, and scans of the calibration plate tell it from their axes, polarised standards "
        "from the polariser's zero"
    )

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """Light turned directly ahead of every analyser."""
        return tuple(
            f"retardance v behind {arm.name}.{arm.path[-2]}" for arm in instrument.arms if len(arm.path) > 1
        )

    def patch(self, instrument: Instrument) -> Instrument:
        """Turn the analysers of all arms."""
        for arm in instrument.arms:
            place = f"{arm.name}.{arm.path[-1]}"
            instrument = instrument.changed(
                place, angle=lambda a: self.angle if a is None else a + self.angle
            )
        return instrument

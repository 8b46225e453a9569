"""Flexure of the instrument.

Equation    (X, Y) → (X + rate_x · HA, Y + rate_y · HA) ahead of the mapping from field to pupil
Symbols     rate_x, rate_y [deg/h]; HA hour angle [h]
Source      0.2 % in half an hour and 1 % between pointings were seen in
            WIRC+Pol (Tinyanont et al. 2019, arXiv:1811.03138 and arXiv:1908.10409).
Neutral     rate_x = rate_y = 0
Revealed by a pattern of cross-talk that moves over the field with hour angle. A missing HA counts as 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements import FieldShift
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Tinyanont et al. 2019, arXiv:1811.03138; Tinyanont et al. 2019, arXiv:1908.10409"


class Flexure(Effect):
    """Field displaced in proportion to the hour angle."""

    rate_x: Scalar = param(
        unit="deg/h", about="displacement along X", source=SOURCE, width=0.003, default=0.0
    )
    rate_y: Scalar = param(
        unit="deg/h", about="displacement along Y", source=SOURCE, width=0.003, default=0.0
    )

    name: ClassVar[str] = "flexure"
    over_field: ClassVar[bool] = True
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures at different hour angles"
    separated_by: ClassVar[str] = "the same polariser angles at several hour angles and at one temperature"

    said: ClassVar[tuple[str, ...]] = (
        "displacement x ahead of pupil * hour angle",
        "displacement y ahead of pupil * hour angle",
    )

    def sums(self, instrument: Instrument) -> tuple[tuple[str, ...], ...]:
        """Each rate is a sentence."""
        return tuple((text,) for text in self.in_sentences(instrument))

    def patch(self, instrument: Instrument) -> Instrument:
        """Displace what the mapping to the pupil sees."""
        shift = FieldShift(name=self.name, rate_x=self.rate_x, rate_y=self.rate_y)
        return instrument.inserted(shift, before="pupil")

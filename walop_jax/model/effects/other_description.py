"""The instrument is not as its description says: elements in another order, turned, left out, of other dispersion.

Not in the catalogue: `diagnose` tries every change that the instrument has a place for (`model/alternatives.py`) when
something is missing, and adds the one that the data demand. The description file is then to be corrected.

Equation    none of its own: the same elements, arranged otherwise
Source      conventions of signs, angles and orders are what two parties understand differently
Neutral     no change
Revealed by any data that the instrument as described does not explain at all
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx

from walop_jax.model.effects.base import Effect

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument


class OtherDescription(Effect):
    """Discrete changes of the description, in words (`change`), several of them joined by "; "."""

    change: str = eqx.field(static=True, default="")

    name: ClassVar[str] = "other_description"
    reference: ClassVar[str] = (
        "conventions of signs, angles and orders that two parties understand differently"
    )
    revealed_by: ClassVar[str] = "any data that the instrument as described does not explain"
    separated_by: ClassVar[str] = (
        "field points far from the axis, several filters, the calibration plate at 22.5 deg"
    )

    def patch(self, instrument: Instrument) -> Instrument:
        """Arrange the instrument as the change says. Raises ValueError for a change that it has no place for."""
        from walop_jax.model.alternatives import changed

        return changed(instrument, self.change)

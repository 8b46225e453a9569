"""The broad band displaced as a whole.

Equation    THROUGHPUT(λ) → THROUGHPUT(λ − wavelength) for filters of an equivalent width above 0.05 µm
Symbols     wavelength: displacement [µm]; equivalent width ∫ THROUGHPUT dλ / max THROUGHPUT
Source      interference filters shift with tilt and temperature, and
            catalogue curves differ from the filter in the wheel by several nm.
Neutral     wavelength = 0
Revealed by cross-talk of the u half that narrow bands do not confirm. Narrow bands stay where they are; the
            source spectrum is taken at the displaced wavelengths.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "interference filters shift with tilt and temperature: expected size"

BROAD = 0.05  # µm


class FilterShift(Effect):
    """Broad band displaced as a whole."""

    wavelength: Scalar = param(
        unit="um", about="displacement of the band", source=SOURCE, width=0.003, default=0.0
    )

    name: ClassVar[str] = "filter_shift"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures in the broad band and in narrow ones"
    separated_by: ClassVar[str] = (
        "narrow bands: they fix the thicknesses of the plates, which alone look the same"
    )

    said: ClassVar[tuple[str, ...]] = ("shift of band",)

    def patch(self, instrument: Instrument) -> Instrument:
        """Displace broad bands."""
        return instrument.changed(
            "", filter_shift=lambda shift: self.wavelength if shift is None else shift + self.wavelength
        )

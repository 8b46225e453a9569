"""The broad band displaced as a whole.

Equation    THROUGHPUT(λ) → THROUGHPUT(λ − wavelength) for filters of an equivalent width above 0.05 µm
Symbols     wavelength: displacement [µm]; equivalent width ∫ THROUGHPUT dλ / max THROUGHPUT
Source      calibration contract, section 6; interference filters shift with tilt and temperature, and
            catalogue curves differ from the filter in the wheel by several nm.
Neutral     wavelength = 0
Revealed by cross-talk of the u half that narrow bands do not confirm. Narrow bands stay where they are; the
            source spectrum is taken at the displaced wavelengths.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from walop_jax.model.effects.base import CONTRACT, Conditions, Effect, Real, Scalar
from walop_jax.model.parameters import param

BROAD = 0.05  # µm


class FilterShift(Effect):
    """Broad bands are displaced."""

    wavelength: Scalar = param(
        unit="um", about="displacement of the band", source=CONTRACT, width=0.003, optical=True, default=0.0
    )

    name: ClassVar[str] = "filter_shift"
    revealed_by: ClassVar[str] = "polariser exposures in the broad band and in narrow ones"
    separated_by: ClassVar[str] = (
        "narrow bands: they fix the thicknesses of the plates, which alone look the same"
    )

    def wavelengths(self, wavelength: Real, conditions: Conditions) -> Real:
        """Move the nodes of broad bands."""
        return wavelength + jnp.where(conditions.band_width > BROAD, self.wavelength, 0.0)

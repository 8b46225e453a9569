"""Circular polarisation that the polariser adds.

Equation    light behind the polariser (1, c cos 2θ, c sin 2θ, v)
Symbols     v: S3 per unit of transmitted light, the same at every angle of the polariser
Source      retardance of film and substrate, 1–3 % is plausible.
Neutral     v = 0
Revealed by an offset of u_m in polariser exposures that follows the V column of the second half (about sin
            δ of HWP2: a field map) and is absent for stars.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "retardance of film and substrate of a polariser: expected size"


class ClpEllipticity(Effect):
    """Constant circular polarisation behind the polariser."""

    v: Scalar = param(unit="", about="S3 behind the polariser", source=SOURCE, width=0.02, default=0.0)

    name: ClassVar[str] = "clp_ellipticity"
    said: ClassVar[tuple[str, ...]] = ("diattenuation v of polariser",)
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = (
        "polariser exposures over the field, with stars or Moon that do not have the offset"
    )
    separated_by: ClassVar[str] = (
        "the polariser turned over (v changes sign), or standards, which have no such offset"
    )

    def patch(self, instrument: Instrument) -> Instrument:
        """Let the polariser make circular polarisation."""
        return instrument.changed("polariser", ellipticity=lambda v: self.v if v is None else v + self.v)

"""Circular polarisation that the polariser adds.

Equation    light behind the polariser (1, c cos 2θ, c sin 2θ, v)
Symbols     v: S3 per unit of transmitted light, the same at every angle of the polariser
Source      calibration contract, section 6; retardance of film and substrate, 1–3 % is plausible.
Neutral     v = 0
Revealed by an offset of u_m in polariser exposures that follows the V column of the second half (about sin
            δ of HWP2: a field map) and is absent for stars.
"""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Array, Float

from walop_jax.model.effects.base import CONTRACT, Effect, ExposureArrays, Scalar
from walop_jax.model.parameters import param


class ClpEllipticity(Effect):
    """Constant circular polarisation behind the polariser."""

    v: Scalar = param(unit="", about="S3 behind the polariser", source=CONTRACT, width=0.02, default=0.0)

    name: ClassVar[str] = "clp_ellipticity"
    revealed_by: ClassVar[str] = (
        "polariser exposures over the field, with stars or Moon that do not have the offset"
    )
    separated_by: ClassVar[str] = (
        "the polariser turned over (v changes sign), or standards, which have no such offset"
    )

    def polarised(self, stokes: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Set S3 of the light behind the polariser."""
        return stokes.at[:, 3].add(self.v)

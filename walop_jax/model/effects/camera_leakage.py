"""Light of the orthogonal camera.

Equation    N0 → N0 + share N1, N1 → N1 + share N0, and N2, N3 likewise (behind the throughput)
Symbols     share: of the orthogonal camera's light
Source      calibration contract, section 6; a wire-grid beam splitter mixes both polarisations into its
            reflected beam.
Neutral     share = 0
Revealed by efficiencies too low by 2 share in both halves.
"""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Array, Float

from walop_jax.model.effects.base import CONTRACT, Effect, Scalar
from walop_jax.model.parameters import param

ORTHOGONAL = (1, 0, 3, 2)


class CameraLeakage(Effect):
    """A share of the orthogonal camera's light in each camera."""

    share: Scalar = param(
        unit="", about="share of the orthogonal camera", source=CONTRACT, width=0.003, default=0.0
    )

    name: ClassVar[str] = "camera_leakage"
    one_sided: ClassVar[tuple[str, ...]] = ("share",)
    revealed_by: ClassVar[str] = "polariser exposures: an efficiency below what the analysers can have"
    separated_by: ClassVar[str] = (
        "nothing in intensities alone tells it from less efficient analysers beyond their prior; standards "
        "of 3–5 % tell it from the extinction of the polariser, flux levels from stray light"
    )

    def cameras(self, vectors: Float[Array, "b 4 4"], x: Scalar, y: Scalar) -> Float[Array, "b 4 4"]:
        """Mix the analysis vectors of orthogonal cameras."""
        return vectors + self.share * vectors[:, ORTHOGONAL, :]

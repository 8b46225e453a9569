"""Detectors that are not linear.

Equation    N → N (1 + coefficient · N / 10⁶)
Symbols     N counts [electron]; coefficient per camera
Source      calibration contract, section 6; "small non-linearities in the CCD" were the major obstacle in
            calibrating the Swedish solar telescope (Selbing 2005, arXiv:1010.4142); 1 % at full well is
            typical.
Neutral     coefficient = 0
Revealed by a cos 4θ in the normalised intensities of polariser exposures, of opposite sign in the two
            halves, that grows with the flux; stars and sky disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Self

from jaxtyping import Array, Float

from walop_jax.model.conventions import CAMERAS
from walop_jax.model.effects.base import CONTRACT, Context, Effect, ExposureArrays, per_camera
from walop_jax.model.parameters import param

REFERENCE_COUNTS = 1e6  # electron


class Nonlinearity(Effect):
    """Counts grow or shrink in proportion to themselves."""

    coefficient: Float[Array, 4] = param(unit="", about="relative change at 10⁶", source=CONTRACT, width=0.02)

    name: ClassVar[str] = "nonlinearity"
    revealed_by: ClassVar[str] = "polariser exposures: a fourth harmonic that grows with the flux"
    separated_by: ClassVar[str] = (
        "a few polariser angles at two flux levels: throughput imbalance and an encoder error twice per "
        "turn make the same harmonic at every flux"
    )

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """Linear cameras."""
        return cls(coefficient=per_camera())

    def labels(self, field: str) -> Sequence[str]:
        """One coefficient per camera."""
        return tuple(f"{field}.{camera}" for camera in CAMERAS)

    def detector(self, counts: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Distort the counts."""
        return counts * (1.0 + self.coefficient * counts / REFERENCE_COUNTS)
